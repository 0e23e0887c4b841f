"""`x5-coordinator compensate`: the motors compensate gravity, so that a robot is led by hand."""

import math
from typing import Annotated

import typer

from coordinator.commands.options import ConnectOptions, DynamicsFolder, JsonFile, Speed, TakeSuspect
from coordinator.commands.views.compensation import CompensationView
from coordinator.live_robot.connection import new_sender, open_connection
from coordinator.runtime.command_line import end_if_suspect, fail, with_options
from coordinator.runtime.event_loop import ScaledLoop, attend
from coordinator.runtime.terminal import Terminal
from coordinator.torque_control.gains import max_damping_nm_s_rad
from coordinator.torque_control.gravity_compensation import CompensationSettings
from coordinator.torque_control.gravity_model import gravity_model
from coordinator.torque_control.session import CompensationPlan, CompensationSession
from module_agent.model.catalogue import module_type
from module_agent.model.errors import EXIT_FAILED, UsageError

MIN_RATE_HZ, MAX_RATE_HZ = 20.0, 1000.0
MAX_HOLD_S, MAX_COMPENSATION_S = 600.0, 86400.0


@with_options
def compensate_robot(
    baseline: DynamicsFolder,
    at: ConnectOptions,
    for_s: Annotated[float | None, typer.Option("--for", help="Duration [s] [until Ctrl-C].")] = None,
    rate: Annotated[float, typer.Option(help="Set-points per second.")] = 200.0,
    damping: Annotated[float, typer.Option(help="Viscous damping of every joint [Nm s/rad].")] = 0.0,
    max_speed: Annotated[
        float, typer.Option("--max-speed", help="The robot is held if a joint moves faster [rad/s].")
    ] = 1.5,
    velocity_forces: Annotated[
        bool, typer.Option("--velocity-forces", help="Compensate Coriolis and centrifugal forces too.")
    ] = False,
    hold_s: Annotated[
        float, typer.Option("--hold", help="How long to hold the position at the end [s].")
    ] = 1.0,
    back: Annotated[
        bool, typer.Option("--back/--no-back", help="Return to the start position at the end [yes].")
    ] = True,
    suspect: TakeSuspect = False,
    speed: Speed = 1.0,
    json_file: JsonFile = None,
) -> None:
    """Compensate the robot's weight by its motors, so that it can be led by hand and stays where it is left.

    At the end or on Ctrl-C the robot holds its position, returns to where it started, and is released. Ctrl-C
    on the way back stops it there; a second one stops it at once. After a limit was exceeded it does not
    return, but is released where it is. Exit codes: 0 also after Ctrl-C; 1 the start was refused, or a limit
    was exceeded; 5 the model is that of a suspect run; others as of `run`.
    """
    model = gravity_model(baseline, suspect)
    place = at.place(model.robot)
    most, kind = min((max_damping_nm_s_rad(module_type(name)), name) for name in set(model.types))
    _check("rate", rate, MIN_RATE_HZ, MAX_RATE_HZ, "Hz")
    _check("for", for_s, 0.0, MAX_COMPENSATION_S, "s")
    _check("hold", hold_s, 0.0, MAX_HOLD_S, "s")
    _check("damping", damping, 0.0, most, f"Nm s/rad, the most for type {kind}")
    if not (math.isfinite(max_speed) and max_speed > 0.0):
        raise UsageError(f"--max-speed {max_speed}: it must be a positive number of rad/s")
    settings = CompensationSettings(damping, max_speed, velocity_forces=velocity_forces)
    plan = CompensationPlan(settings, rate, for_s, hold_s, back)
    transport = open_connection(place, Terminal(at.quiet).note).transport
    loop = ScaledLoop(speed)
    view = CompensationView(model.chain.serials, loop.time, json_file, at.quiet)
    with view:
        session = CompensationSession(
            transport, place.robot, model, plan, loop.clock_ns, loop.call_soon_threadsafe, view, new_sender()
        )

        def ends() -> bool:
            """End the session in order, at the first signal only."""
            first = not session.is_asked_to_end
            if first:
                session.end("interrupted")
            return first

        summary = attend(loop, session.run(), ends)
    view.summary(summary)
    if summary.is_fault:
        fail(summary.why, EXIT_FAILED)
    end_if_suspect(model.suspicions)


def _check(option: str, value: float | None, least: float, most: float, unit: str) -> None:
    if value is not None and not least <= value <= most:
        raise UsageError(f"--{option} {value}: it must be {least:g} to {most:g} {unit}")

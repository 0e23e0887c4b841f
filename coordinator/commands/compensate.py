"""`x5-coordinator compensate`: the motors compensate gravity, so that a robot is led by hand."""

import math
from collections.abc import Callable
from typing import Annotated, NoReturn

import typer

from coordinator.commands.compensate_view import CompensationView
from coordinator.commands.options import AsJson, ConnectOptions, DynamicsFolder, Speed
from coordinator.live_robot.connection import open_connection, sender_name
from coordinator.runtime.command_line import fail, with_options
from coordinator.runtime.event_loop import (
    SIGNALS,
    Interruption,
    ScaledLoop,
    check_speed,
    ignore_signals,
    run_to_end,
)
from coordinator.runtime.exit_codes import explain
from coordinator.runtime.terminal import Terminal
from coordinator.torque_control.gains import max_damping_nm_s_rad
from coordinator.torque_control.gravity_compensation import CompensationSettings
from coordinator.torque_control.gravity_model import GravityModel, gravity_model
from coordinator.torque_control.session import CompensationPlan, CompensationSession
from coordinator.torque_control.summary import CompensationSummary
from module_agent.model.catalogue import module_type
from module_agent.model.errors import EXIT_FAILED, UsageError
from module_agent.transport.transport import Transport

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
    speed: Speed = 1.0,
    as_json: AsJson = False,
) -> None:
    """Compensate the robot's weight by its motors, so that it can be led by hand and stays where it is left.

    At the end or on Ctrl-C the robot holds its position, returns to where it started, and is released. Ctrl-C
    on the way back stops it there; a second one stops it at once. After a limit was exceeded it does not
    return, but is released where it is. Exit codes: 0 also after Ctrl-C; 1 the start was refused, or a limit
    was exceeded; others as of `run`.
    """
    model = gravity_model(baseline)
    place, speed = at.place(model.robot), check_speed(speed)
    _check_numbers(rate, max_speed)
    _check_times(for_s, hold_s)
    _check_damping(damping, model)
    settings = CompensationSettings(damping, max_speed, velocity_forces=velocity_forces)
    plan = CompensationPlan(settings, rate, for_s, hold_s, back)
    transport = open_connection(place, Terminal(at.quiet).note).transport
    loop = ScaledLoop(speed)
    view = CompensationView(model.chain.serials, loop.time, as_json, at.quiet)
    summary = _attended(loop, place.robot, model, plan, transport, view)
    if summary.is_fault:
        fail(summary.why, EXIT_FAILED)


def _check_numbers(rate_hz: float, max_speed_rad_s: float) -> None:
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise UsageError(f"--rate {rate_hz}: it must be {MIN_RATE_HZ:.0f} to {MAX_RATE_HZ:.0f} Hz")
    if not (math.isfinite(max_speed_rad_s) and max_speed_rad_s > 0.0):
        raise UsageError(f"--max-speed {max_speed_rad_s}: it must be a positive number of rad/s")


def _check_times(for_s: float | None, hold_s: float) -> None:
    for option, value, most in (("--for", for_s, MAX_COMPENSATION_S), ("--hold", hold_s, MAX_HOLD_S)):
        if value is not None and not 0.0 <= value <= most:
            raise UsageError(f"{option} {value}: it must be 0 to {most:.0f} s")


def _check_damping(damping_nm_s_rad: float, model: GravityModel) -> None:
    most, name = min((max_damping_nm_s_rad(module_type(name)), name) for name in set(model.types))
    if not 0.0 <= damping_nm_s_rad <= most:
        raise UsageError(
            f"--damping {damping_nm_s_rad}: it must be 0 to {most:g} Nm s/rad, the most for type {name}"
        )


def _attended(
    loop: ScaledLoop,
    name: str,
    model: GravityModel,
    plan: CompensationPlan,
    transport: Transport,
    view: CompensationView,
) -> CompensationSummary:
    """Compensate to the end, close the loop, and return the summary, or end the command with the reason."""
    interruption: Interruption | None = None
    try:
        with view:
            session = CompensationSession(
                transport, name, model, plan, loop.clock_ns, loop.call_soon_threadsafe, view, sender_name()
            )
            task = loop.create_task(session.run())
            interruption = Interruption(loop, task)
            for number in SIGNALS:
                loop.add_signal_handler(number, _first_end_then(session, interruption))
            summary = run_to_end(loop, task)
        view.summary(summary)
        return summary
    except BaseException as error:
        _give_up(error)
    finally:
        loop.close()
        if interruption is not None and interruption.requested:
            ignore_signals()


def _first_end_then(session: CompensationSession, interruption: Interruption) -> Callable[[], None]:
    """Return a signal handler: the first signal ends the session in order, the next one at once."""

    def on_signal() -> None:
        if session.is_asked_to_end:
            interruption()
        else:
            session.end("interrupted")

    return on_signal


def _give_up(error: BaseException) -> NoReturn:
    failure = explain(error)
    if failure is None:
        raise error
    fail(failure.text, failure.exit_code)

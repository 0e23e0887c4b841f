"""`x5-coordinator compensate`: a known robot bears its own weight, and is led by hand."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from coordinator.baseline.known_robot import BaselineError
from coordinator.commands.attended_run import Place, join, sender_name
from coordinator.commands.compensate_view import CompensationView
from coordinator.commands.options import Connect, Listen, Network, Robot, fail
from coordinator.runtime.event_loop import (
    SIGNALS,
    Interruption,
    ScaledLoop,
    check_speed,
    ignore_signals,
    run_to_end,
)
from coordinator.runtime.exit_codes import EXIT_FAILED, EXIT_LOST, EXIT_USAGE, explain
from coordinator.runtime.terminal import Terminal
from coordinator.torque_control.gains import most_damping_nm_s_rad
from coordinator.torque_control.gravity_compensation import (
    CompensationRefused,
    CompensationSettings,
    StaleFeedback,
)
from coordinator.torque_control.gravity_model import GravityModel, gravity_model
from coordinator.torque_control.preconditions import RobotMismatch
from coordinator.torque_control.session import CompensationPlan, CompensationSession
from coordinator.torque_control.summary import CompensationSummary
from module_agent.model.catalogue import module_type
from module_agent.network_emulation.profile_file import network as network_named
from module_agent.transport.endpoint import DEFAULT_ENDPOINT
from module_agent.transport.transport import Transport, TransportError
from module_agent.wire.keys import check_chunk

MIN_RATE_HZ, MAX_RATE_HZ = 20.0, 1000.0
MAX_HOLD_S, MAX_COMPENSATION_S = 600.0, 86400.0


def compensate_robot(
    known: Annotated[
        Path, typer.Argument(help="Folder of the run that the robot is known from, inertia and all.")
    ],
    robot: Robot | None = None,
    listen: Listen = DEFAULT_ENDPOINT,
    connect: Connect = None,
    network: Network = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the injected network.")] = 0,
    for_s: Annotated[float | None, typer.Option("--for", help="Seconds to float [until Ctrl-C].")] = None,
    rate: Annotated[float, typer.Option(help="Set-points a second.")] = 200.0,
    damping: Annotated[float, typer.Option(help="Of every joint against its motion [Nm s/rad].")] = 0.0,
    max_speed: Annotated[
        float, typer.Option("--max-speed", help="A joint that goes faster is held [rad/s].")
    ] = 1.5,
    velocity_forces: Annotated[
        bool, typer.Option("--velocity-forces", help="Bear Coriolis and centrifugal forces too.")
    ] = False,
    hold_s: Annotated[float, typer.Option("--hold", help="Seconds to hold still in the end.")] = 1.0,
    back: Annotated[
        bool, typer.Option("--back/--no-back", help="Go back to where it stood before letting go [yes].")
    ] = True,
    speed: Annotated[float, typer.Option(help="Speed of a simulated world.")] = 1.0,
    as_json: Annotated[bool, typer.Option("--json", help="Lines of JSON instead of a table.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Nothing but errors.")] = False,
) -> None:
    """Let a known robot float: its motors bear its weight, so that a hand can lead it and it stays there.

    Ctrl-C ends it: the robot is held where it is, goes back to where it stood, and is let go. On its way back
    it stops there. A second one stops it at once. If a limit was met it does not go back, and is let go where
    it is. Exit codes: 0 also after Ctrl-C, 1 it was not set free or a limit ended it, others as of `run`.
    """
    try:
        weight = gravity_model(known)
        check_chunk("robot", robot or weight.robot)
        check_speed(speed)
        _check_numbers(rate, max_speed)
        _check_times(for_s, hold_s)
        _check_damping(damping, weight)
        place = Place(listen, tuple(connect or ()), network_named(network), seed)
    except (BaselineError, ValueError) as error:
        fail(error, EXIT_USAGE)
    settings = CompensationSettings(damping, max_speed, velocity_forces=velocity_forces)
    plan = CompensationPlan(settings, rate, for_s, hold_s, back)
    try:
        transport = join(place, Terminal(quiet)).transport
    except (OSError, TransportError) as error:
        fail(error, EXIT_USAGE)
    found = _attended(robot or weight.robot, weight, plan, transport, speed, as_json, quiet)
    if found.is_fault:
        fail(found.why, EXIT_FAILED)


def _check_numbers(rate_hz: float, max_speed_rad_s: float) -> None:
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise ValueError(f"--rate {rate_hz}: it must be {MIN_RATE_HZ:.0f} to {MAX_RATE_HZ:.0f} Hz")
    if not (math.isfinite(max_speed_rad_s) and max_speed_rad_s > 0.0):
        raise ValueError(f"--max-speed {max_speed_rad_s}: it must be a positive number of rad/s")


def _check_times(for_s: float | None, hold_s: float) -> None:
    for option, value, most in (("--for", for_s, MAX_COMPENSATION_S), ("--hold", hold_s, MAX_HOLD_S)):
        if value is not None and not 0.0 <= value <= most:
            raise ValueError(f"{option} {value}: it must be 0 to {most:.0f} s")


def _check_damping(damping_nm_s_rad: float, weight: GravityModel) -> None:
    most, name = min((most_damping_nm_s_rad(module_type(name)), name) for name in set(weight.types))
    if not 0.0 <= damping_nm_s_rad <= most:
        raise ValueError(
            f"--damping {damping_nm_s_rad}: it must be 0 to {most:g} Nm s/rad, the most for type {name}"
        )


def _attended(
    name: str,
    weight: GravityModel,
    plan: CompensationPlan,
    transport: Transport,
    speed: float,
    as_json: bool,
    quiet: bool,
) -> CompensationSummary:
    """Float to the end, or end the command with what went wrong."""
    loop = ScaledLoop(speed)
    interruption: Interruption | None = None
    try:
        with CompensationView(weight.chain.serials, loop.time, as_json, quiet) as view:
            session = CompensationSession(
                transport, name, weight, plan, loop.clock_ns, loop.call_soon_threadsafe, view, sender_name()
            )
            task = loop.create_task(session.run())
            interruption = Interruption(loop, task)
            for number in SIGNALS:
                loop.add_signal_handler(number, _first_end_then(session, interruption))
            found = run_to_end(loop, task)
        view.summary(found)
        return found
    except BaseException as error:
        _give_up(error)
    finally:
        loop.close()
        if interruption is not None and interruption.asked:
            ignore_signals()


def _first_end_then(session: CompensationSession, interruption: Interruption) -> Callable[[], None]:
    """Return a signal handler: the first signal asks for the end in order, the next one for that at once."""

    def heard() -> None:
        if session.is_asked_to_end:
            interruption()
        else:
            session.end("interrupted")

    return heard


def _give_up(error: BaseException) -> NoReturn:
    if isinstance(error, CompensationRefused | RobotMismatch):
        fail(error, EXIT_FAILED)
    if isinstance(error, StaleFeedback):
        fail(error, EXIT_LOST)
    failure = explain(error)
    if failure is None:
        raise error
    fail(failure.text, failure.exit_code)

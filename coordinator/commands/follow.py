"""`x5-coordinator follow`: a robot follows a motion with what was identified of it, in three input modes."""

import math
from pathlib import Path
from typing import Annotated

import typer

from coordinator.commands.options import ConnectOptions, DynamicsFolder, JsonFile, Speed, TakeSuspect
from coordinator.live_robot.connection import new_sender, open_connection
from coordinator.runtime.command_line import end_if_suspect, in_a_folder, with_options
from coordinator.runtime.event_loop import ScaledLoop, attend
from coordinator.runtime.terminal import Terminal, new_table, print_table, write_result
from coordinator.torque_control.follow_session import FollowPlan, FollowSession
from coordinator.torque_control.gravity_model import gravity_model
from coordinator.torque_control.motion_file import read_motion
from coordinator.torque_control.tracking import MODE_NAMES, MODES, FollowResult, InputMode, result_path
from module_agent.model.errors import UsageError
from module_agent.model.files import write_json

MIN_RATE_HZ, MAX_RATE_HZ = 50.0, 1000.0
MAX_TRAVEL_RAD_S = 2.0


@with_options
def follow(
    baseline: DynamicsFolder,
    at: ConnectOptions,
    motion: Annotated[
        Path, typer.Option(help="CSV file of the motion: t_s and q_<joint>_rad, as `excite` writes it.")
    ],
    mode: Annotated[
        list[int] | None,
        typer.Option(
            help="Input mode: 1 position, 2 with velocity, 3 with torque; repeat for several [all]."
        ),
    ] = None,
    drive: Annotated[
        bool, typer.Option("--drive/--no-drive", help="Add the motors' own losses to the torques [yes].")
    ] = True,
    rate: Annotated[float, typer.Option(help="Set-points per second.")] = 200.0,
    max_error: Annotated[
        float, typer.Option("--max-error", help="The robot is stopped if a joint is farther off [rad].")
    ] = 0.5,
    travel: Annotated[float, typer.Option(help="Speed on the way to the start and back [rad/s].")] = 0.5,
    out: Annotated[
        Path | None,
        typer.Option(help="JSON file of the result [follow.json in the folder].", callback=in_a_folder),
    ] = None,
    suspect: TakeSuspect = False,
    speed: Speed = 1.0,
    json_file: JsonFile = None,
) -> None:
    """Follow a motion by position, with velocity, and with the calculated torque; compare the errors.

    The robot moves slowly to the start of the motion before each mode, and back at the end. Position, speed
    and calculated torque of the whole motion are checked first. Ctrl-C stops all modules. Exit codes: 0 done,
    1 the robot refused the motion, or lost track of it; 5 the model is that of a suspect run; others as of
    `run`.
    """
    model = gravity_model(baseline, suspect)
    place = at.place(model.robot)
    plan = FollowPlan(_modes(mode), rate, drive, max_error, travel)
    _check("rate", rate, MIN_RATE_HZ, MAX_RATE_HZ, "Hz")
    _check("max-error", max_error, 1e-3, math.pi, "rad")
    _check("travel", travel, 1e-2, MAX_TRAVEL_RAD_S, "rad/s")
    path = read_motion(motion, model.chain.serials)
    with Terminal(at.quiet) as terminal:
        transport = open_connection(place, terminal.note).transport
        loop = ScaledLoop(speed)
        session = FollowSession(
            transport,
            place.robot,
            model,
            path,
            plan,
            loop.clock_ns,
            loop.call_soon_threadsafe,
            terminal,
            new_sender(),
        )
        result = attend(loop, session.run())
    file = result_path(baseline, out)
    write_json(file, result)
    if write_result(json_file, result):
        _print(result)
        typer.echo(f"{file}: tracking of {result.motion}, {result.duration_s:.1f} s, in SI units")
    end_if_suspect(result.suspicions)


def _modes(chosen: list[int] | None) -> tuple[InputMode, ...]:
    if unknown := [number for number in chosen or () if number not in MODES]:
        raise UsageError(f"--mode {unknown[0]}: it must be 1, 2 or 3")
    return tuple(mode for mode in MODES if not chosen or mode in chosen)


def _check(option: str, value: float, least: float, most: float, unit: str) -> None:
    if not least <= value <= most:
        raise UsageError(f"--{option} {value}: it must be {least:g} to {most:g} {unit}")


def _print(result: FollowResult) -> None:
    pairs = " | ".join(f">mode {one.mode} rms [rad] | >worst [rad]" for one in result.modes)
    names = ", ".join(f"{one.mode} {MODE_NAMES[one.mode]}" for one in result.modes)
    table = new_table(f"Tracking error by input mode: {names}", f"joint | {pairs}")
    for joints in zip(*(one.joints for one in result.modes), strict=True):
        errors = [f"{value:.5f}" for joint in joints for value in (joint.rms_rad, joint.worst_rad)]
        table.add_row(joints[0].serial, *errors)
    totals = [f"{value:.5f}" for one in result.modes for value in (one.rms_rad, one.worst_rad)]
    table.add_row("all", *totals)
    print_table(table)

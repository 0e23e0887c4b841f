"""`x5-coordinator import`: make a recording of a log that HEBI's programs wrote."""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.recording.hebi_recording import LoggedModule, recorded_log
from coordinator.recording.run_folder import SESSION, open_run_folder
from coordinator.recording.session_file import SessionWriter
from module_agent.hardware.hebi_library import log_loader
from module_agent.model.catalogue import CATALOGUE, ImuKind, TorqueKind, UnknownModuleType, module_type
from module_agent.model.errors import UsageError
from module_agent.wire.keys import check_chunk


def import_log(
    log: Annotated[Path, typer.Argument(help="A .hebilog of the robot's modules as one group.")],
    out: Annotated[Path, typer.Option(help="Folder of the run; it must be new.")],
    kinds: Annotated[
        list[str], typer.Option("--type", help=f"Type of each module in turn: {', '.join(CATALOGUE)}.")
    ],
    names: Annotated[
        list[str] | None, typer.Option("--name", help="Name of each module in turn [module-1, ...].")
    ] = None,
    robot: Annotated[str, typer.Option(help="What the robot is called.")] = "robot",
    imu: Annotated[ImuKind, typer.Option(help="Prior of the IMUs' intrinsics.")] = "uncalibrated",
    torque: Annotated[TorqueKind, typer.Option(help="Prior of torque sensors' scales.")] = "uncalibrated",
) -> None:
    """Make a recording of a log of HEBI's programs, from which `replay` identifies the robot.

    The log must have a second in which all modules stand still, and after it a motion of all joints at once.
    Topology and kinematic chain come of it, no inertia. Exit codes: 0 written; 2 wrong usage, or the log does
    not hold enough.
    """
    called = names if names is not None else [f"module-{number + 1}" for number in range(len(kinds))]
    if len(called) != len(kinds) or len(set(called)) != len(called):
        raise UsageError(f"give a --name of its own to each --type: {len(kinds)} types, {len(called)} names")
    try:
        check_chunk("--robot", robot)
        modules = [
            LoggedModule(check_chunk("--name", name), module_type(kind).name)
            for name, kind in zip(called, kinds, strict=True)
        ]
    except UnknownModuleType as error:
        raise UsageError(f"--type: {error}") from error
    entries = recorded_log(log, robot, modules, log_loader(), (imu, torque))
    try:
        open_run_folder(out, resume=False)
        writer = SessionWriter(out / SESSION)
    except OSError as error:
        raise UsageError(f"cannot write {out}: {error.strerror}") from error
    for entry in entries:
        writer.write(entry)
    writer.close()
    if writer.failure is not None:
        raise writer.failure
    typer.echo(f"written to {out}; to identify the robot: x5-coordinator replay {out}")

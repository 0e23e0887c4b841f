"""`x5-coordinator export`: a run for other programs, as tables, for ROS 2 or for Foxglove."""

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from coordinator.commands.options import JsonFile
from coordinator.export.exported_run import ExportedRun, check_package, read_exported
from coordinator.export.messages import write_messages
from coordinator.export.tables import write_table
from coordinator.runtime.command_line import in_a_folder
from coordinator.runtime.terminal import STANDARD_OUTPUT, Terminal, write_result
from module_agent.model.errors import UsageError
from module_agent.model.files import replacing


class Format(StrEnum):
    """What a run is exported to."""

    CSV = "csv"
    PARQUET = "parquet"
    ROS2 = "ros2"
    FOXGLOVE = "foxglove"


def _output_file(file: Path) -> Path:
    if file == STANDARD_OUTPUT:
        raise UsageError("--out -: a run is exported to a file; give its name")
    in_a_folder(file)
    return file


def export(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, finished or not.")],
    to: Annotated[Format, typer.Option(help="Table (csv, parquet), or MCAP file (ros2, foxglove).")],
    out: Annotated[Path, typer.Option(help="File to write.", callback=_output_file)],
    rate_hz: Annotated[
        float | None,
        typer.Option(help="Interpolate all modules at so many common instants a second [every sample]."),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Write what all modules reported, with units in the names, on one time base.

    Of a run that ended early or is damaged, what there is is written, and what is missing is said.

    Examples:

      x5-coordinator export runs/demo --to parquet --out demo.parquet

      x5-coordinator export runs/demo --to ros2 --rate-hz 100 --out demo.mcap

    Exit codes: 0 written; 1 nothing to write; 2 wrong usage, or a package is missing.
    """
    if to is Format.ROS2:
        check_package("mcap_ros2", "ROS 2")
    elif to is not Format.FOXGLOVE:
        check_package("pandas", to.value.upper() if to is Format.CSV else "Parquet")
    run = read_exported(folder)
    with Terminal() as terminal:
        for sentence in run.missing:
            terminal.note(sentence)

        def progress(done: int, total: int) -> None:
            terminal.progress(done, total, f"writing {out.name}")

        if to is Format.CSV or to is Format.PARQUET:
            what = "rows"
            count = write_table(out, run, "csv" if to is Format.CSV else "parquet", rate_hz, progress)
        else:
            what = "samples"
            count = _write_mcap(out, run, to, rate_hz, progress)
    told = {"file": str(out), "format": to.value, what: count, "modules": list(run.signals)}
    if write_result(json_file, {**told, "missing": list(run.missing)}):
        typer.echo(f"{out}: {count} {what} of {', '.join(run.signals)}")


def _write_mcap(
    out: Path, run: ExportedRun, to: Format, rate_hz: float | None, progress: Callable[[int, int], None]
) -> int:
    about = {"robot": run.robot, "modules": ", ".join(run.signals), "missing": "\n".join(run.missing)}
    with replacing(out) as temporary, temporary.open("wb") as file:
        if to is Format.ROS2:
            # Imported on use: its package is an extra.
            from coordinator.export.ros2 import Ros2Writer

            with Ros2Writer(file, about) as ros2:
                return write_messages(run, ros2, rate_hz, progress)
        from coordinator.export.foxglove import FoxgloveWriter

        with FoxgloveWriter(file, about) as foxglove:
            return write_messages(run, foxglove, rate_hz, progress)

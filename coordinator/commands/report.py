"""`x5-coordinator report`: the report of a run for people, from its folder."""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.recording.run_folder import REPORT
from coordinator.report.pages import SUFFIXES, check_suffix, write_page
from coordinator.report.plots import check_plots
from coordinator.report.run_report import gone, read_run, run_report
from coordinator.runtime.command_line import in_a_folder
from coordinator.runtime.terminal import Terminal


def report(
    folder: Annotated[Path, typer.Argument(help="Folder of a run, finished or not.")],
    out: Annotated[
        Path | None,
        typer.Option(help=f"File to write, {', '.join(SUFFIXES)} [{REPORT} in the folder]."),
    ] = None,
) -> None:
    """Write what a run measured, how sure it is, what cannot be known and what happened, for people.

    Exit codes: 0 written, 2 the folder holds no run, or the file cannot be written.
    """
    path = in_a_folder(check_suffix(out if out is not None else folder / REPORT))
    check_plots()
    assert path is not None
    with Terminal() as terminal:
        terminal.step(1, 2, f"reading {folder}")
        data = read_run(folder)
        for sentence in gone(data):
            terminal.note(sentence)
        terminal.step(2, 2, "drawing the report")
        write_page(path, run_report(data))
    typer.echo(f"written to {path}")

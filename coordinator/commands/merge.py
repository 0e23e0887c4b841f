"""`x5-coordinator merge`: combine what several runs with the same modules measured."""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.commands.options import AsJson
from coordinator.merge.information_file import read_information
from coordinator.merge.merge_runs import merge_runs
from coordinator.merge.report import MERGED, merge_report
from coordinator.recording.run_folder import INFORMATION
from coordinator.runtime.terminal import new_table, print_table
from module_agent.model.errors import UsageError
from module_agent.model.files import write_json

# Above this the robot was not the same in all runs, or the covariance of a chain is too small.
INCONSISTENT_ABOVE = 5.0


def merge(
    runs: Annotated[list[Path], typer.Argument(help="Folders of two or more runs, with dynamics.")],
    out: Annotated[Path, typer.Option(help="Folder for merged.json.")],
    as_json: AsJson = False,
) -> None:
    """Combine the torque measurements of several runs into inertial parameters of the modules' parts.

    The robot may be assembled differently in every run: in another order, on another base, with further
    modules. Each link must stay with the module that it leads to.
    """
    if len(runs) < 2:
        raise UsageError("give two or more runs: the parameters of a single one are in its result.json")
    report = merge_report(merge_runs([read_information(run / INFORMATION) for run in runs]))
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / MERGED, report)
    if as_json:
        typer.echo(report.model_dump_json(indent=1))
        return
    table = new_table(
        f"{report.rank} of {report.parameters} parameters of {len(report.parts)} parts",
        "run | modules | rank | below 10 % | below 10 %, merged | sigma merged / alone | "
        "inconsistency [sigma]",
    )
    for run in report.runs:
        table.add_row(
            run.run,
            ", ".join(run.serials),
            str(run.rank),
            str(run.identified_alone),
            str(run.identified_merged),
            f"{run.gain:.2f}",
            f"{run.inconsistency_sigma:.1f}",
        )
    table.add_row("merged", "", str(report.rank), "", "", f"{report.gain:.2f}", "")
    print_table(table)
    for run in report.runs:
        if run.inconsistency_sigma > INCONSISTENT_ABOVE:
            typer.echo(
                f"{run.run} disagrees with the other runs by {run.inconsistency_sigma:.0f} sigma (at "
                f"most {INCONSISTENT_ABOVE:.0f} expected): a part or a link differs, or the covariance of "
                "its chain is too small"
            )

"""`x5-coordinator merge`: what do several runs with the same modules say together?"""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.commands.options import fail
from coordinator.merge.information_file import InformationFileError, read_information
from coordinator.merge.merge_runs import merge_runs
from coordinator.merge.report import MERGED, merge_report, table, write_report
from coordinator.recording.run_folder import INFORMATION
from coordinator.runtime.exit_codes import EXIT_FAILED, EXIT_USAGE
from coordinator.runtime.terminal import print_table

# Above this something was not the same in all runs, or a chain is worse than it says.
INCONSISTENT_ABOVE = 5.0


def merge(
    runs: Annotated[list[Path], typer.Argument(help="Folders of two or more runs, with dynamics.")],
    out: Annotated[Path, typer.Option(help="Folder for merged.json.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print merged.json instead of a table.")] = False,
) -> None:
    """Say what the torques of several runs tell together of the parts of the robot's modules.

    The modules may be put together otherwise in every run, in another order, on another base or on other
    modules, as long as every link stays with the module that it leads to.
    """
    if len(runs) < 2:
        fail("give two runs or more: one by itself says what its result.json says", EXIT_USAGE)
    try:
        report = merge_report(merge_runs([read_information(run / INFORMATION) for run in runs]))
    except (InformationFileError, ValueError) as error:
        fail(error, EXIT_FAILED)
    out.mkdir(parents=True, exist_ok=True)
    write_report(out / MERGED, report)
    if as_json:
        typer.echo(report.model_dump_json(indent=1))
        return
    print_table(table(report))
    for run in report.runs:
        if run.inconsistency_sigma > INCONSISTENT_ABOVE:
            typer.echo(
                f"{run.run} is {run.inconsistency_sigma:.0f} sigma off: a part or a link differs from the "
                "other runs, or the covariance of its chain is too small"
            )

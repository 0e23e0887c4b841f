"""`x5-coordinator check`: compare a robot with an earlier run of it."""

import numpy as np
import typer

from coordinator.baseline.baseline_robot import load_baseline
from coordinator.baseline.check import check, check_plan
from coordinator.baseline.check_report import CheckReport, write_check
from coordinator.commands.attended_run import measured_again
from coordinator.commands.options import AgainOptions, AsJson, BaselineFolder, ConnectOptions
from coordinator.runtime.command_line import with_options
from coordinator.runtime.terminal import Terminal, new_table
from module_agent.model.errors import EXIT_FINDING

CHECK = "check.json"


@with_options
def check_robot(
    baseline: BaselineFolder, at: ConnectOptions, again: AgainOptions, as_json: AsJson = False
) -> None:
    """Measure a robot again in a short run, and say which of its links changed since an earlier run.

    Writes check.json. Exit codes: 0 nothing changed, 4 a link or the modules changed, others as of `run`.
    """
    before = load_baseline(baseline)
    after = measured_again(before, at, again, check_plan)
    report = check(before, after)
    write_check(after.folder / CHECK, report)
    if as_json:
        typer.echo(report.model_dump_json(indent=1, by_alias=True))
    else:
        _print(report)
    if report.changed:
        raise typer.Exit(EXIT_FINDING)


def _print(report: CheckReport) -> None:
    table = new_table(
        f"{report.robot} against {report.baseline}",
        "parent | child | >displaced [mm] | >+- | >turned [deg] | >+- | >false alarm | ",
    )
    for link in report.links:
        table.add_row(
            link.parent,
            link.child,
            f"{link.length_mm:.2f}",
            f"{link.length_sigma_mm:.2f}",
            f"{np.linalg.norm(link.rotation_deg):.3f}",
            f"{max(link.rotation_sigma_deg):.3f}",
            f"{link.false_alarm_probability:.1g}",
            "changed" if link.changed else "",
        )
    if report.links:
        Terminal().console.print(table)
    typer.echo("\n".join(report.summary))

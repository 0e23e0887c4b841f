"""`x5-coordinator check`: compare a robot with an earlier run of it."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from coordinator.baseline.baseline_robot import load_baseline
from coordinator.baseline.check import check, check_plan
from coordinator.baseline.check_report import CheckReport, write_check
from coordinator.commands.attended_run import run_short
from coordinator.commands.options import (
    AsJson,
    BaselineFolder,
    ConnectOptions,
    Expect,
    Measured,
    PlanFile,
    Speed,
    planned,
)
from coordinator.runtime.command_line import with_options
from coordinator.runtime.terminal import Terminal
from module_agent.model.errors import EXIT_FINDING, UsageError

CHECK = "check.json"


@with_options
def check_robot(
    baseline: BaselineFolder,
    at: ConnectOptions,
    out: Annotated[
        Path | None, typer.Option(help="New folder for the check: a short run, and check.json.")
    ] = None,
    measured: Measured = None,
    expect: Expect = None,
    plan: PlanFile = None,
    speed: Speed = 1.0,
    as_json: AsJson = False,
) -> None:
    """Measure a robot again in a short run, and say which of its links changed since an earlier run.

    Exit codes: 0 nothing changed, 4 a link or the modules changed, others as of `run`.
    """
    if (out is None) == (measured is None):
        raise UsageError("give either --out, to measure the robot, or --measured, a run to compare with")
    before = load_baseline(baseline)
    if out is not None:
        after = run_short(before, at, out, check_plan(before, planned(plan)), expect, speed)
    else:
        assert measured is not None
        after = load_baseline(measured)
    report = check(before, after)
    write_check(after.folder / CHECK, report)
    _print(report, as_json)
    if report.changed:
        raise typer.Exit(EXIT_FINDING)


def _print(report: CheckReport, as_json: bool) -> None:
    if as_json:
        typer.echo(report.model_dump_json(indent=1, by_alias=True))
        return
    if report.links:
        Terminal().console.print(_table(report))
    for line in report.summary:
        typer.echo(line)


def _table(report: CheckReport) -> Table:
    table = Table(title=f"{report.robot} against {report.baseline}")
    for name in ("parent", "child"):
        table.add_column(name)
    for name in ("displaced [mm]", "+-", "turned [deg]", "+-", "false alarm"):
        table.add_column(name, justify="right")
    table.add_column("")
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
    return table

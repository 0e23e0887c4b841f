"""`x5-coordinator check`: is a known robot still what it was?"""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.baseline.check import CheckError, check, check_plan
from coordinator.baseline.check_report import CheckReport, table, write_check
from coordinator.baseline.known_robot import BaselineRobot
from coordinator.commands.options import Connect, Expect, Listen, Network, Robot, fail, planned
from coordinator.commands.short_run import baseline_or_fail, run_again
from coordinator.runtime.exit_codes import EXIT_FAILED, EXIT_USAGE
from coordinator.runtime.terminal import Terminal
from module_agent.transport.endpoint import DEFAULT_ENDPOINT

CHECK = "check.json"
# Not a failure of the program, and not the robot's silence either.
EXIT_CHANGED = 4


def check_robot(
    known: Annotated[Path, typer.Argument(help="Folder of the run that the robot is known from.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the check, made new: a run, and check.json.")
    ] = None,
    measured: Annotated[
        Path | None, typer.Option(help="Compare with a run that is there already, without a robot.")
    ] = None,
    robot: Robot | None = None,
    listen: Listen = DEFAULT_ENDPOINT,
    connect: Connect = None,
    network: Network = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the injected network.")] = 0,
    expect: Expect = None,
    plan: Annotated[
        Path | None, typer.Option(help="TOML file with settings of the motions, which a check shortens.")
    ] = None,
    speed: Annotated[float, typer.Option(help="Speed of a simulated world.")] = 1.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print check.json instead of a table.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Measure a known robot again, in short, and say which of its links changed.

    Exit codes: 0 nothing changed, 4 a link or the modules changed, others as of `run`.
    """
    if (out is None) == (measured is None):
        fail("give either --out, to measure the robot, or --measured, a run to compare with", EXIT_USAGE)
    before = baseline_or_fail(known)
    folder = measured
    if out is not None:
        folder, short = out, check_plan(before, planned(plan))
        run_again(robot or before.name, out, short, listen, connect, network, seed, expect, speed, quiet)
    assert folder is not None
    report = _compared(before, baseline_or_fail(folder))
    write_check(folder / CHECK, report)
    _print(report, as_json)
    if report.changed:
        raise typer.Exit(EXIT_CHANGED)


def _compared(before: BaselineRobot, after: BaselineRobot) -> CheckReport:
    try:
        return check(before, after)
    except CheckError as error:
        fail(error, EXIT_FAILED)


def _print(report: CheckReport, as_json: bool) -> None:
    if as_json:
        typer.echo(report.model_dump_json(indent=1, by_alias=True))
        return
    if report.links:
        Terminal().console.print(table(report))
    for line in report.words:
        typer.echo(line)

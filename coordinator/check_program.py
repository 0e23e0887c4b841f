"""`x5-coordinator check`: is a known robot still what it was?"""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.attended_run import Place, run_attended, sender_name
from coordinator.check import CheckError, check, check_plan
from coordinator.check_report import CheckReport, table, write_check
from coordinator.command_options import Connect, Expect, Listen, Network, Robot, fail, planned
from coordinator.failure import EXIT_FAILED, EXIT_USAGE
from coordinator.known_robot import KnownRobot, KnownRobotError, load_known
from coordinator.run import RunConfig
from coordinator.scaled_loop import check_speed
from coordinator.terminal import Terminal
from module_agent.wire.endpoint import DEFAULT_ENDPOINT
from module_agent.wire.keys import check_chunk
from module_agent.wire.network_file import network as network_named

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
    before = _load(known)
    folder = measured
    if out is not None:
        folder = out
        try:
            check_chunk("robot", robot or before.name)
            check_speed(speed)
            place = Place(listen, tuple(connect or ()), network_named(network), seed)
        except ValueError as error:
            fail(error, EXIT_USAGE)
        config = RunConfig(
            robot=robot or before.name,
            out=out,
            sender=sender_name(),
            plan=check_plan(before, planned(plan)),
            expect=expect,
        )
        with Terminal(quiet) as terminal:
            run_attended(config, place, speed, terminal, "")
    assert folder is not None
    report = _compared(before, _load(folder))
    write_check(folder / CHECK, report)
    _print(report, as_json)
    if report.changed:
        raise typer.Exit(EXIT_CHANGED)


def _load(folder: Path) -> KnownRobot:
    try:
        return load_known(folder)
    except KnownRobotError as error:
        fail(error, EXIT_USAGE)


def _compared(before: KnownRobot, after: KnownRobot) -> CheckReport:
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

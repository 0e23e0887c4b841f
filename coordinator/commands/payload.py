"""`x5-coordinator payload`: what does a known robot carry?"""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.baseline.known_robot import BaselineRobot
from coordinator.baseline.payload import PayloadError, payload_plan, search_payload
from coordinator.baseline.payload_report import PayloadReport, write_payload
from coordinator.commands.options import Connect, Expect, Listen, Network, Robot, fail, planned
from coordinator.commands.short_run import baseline_or_fail, run_again
from coordinator.runtime.exit_codes import EXIT_FAILED, EXIT_USAGE
from module_agent.transport.endpoint import DEFAULT_ENDPOINT

PAYLOAD = "payload.json"


def find_payload(
    known: Annotated[
        Path, typer.Argument(help="Folder of the run that the robot is known from, inertia and all.")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder, made new: a short run, and payload.json.")] = None,
    measured: Annotated[
        Path | None, typer.Option(help="Compare with a run that is there already, without a robot.")
    ] = None,
    robot: Robot | None = None,
    listen: Listen = DEFAULT_ENDPOINT,
    connect: Connect = None,
    network: Network = "none",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the injected network.")] = 0,
    expect: Expect = None,
    plan: Annotated[Path | None, typer.Option(help="TOML file with settings of the motion.")] = None,
    speed: Annotated[float, typer.Option(help="Speed of a simulated world.")] = 1.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print payload.json instead of words.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Move a known robot for some ten seconds, and say what it carries: mass, centre, inertia, and where.

    Exit codes: 0 also if it carries nothing, others as of `run`.
    """
    if (out is None) == (measured is None):
        fail("give either --out, to move the robot, or --measured, a run to compare with", EXIT_USAGE)
    before = baseline_or_fail(known)
    folder = measured
    if out is not None:
        folder, short = out, payload_plan(before, planned(plan))
        run_again(robot or before.name, out, short, listen, connect, network, seed, expect, speed, quiet)
    assert folder is not None
    report = _searched(before, baseline_or_fail(folder))
    write_payload(folder / PAYLOAD, report)
    typer.echo(report.model_dump_json(indent=1) if as_json else "\n".join(report.words))


def _searched(before: BaselineRobot, after: BaselineRobot) -> PayloadReport:
    try:
        return search_payload(before, after)
    except PayloadError as error:
        fail(error, EXIT_FAILED)

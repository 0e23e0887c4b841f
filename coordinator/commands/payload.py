"""`x5-coordinator payload`: measure what a robot carries."""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.baseline.baseline_robot import load_baseline
from coordinator.baseline.payload import payload_plan, search_payload
from coordinator.baseline.payload_report import write_payload
from coordinator.commands.attended_run import run_short
from coordinator.commands.options import (
    AsJson,
    ConnectOptions,
    DynamicsFolder,
    Expect,
    Measured,
    PlanFile,
    Speed,
    planned,
)
from coordinator.runtime.command_line import with_options
from module_agent.model.errors import UsageError

PAYLOAD = "payload.json"


@with_options
def find_payload(
    baseline: DynamicsFolder,
    at: ConnectOptions,
    out: Annotated[Path | None, typer.Option(help="New folder for a short run, and payload.json.")] = None,
    measured: Measured = None,
    expect: Expect = None,
    plan: PlanFile = None,
    speed: Speed = 1.0,
    as_json: AsJson = False,
) -> None:
    """Move a robot for some ten seconds, and identify its payload: mass, centre, inertia, and where it is.

    Exit codes: 0 also without a payload, others as of `run`.
    """
    if (out is None) == (measured is None):
        raise UsageError("give either --out, to move the robot, or --measured, a run to compare with")
    before = load_baseline(baseline)
    if out is not None:
        after = run_short(before, at, out, payload_plan(before, planned(plan)), expect, speed)
    else:
        assert measured is not None
        after = load_baseline(measured)
    report = search_payload(before, after)
    write_payload(after.folder / PAYLOAD, report)
    typer.echo(report.model_dump_json(indent=1) if as_json else "\n".join(report.summary))

"""`x5-coordinator payload`: measure what a robot carries."""

import typer

from coordinator.baseline.baseline_robot import load_baseline
from coordinator.baseline.payload import payload_plan, search_payload
from coordinator.baseline.payload_report import write_payload
from coordinator.commands.attended_run import measured_again
from coordinator.commands.options import AgainOptions, AsJson, ConnectOptions, DynamicsFolder
from coordinator.runtime.command_line import with_options

PAYLOAD = "payload.json"


@with_options
def find_payload(
    baseline: DynamicsFolder, at: ConnectOptions, again: AgainOptions, as_json: AsJson = False
) -> None:
    """Move a robot for some ten seconds, and identify its payload: mass, centre, inertia, and where it is.

    Writes payload.json. Exit codes: 0 also without a payload, others as of `run`.
    """
    before = load_baseline(baseline)
    after = measured_again(before, at, again, payload_plan)
    report = search_payload(before, after)
    write_payload(after.folder / PAYLOAD, report)
    typer.echo(report.model_dump_json(indent=1) if as_json else "\n".join(report.summary))

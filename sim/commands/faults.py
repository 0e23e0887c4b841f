"""`x5-sim faults`: search by seeds for faults that the system does not survive."""

import re
from typing import Annotated, Any

import typer

from coordinator.runtime.terminal import new_table, print_table
from module_agent.model.errors import EXIT_FINDING, UsageError
from module_agent.model.files import write_json
from sim.benchmark.case import Failed, Trial
from sim.benchmark.workers import run_trials
from sim.commands.experiment import JsonFile, experiment, worker_count
from sim.commands.options import load
from sim.faults.report import OUTCOMES, SeedReport, by_fault, run_seed

_RANGE = re.compile(r"(\d{1,12})\.\.(\d{1,12})\Z")
# Processor time of a seed [s].
COST_S = 2.0


def faults(
    seeds: Annotated[str, typer.Option(help="Seeds A..B, both included.")],
    robot: Annotated[
        str | None, typer.Option(help="A robot of `x5-sim robots`, or a file [small ones, drawn].")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes that share the work [one for each core].")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Run sessions with faults in virtual time and judge them by the truth of the plant.

    Exit code 0 if no invariant is violated, 4 if one is, 2 for wrong usage, 130 if interrupted.
    """
    numbers = seed_range(seeds)
    chosen = load(robot) if robot is not None else None
    outcomes = _run([Trial(run_seed, (seed, chosen), COST_S) for seed in numbers], workers)
    reports = [one for one in outcomes if isinstance(one, SeedReport)]
    _print_table(reports)
    violated = 0
    for seed, one in zip(numbers, outcomes, strict=True):
        if isinstance(one, SeedReport) and not one.violations:
            continue
        violated += 1
        described = {"traceback": one.text} if isinstance(one, Failed) else one.violations
        option = f" --robot {robot}" if robot is not None else ""
        for kind, text in described.items():
            typer.echo(f"seed {seed}: {kind}: {text}", err=True)
        typer.echo(f"  repeat it with: x5-sim faults --seeds {seed}..{seed}{option}", err=True)
    named = [one.named_module for one in reports if one.named_module is not None]
    typer.echo(
        f"{len(numbers)} seeds, {violated} with violations; {sum(named)} of {len(named)} lost modules named"
    )
    if json_file is not None:
        write_json(json_file, figures(numbers, outcomes))
    if violated:
        raise typer.Exit(EXIT_FINDING)


def seed_range(text: str) -> range:
    """Return the seeds of `A..B`, both included.

    Raises:
        UsageError: the text is of another form, or B is below A.
    """
    match = _RANGE.match(text)
    if match is None or int(match[2]) < int(match[1]):
        raise UsageError(f"--seeds {text}: expected A..B with A not above B, such as 0..99")
    return range(int(match[1]), int(match[2]) + 1)


def figures(seeds: range, outcomes: list[Any]) -> dict[str, Any]:
    """Return the contents of the JSON file."""
    reports = [one for one in outcomes if isinstance(one, SeedReport)]
    return {
        "seeds": [seeds.start, seeds.stop - 1],
        "by_fault": {kind: dict(counted) for kind, counted in by_fault(reports).items()},
        "tracebacks": {
            s: one.text for s, one in zip(seeds, outcomes, strict=True) if isinstance(one, Failed)
        },
        "reports": [one._asdict() for one in reports],
    }


def _run(trials: list[Trial], workers: int | None) -> list[Any]:
    done = 0
    with experiment() as terminal:

        def show(index: int, result: Any) -> None:
            nonlocal done
            done += 1
            terminal.step(done, len(trials), f"seed {trials[index].arguments[0]}")

        return [each.result for each in run_trials(trials, worker_count(workers), show)]


def _print_table(reports: list[SeedReport]) -> None:
    table = new_table("Outcomes by fault", " | ".join(("fault", *(f">{one}" for one in OUTCOMES))))
    for kind, counted in by_fault(reports).items():
        table.add_row(kind, *(str(counted[one]) for one in OUTCOMES))
    print_table(table)

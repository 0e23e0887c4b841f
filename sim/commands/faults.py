"""`x5-sim faults`: search by seeds for faults that the system does not survive."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from coordinator.commands.options import JsonFile
from coordinator.runtime.terminal import STANDARD_OUTPUT, new_table, print_table, write_result
from module_agent.model.errors import EXIT_FINDING, UsageError
from module_agent.network_emulation.profile_file import network as check_network
from sim.benchmark.case import Failed, Trial
from sim.benchmark.dask_cluster import run_trials_on
from sim.benchmark.workers import run_trials
from sim.commands.experiment import experiment, worker_count
from sim.commands.options import load
from sim.faults.fault import Fault, fault_of
from sim.faults.invariants import NO_LINK, VAGUE_DEG, VAGUE_MM
from sim.faults.report import OUTCOMES, SeedReport, by_fault, lost_seed, run_seed
from sim.faults.schedule import PlanName, Schedule, draw, first_modules
from sim.physics.engine import Physics
from sim.thesis.experiment import Unit
from sim.thesis.study import Store, key

_RANGE = re.compile(r"(\d{1,12})\.\.(\d{1,12})\Z")
# Processor time of a seed [s].
COST_S = 1.0
# A seed that has not ended by then, its simpler sessions included, hangs: a busy machine takes a minute [s].
HANG_S = 900.0


def faults(
    seeds: Annotated[str, typer.Option(help="Seeds A..B, both included.")],
    robot: Annotated[
        str | None, typer.Option(help="A robot of `x5-sim robots`, or a file [small ones, drawn].")
    ] = None,
    modules: Annotated[
        int | None, typer.Option(min=2, help="Its first modules only [as many as drawn, or it has].")
    ] = None,
    network: Annotated[str | None, typer.Option(help="A network profile [drawn].")] = None,
    fault: Annotated[
        list[str] | None, typer.Option(help="A fault, as a report prints it; repeat for more [drawn].")
    ] = None,
    physics: Annotated[Physics, typer.Option(help="What moves the bodies.")] = "compiled",
    expect: Annotated[
        bool | None,
        typer.Option(
            help="Tell the coordinator how many modules there are, or do not [drawn].", show_default=False
        ),
    ] = None,
    plan: Annotated[
        PlanName | None, typer.Option(help="What the coordinator plans [drawn].", show_default=False)
    ] = None,
    shrink: Annotated[bool, typer.Option(help="Make what violates an invariant simpler.")] = True,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes that share the work [one for each core].")
    ] = None,
    dask: Annotated[
        str | None, typer.Option(help="A Dask scheduler to work on instead, such as tcp://10.0.0.5:8786.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder in which seeds are kept that are over: the same command continues."),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Run sessions with faults in virtual time and judge them by the truth of the plant.

    Exit code 0 if no invariant is violated, 4 if one is or a seed hangs or dies, 2 for wrong usage, 130 if
    interrupted.
    """
    numbers = seed_range(seeds)
    schedules = [
        _schedule(seed, robot, modules, network, fault, expect, plan)._replace(physics=physics)
        for seed in numbers
    ]
    units = [
        Unit(f"seed {one.seed}", run_seed, (one, shrink), kind=SeedReport, cost_s=COST_S) for one in schedules
    ]
    outcomes = _run(units, None if out is None else Store(out), workers, dask)
    reports = [
        lost_seed(schedule, one.how, one.text) if isinstance(one, Failed) else one
        for schedule, one in zip(schedules, outcomes, strict=True)
    ]
    if write_result(json_file, figures(numbers, reports)):
        _print_table(reports)
    violated = [one for one in reports if one.violations]
    for one in violated:
        typer.echo(described(one, robot), err=True)
    lost = Counter(one.outcome for one in violated if one.outcome != "violation")
    others = "".join(f", {count} {how}" for how, count in lost.items())
    drawn, begun = sum(len(one.faults) for one in reports), sum(len(one.kinds) for one in reports)
    named = [one.named_rightly for one in reports if one.named_rightly is not None]
    typer.echo(
        f"{len(numbers)} seeds, {len(violated) - lost.total()} with violations{others}; {sum(named)} of "
        f"{len(named)} errors and suspicions name what happened; {drawn - begun} of {drawn} faults had not "
        "begun when their session ended",
        err=json_file == STANDARD_OUTPUT,
    )
    wrong = [one for one in reports if one.outcome == "wrong though suspected"]
    for one in wrong:
        typer.echo(f"seed {one.seed}: wrong though suspected: {one.wrong}; suspected is {one.text}", err=True)
    if claims := claimed(reports):
        typer.echo(claims, err=json_file == STANDARD_OUTPUT)
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


def described(report: SeedReport, robot: str | None = None) -> str:
    """Return lines about a violation, with the commands that repeat it; `robot` as the user gave it."""
    lines = [f"seed {report.seed}: {kind}: {text}" for kind, text in report.violations.items()]
    lines.append(f"  repeat it with: x5-sim faults {report.options(robot)}")
    simplest = report.simplest
    if simplest is not None and simplest.options() != report.options():
        lines.append(f"  or simpler:     x5-sim faults {simplest.options(robot)}")
    return "\n".join(lines)


def claimed(reports: Sequence[SeedReport]) -> str:
    """Return a sentence on how wide the claims of right robots are; "" without any."""
    claims = [(one.claim, one.seed) for one in reports if one.claim is not None]
    if not claims:
        return ""
    vague = sum(claim.is_vague for claim, _ in claims)
    widest, seed = max(claims, key=lambda one: one[0].width)
    compared = [claim for claim, _ in claims if claim.link != NO_LINK]
    usual = (
        f", the widest claim of each is {np.median([one.mm for one in compared]):.1f} mm and "
        f"{np.median([one.deg for one in compared]):.2f} degrees in the median"
        if compared
        else ""
    )
    return (
        f"{vague} of {len(claims)} right robots are vague (a sigma above {VAGUE_MM:g} mm or {VAGUE_DEG:g} "
        f"degree, or no link compared){usual}; the widest: seed {seed}, {widest.link}, {widest.mm:.1f} mm, "
        f"{widest.deg:.2f} degrees"
    )


def figures(seeds: range, reports: Sequence[SeedReport]) -> dict[str, Any]:
    """Return the contents of the JSON file."""
    return {
        "seeds": [seeds.start, seeds.stop - 1],
        "by_fault": {kind: dict(counted) for kind, counted in by_fault(reports).items()},
        "reports": [_document(one) for one in reports],
    }


def _document(report: SeedReport) -> dict[str, Any]:
    simplest = report.simplest
    return report._asdict() | {"simplest": None if simplest is None else simplest._asdict()}


def _schedule(
    seed: int,
    robot: str | None,
    modules: int | None,
    network: str | None,
    faults: list[str] | None,
    expect: bool | None,
    plan: PlanName | None,
) -> Schedule:
    chosen = None if robot is None else load(robot)
    if chosen is not None and modules is not None:
        chosen = first_modules(chosen, modules)
    schedule = draw(seed, chosen, plan)
    if chosen is None and modules is not None:
        schedule = draw(seed, first_modules(schedule.robot, modules), plan)
    if network is not None:
        check_network(network)
        schedule = schedule._replace(network=network)
    if expect is not None:
        schedule = schedule._replace(expects=expect)
    if faults is not None:
        given = sorted((fault_of(text) for text in faults), key=lambda fault: fault.at_s)
        schedule = schedule._replace(faults=tuple(_of_robot(one, schedule) for one in given))
    return schedule


def _of_robot(fault: Fault, schedule: Schedule) -> Fault:
    count = len(schedule.robot.modules)
    if fault.module >= count:
        raise UsageError(f"--fault {fault}: {schedule.robot.name} has modules 0 to {count - 1} here")
    return fault


def _run(units: Sequence[Unit], store: Store | None, workers: int | None, dask: str | None) -> list[Any]:
    """Return the outcome of each unit; those that the store has are not run again."""
    names = ["" if store is None else key(unit) for unit in units]
    outcomes = [None if store is None else store.load(*one) for one in zip(names, units, strict=True)]
    missing = [index for index, outcome in enumerate(outcomes) if outcome is None]
    done = len(units) - len(missing)
    kept = "nothing is written" if store is None else "what is over is kept: the same command continues"
    with experiment(kept) as terminal:

        def show(number: int, result: Any) -> None:
            nonlocal done
            done += 1
            index = missing[number]
            outcomes[index] = result
            if store is not None and not isinstance(result, Failed):
                store.keep(names[index], units[index], result)
            terminal.step(done, len(units), units[index].name)

        trials = [Trial(run_seed, units[index].arguments, COST_S, limit_s=HANG_S) for index in missing]
        if dask is not None:
            run_trials_on(dask, trials, show)
        else:
            run_trials(trials, worker_count(workers), show)
    return outcomes


def _print_table(reports: list[SeedReport]) -> None:
    rows = {kind: counted for kind, counted in by_fault(reports).items() if counted}
    rows["all seeds"] = Counter(one.outcome for one in reports)
    found = [one for one in OUTCOMES if any(counted[one] for counted in rows.values())]
    table = new_table("Outcomes by fault", " | ".join(("fault", *(f">{one}" for one in found))))
    for kind, counted in rows.items():
        table.add_row(kind, *(str(counted[one]) for one in found))
    print_table(table)

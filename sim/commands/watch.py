"""`x5-sim watch`: hours of everyday use under the monitor, unchanged and with changes that grow slowly."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from coordinator.commands.options import JsonFile
from coordinator.excitation.plan import Excitation
from coordinator.monitoring.reference import ALARMS_PER_HOUR
from coordinator.runtime.terminal import figure, new_table, print_table, write_result
from module_agent.model.errors import UsageError
from module_agent.model.suggestion import did_you_mean
from sim.benchmark.monitored_life import (
    LIVES,
    OUTCOMES,
    Life,
    LifePlan,
    false_alarms,
    lives,
    monitored_life,
    summary,
)
from sim.benchmark.slow_change import CHANGE_KINDS, ChangeKind
from sim.commands.experiment import ProfileName, WorkerCount, measured_units
from sim.commands.options import Seed, load
from sim.imperfections.noise_profile import DEFAULT_PROFILE, noise_profile
from sim.thesis.experiment import Unit
from sim.thesis.study import Store, code_version, key

ROBOTS = ("a2085_03", "a2085_06")
# Processor time of a simulated second, by the number of modules, and of making a robot known [s].
_COST_PER_S, _KNOWN_COST_S = 0.012, 5.0


def watch(
    seed: Seed = 0,
    robot: Annotated[
        list[str] | None,
        typer.Option(help=f"A robot of `x5-sim robots`, or a file; repeat for more [{', '.join(ROBOTS)}]."),
    ] = None,
    noise: ProfileName = DEFAULT_PROFILE,
    excitation: Annotated[
        Excitation, typer.Option(help="Of the run that a robot is known from, as of `x5-coordinator run`.")
    ] = "d-optimal",
    hours: Annotated[
        float, typer.Option(min=0.0, max=10_000.0, help="Time in which nothing changes, all robots together.")
    ] = 1.0,
    trials: Annotated[
        int, typer.Option(min=0, max=400, help="Lives of each robot with each kind of change.")
    ] = 1,
    kind: Annotated[
        list[str] | None,
        typer.Option(help=f"A kind of change; repeat for more [all: {', '.join(CHANGE_KINDS)}]."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder in which lives are kept that are over.")] = Path(
        "runs/watch"
    ),
    processes: WorkerCount = None,
    json_file: JsonFile = None,
) -> None:
    """Attend to robots in everyday use by the monitor, and compare what it says with what happened.

    What is over is kept: the same command continues after an interruption.
    """
    robots = tuple(robot or ROBOTS)
    for one in robots:
        load(one)
    noise_profile(noise)
    kinds = [_kind(one) for one in kind or CHANGE_KINDS]
    planned = lives(robots, hours, kinds, trials, seed, noise, excitation)
    if not planned:
        raise UsageError("--hours 0 and --trials 0 leave nothing to do")
    units = {key(unit): unit for unit in map(_unit, planned)}
    done: list[Life] = list(measured_units(units, Store(out / "lives"), processes).values())
    if not write_result(json_file, figures(done)):
        return
    if any(one.change is not None for one in done):
        print_table(change_table(done))
    for text in alarm_lines(done):
        typer.echo(text)


def _kind(name: str) -> ChangeKind:
    for one in CHANGE_KINDS:
        if name == one:
            return one
    near, known = did_you_mean(name, CHANGE_KINDS), ", ".join(CHANGE_KINDS)
    raise UsageError(f"--kind {name}: no such change{near}; there are {known}")


def _unit(plan: LifePlan) -> Unit:
    modules = len(load(plan.robot).modules)
    cost_s = modules * (_COST_PER_S * plan.for_s + _KNOWN_COST_S / LIVES)
    name = f"{plan.robot}, {plan.change or 'unchanged'}"
    return Unit(name, monitored_life, (plan,), Life, cost_s, shares=f"{plan.robot} {plan.seed}")


def change_table(done: Sequence[Life]) -> Table:
    """Return what became of every kind of change."""
    columns = ("change", "lives", *OUTCOMES, "after, median [s]", "size then", "called")
    table = new_table("Slow changes by what they were named", " | ".join(columns))
    for kind, one in summary(done).items():
        size = "-" if one.size is None else f"{one.size:.2g} {one.unit}"
        called = ", ".join(f"{word} {times}" for word, times in sorted(one.called.items()))
        counts = (str(one.outcomes[outcome]) for outcome in OUTCOMES)
        table.add_row(kind, str(one.lives), *counts, figure(one.named_s, ".0f"), size, called or "-")
    return table


def alarm_lines(done: Sequence[Life]) -> list[str]:
    """Return false alarms by robot and of all, and the speed, as sentences."""
    names = list(dict.fromkeys(one.plan.robot for one in done))
    parts = [(name, [one for one in done if one.plan.robot == name]) for name in names]
    texts = []
    for name, own in [*parts, ("together", list(done))] if len(parts) > 1 else parts:
        alarms = false_alarms(own)
        low, high = alarms.interval_per_hour()
        texts.append(
            f"{name}: {alarms.alarms} false alarms in {alarms.monitored_s / 3600.0:.2f} h: "
            f"{alarms.per_hour:.2f} an hour, 95 % interval {low:.2f} to {high:.2f}, "
            f"asked for {ALARMS_PER_HOUR:g}; {_speed(own):.0f} simulated hours a core hour"
        )
    return texts


def _speed(done: Sequence[Life]) -> float:
    return sum(one.monitored_s for one in done) / max(sum(one.cpu_s for one in done), 1e-9)


def figures(done: Sequence[Life]) -> dict[str, Any]:
    """Return the contents of the JSON file."""
    alarms = false_alarms(done)
    return {
        "code": code_version(),
        "false_alarms": alarms.alarms,
        "unchanged_s": alarms.monitored_s,
        "per_hour": alarms.per_hour,
        "per_hour_interval_95": alarms.interval_per_hour(),
        "simulated_per_core_hour": _speed(done),
        "changes": {kind: one._asdict() for kind, one in summary(done).items()},
        "lives": [_document(one) for one in done],
    }


def _document(life: Life) -> dict[str, Any]:
    change = None if life.change is None else life.change._asdict()
    return life._asdict() | {
        "plan": life.plan._asdict(),
        "change": change,
        "outcome": None if life.change is None else life.outcome,
        "said": [one._asdict() for one in life.said],
    }

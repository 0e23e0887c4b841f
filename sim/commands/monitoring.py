"""`x5-sim monitoring`: the monitor on simulated robots with an event, or without."""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from coordinator.commands.options import JsonFile
from coordinator.monitoring.findings import KINDS, UNITS, Kind
from coordinator.runtime.terminal import figure, new_table, print_table, write_result
from sim.benchmark.case import Trial
from sim.benchmark.cases.monitoring import (
    AFTER_S,
    ARM,
    COST_PER_S,
    QUICK_AFTER_S,
    QUICK_SEGMENT_S,
    SEGMENT_S,
    UNCHANGED_DAY,
    Alarms,
    Found,
    MonitoringTrial,
    Subject,
    confusion,
    false_alarms,
    monitoring_trial,
    sum_of,
)
from sim.commands.experiment import ProfileName, WorkerCount, experiment, trial_results
from sim.commands.options import Seed, load
from sim.imperfections.noise_profile import noise_profile

_KINDS: tuple[Kind, ...] = ("collision", "payload", "friction", "wear")


def monitoring(
    seed: Seed = 0,
    robot: Annotated[str, typer.Option(help="A robot of `x5-sim robots`, or a file.")] = ARM.robot,
    noise: ProfileName = ARM.noise,
    trials: Annotated[int, typer.Option(min=1, max=400, help="Trials of each kind.")] = 10,
    hours: Annotated[
        float, typer.Option(min=0.01, max=30.0, help="Time for which unchanged robots are monitored.")
    ] = 1.0,
    quick: Annotated[
        bool, typer.Option("--quick", help="One short trial of each kind, and some seconds without change.")
    ] = False,
    processes: WorkerCount = None,
    json_file: JsonFile = None,
) -> None:
    """Monitor known robots that move, with an event or without, and count the findings."""
    load(robot)
    noise_profile(noise)
    subject = Subject(robot=robot, noise=noise, seed=seed, brief=quick)
    if quick:
        trials, after_s, segments = 1, QUICK_AFTER_S, [QUICK_SEGMENT_S]
    else:
        after_s, segments = AFTER_S, [SEGMENT_S] * max(1, round(3600.0 * hours / SEGMENT_S))
    results = _run(subject, trials, after_s, segments, processes)
    happened = [one for one in results if isinstance(one, MonitoringTrial)]
    quiet = [one for one in results if isinstance(one, Alarms)]
    alarms = sum_of(quiet)
    if not write_result(json_file, figures(happened, alarms)):
        return
    print_table(confusion_table(happened))
    print_table(size_table(happened))
    low, high = alarms.interval_per_hour()
    typer.echo(
        f"{alarms.alarms} false alarms in {alarms.monitored_s / 3600.0:.2f} h of motion: "
        f"{alarms.per_hour:.2f} an hour, 95 % interval {low:.2f} to {high:.2f}"
    )


def confusion_table(trials: Sequence[MonitoringTrial]) -> Table:
    """Return the confusion matrix: kinds of events by kinds of findings."""
    counted = confusion(trials)
    columns: tuple[Found, ...] = ("nothing", *KINDS)
    table = new_table("Findings by event", " | ".join(("event", *columns, "right module")))
    for happened, row in counted.items():
        own = [trial for trial in trials if trial.happened == happened]
        cells = [str(row[column]) if column in row else "-" for column in columns]
        table.add_row(happened, *cells, f"{sum(t.located for t in own)} of {len(own)}")
    return table


def size_table(trials: Sequence[MonitoringTrial]) -> Table:
    """Return latencies and errors of sizes by kind of event."""
    table = new_table(
        "Median; how large", "event | first finding [s] | its kind [s] | size | error, rms | largest"
    )
    for kind, one in summary(trials).items():
        sizes = f"{one['smallest']:.2f} to {one['largest']:.2f} {UNITS[kind]}" if one["sized"] else "-"
        table.add_row(
            kind,
            figure(one["first_finding_s"], ".3f"),
            figure(one["named_s"], ".2f"),
            sizes,
            figure(one["error_rms"], ".3f"),
            figure(one["error_largest"], ".3f"),
        )
    return table


def summary(trials: Sequence[MonitoringTrial]) -> dict[Kind, dict[str, Any]]:
    """Return the figures of every kind; None where there is nothing to measure."""
    by_kind: dict[Kind, dict[str, Any]] = {}
    for kind in _KINDS:
        own = [trial for trial in trials if trial.happened == kind]
        if not own:
            continue
        errors = np.array([t.size_error for t in own if t.size_error is not None])
        by_kind[kind] = {
            "trials": len(own),
            "right": sum(t.found == kind for t in own),
            "located": sum(t.located for t in own),
            "false_alarms": sum(t.false_alarms for t in own),
            "first_finding_s": _median([t.latency_s for t in own]),
            "named_s": _median([t.named_s for t in own]),
            "sized": bool(errors.size),
            "smallest": min(t.size for t in own),
            "largest": max(t.size for t in own),
            "error_rms": float(np.sqrt(np.mean(errors**2))) if errors.size else None,
            "error_largest": float(np.abs(errors).max()) if errors.size else None,
        }
    return by_kind


def figures(trials: Sequence[MonitoringTrial], alarms: Alarms) -> dict[str, object]:
    """Return the contents of the JSON file."""
    return {
        "confusion": confusion(trials),
        "kinds": summary(trials),
        "false_alarms": alarms.alarms,
        "monitored_s": alarms.monitored_s,
        "per_hour": alarms.per_hour,
        "per_hour_interval_95": alarms.interval_per_hour(),
        "trials": [trial._asdict() for trial in trials],
    }


def _run(
    subject: Subject, trials: int, after_s: float, segments: Sequence[float], processes: int | None
) -> list[MonitoringTrial | Alarms]:
    work = [
        Trial(monitoring_trial, (kind, day, subject, after_s), COST_PER_S * (after_s + 10.0))
        for kind in _KINDS
        for day in range(trials)
    ]
    work += [
        Trial(false_alarms, (UNCHANGED_DAY + k, for_s, subject), COST_PER_S * for_s)
        for k, for_s in enumerate(segments)
    ]
    with experiment() as terminal:
        return trial_results(terminal, work, processes, lambda _: "monitoring")


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None

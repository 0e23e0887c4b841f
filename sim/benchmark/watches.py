"""Watching: what happens to a robot that moves is named; where nothing happens there is no alarm."""

from collections.abc import Sequence
from functools import partial
from statistics import median
from typing import NamedTuple

from scipy.stats import binom

from coordinator.watching.levels import ALARMS_PER_HOUR
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row
from sim.experiments.watching import (
    AFTER_S,
    ARM,
    HAPPENS,
    Alarms,
    Happens,
    WatchTrial,
    false_alarms,
    watch_trial,
)

# Of what happens: some of what is drawn turns no joint, or stays in the noise.
MISSED_SHARE = 0.2
# That chance alone leaves a bar: one case in so many.
ONE_IN = 100.0
STRETCH_S = 300.0
_QUICK_AFTER_S, _QUICK_STRETCH_S = 5.0, 8.0
# Trials of unchanged robots are days of their own.
_UNCHANGED_DAY = 500
_KNOWN_COST_S, _COST_PER_S = 8.0, 0.2


class Watches(NamedTuple):
    """What became of trials, and of stretches without any change."""

    trials: tuple[WatchTrial, ...]
    quiet: tuple[Alarms, ...]


def watch_cases(trials: int, stretches: int, seed: int, shortened: bool = False) -> list[Case]:
    """Return the one case: every kind so many times, and stretches of no change.

    `shortened`: trials and stretch are short, all in one process, which learns to know the robot once.
    """
    kinds = [one for one in HAPPENS if one != "nothing"]
    after_s, stretch_s = (_QUICK_AFTER_S, _QUICK_STRETCH_S) if shortened else (AFTER_S, STRETCH_S)
    name = f"{ARM.robot}, watched"
    drawn = [(kind, seed * 100 + number) for number in range(trials) for kind in kinds]
    quiet = [_UNCHANGED_DAY + number for number in range(stretches)]
    pieces = [(tuple(drawn), tuple(quiet))] if shortened else _shares(drawn, quiet)
    work = tuple(
        Trial(
            watches_of_one_robot,
            (own, still, after_s, stretch_s, shortened),
            _KNOWN_COST_S + _COST_PER_S * (len(own) * (12.0 + after_s) + len(still) * stretch_s),
        )
        for own, still in pieces
    )
    return [Case(name, work, partial(_summary, name))]


def watches_of_one_robot(
    drawn: Sequence[tuple[Happens, int]],
    quiet: Sequence[int],
    after_s: float,
    stretch_s: float,
    shortened: bool,
) -> Watches:
    """Let a process learn to know a robot, and watch it for all of its trials."""
    subject = ARM._replace(brief=shortened)
    return Watches(
        tuple(watch_trial(kind, seed, subject, after_s) for kind, seed in drawn),
        tuple(false_alarms(day, stretch_s, subject) for day in quiet),
    )


def _shares(
    drawn: Sequence[tuple[Happens, int]], quiet: Sequence[int]
) -> list[tuple[tuple[tuple[Happens, int], ...], tuple[int, ...]]]:
    """Return pieces of work of some minutes each."""
    count = max(1, -(-len(drawn) // 12), len(quiet))
    return [(tuple(drawn[k::count]), tuple(quiet[k::count])) for k in range(count)]


def _summary(case: str, found: Sequence[Watches]) -> Summary:
    trials = [trial for one in found for trial in one.trials]
    quiet = [alarms for one in found for alarms in one.quiet]
    rows = []
    for kind in dict.fromkeys(trial.happened for trial in trials):
        own = [trial for trial in trials if trial.happened == kind]
        wrong = sum(not (trial.found == kind and trial.located) for trial in own)
        said = [trial.named_s for trial in own if trial.named_s is not None]
        # With as many trials chance makes so many of that share.
        limit = float(binom.isf(1.0 / ONE_IN, len(own), MISSED_SHARE))
        rows += [
            Row(case, f"{kind}: missed or misplaced, of {len(own)}", None, float(wrong), None, limit),
            Row(case, f"{kind}: named after, median [s]", None, median(said) if said else None),
        ]
    total = Alarms(sum(one.alarms for one in quiet), sum(one.watched_s for one in quiet))
    low, high = total.interval_per_hour()
    hours = total.watched_s / 3600.0
    beside = sum(trial.false_alarms for trial in trials)
    rows += [
        Row(case, f"something else said beside it, in {len(trials)} trials", None, float(beside)),
        Row(case, f"false alarms in {hours:.2g} h", None, float(total.alarms)),
        Row(case, "false alarms, 95 % sure to be above [1/h]", None, low, None, ALARMS_PER_HOUR),
        Row(case, "false alarms, 95 % sure to be below [1/h]", None, high),
    ]
    return Summary(tuple(rows))

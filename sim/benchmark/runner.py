"""Runs the cases of a benchmark in worker processes, all their trials mixed, and hears how it goes."""

from collections.abc import Callable, Sequence
from typing import Any

from sim.benchmark.case import Case, CaseResult, concluded
from sim.benchmark.workers import run_trials


def run_cases(
    cases: Sequence[Case], processes: int, on_trial: Callable[[Case, int], None] = lambda case, left: None
) -> list[CaseResult]:
    """Run all trials of all cases; `on_trial` is told of the case of each, and how many it has left.

    The results do not depend on the number of processes.
    """
    owner = [(number, case) for number, case in enumerate(cases) for _ in case.trials]
    left = [len(case.trials) for case in cases]

    def done(index: int, _result: object) -> None:
        number, case = owner[index]
        left[number] -= 1
        on_trial(case, left[number])

    results = run_trials([trial for case in cases for trial in case.trials], processes, done)
    own: list[list[Any]] = [[] for _ in cases]
    for (number, _), result in zip(owner, results, strict=True):
        own[number].append(result)
    return [concluded(case, found) for case, found in zip(cases, own, strict=True)]

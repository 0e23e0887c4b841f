"""Runs the cases of a benchmark in worker processes, all their trials mixed, and hears how it goes."""

from collections.abc import Callable, Sequence

from sim.benchmark.case import Case, CaseResult, concluded
from sim.benchmark.workers import Done, run_trials


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

    found = run_trials([trial for case in cases for trial in case.trials], processes, done)
    own: list[list[Done]] = [[] for _ in cases]
    for (number, _), each in zip(owner, found, strict=True):
        own[number].append(each)
    return [
        concluded(case, [each.result for each in mine], sum(each.cpu_s for each in mine))
        for case, mine in zip(cases, own, strict=True)
    ]

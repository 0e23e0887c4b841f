"""Wear: a link of a known arm that has changed is found, located and sized; no other is called changed."""

from collections.abc import Sequence
from functools import partial

from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, largest, scaled
from sim.experiments.wear import DAYS, WearTrial, wear_trial

ROBOT = "a2085_06"
CHANGE_M = 2e-3
SIZE_MM = 0.5
CHECK_S = 60.0
_KNOWN_COST_S, _CHECK_COST_S = 18.0, 10.0


def wear_cases(changed: int, unchanged: int, seed: int) -> list[Case]:
    """Return the two cases; a robot is recorded once for the checks of all its days."""
    worn = f"{ROBOT}, one link changed by {1e3 * CHANGE_M:.0f} mm"
    same = f"{ROBOT}, unchanged"
    return [
        Case(worn, _work(seed, changed, True), partial(_changed, worn)),
        Case(same, _work(seed, unchanged, False), partial(_unchanged, same)),
    ]


def wear_days(seeds: Sequence[int], changed: bool) -> list[WearTrial]:
    """Check a robot on several days, one after the other in one process."""
    return [wear_trial(seed, changed, ROBOT, change_m=CHANGE_M) for seed in seeds]


def _work(seed: int, checks: int, changed: bool) -> tuple[Trial, ...]:
    # Another thousand robots for another seed: no benchmark makes that many.
    first = 1000 * DAYS * seed
    days = [range(first + begin, first + min(begin + DAYS, checks)) for begin in range(0, checks, DAYS)]
    return tuple(
        Trial(wear_days, (tuple(each), changed), _KNOWN_COST_S + _CHECK_COST_S * len(each)) for each in days
    )


def _changed(case: str, days: Sequence[Sequence[WearTrial]]) -> Summary:
    checks = [check for day in days for check in day]
    wrong = sum(not (check.found and check.located) for check in checks)
    size_mm = scaled(largest([check.size_error_m for check in checks]), 1e3)
    rows = (
        Row(case, f"not found, or not located, of {len(checks)}", None, float(wrong), None, 0.0),
        Row(case, "size of the change, largest error [mm]", None, size_mm, None, SIZE_MM),
        _time(case, checks),
    )
    return Summary(rows)


def _unchanged(case: str, days: Sequence[Sequence[WearTrial]]) -> Summary:
    checks = [check for day in days for check in day]
    alarms = sum(check.false_alarm for check in checks)
    rows = (Row(case, f"false alarms, of {len(checks)}", None, float(alarms), None, 0.0), _time(case, checks))
    return Summary(rows)


def _time(case: str, checks: Sequence[WearTrial]) -> Row:
    spent = largest([check.robot_time_s for check in checks])
    return Row(case, "robot time of a check, longest [s]", None, spent, None, CHECK_S)

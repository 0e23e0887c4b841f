"""Wear: a link of a known arm that has changed is found, located and sized; no other is called changed."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

from coordinator.plan import Plan
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, count, largest, scaled
from sim.experiments.wear import DAYS, WearTrial, wear_trial

ROBOT = "a2085_06"
CHANGE_M = 2e-3
SIZE_MM = 0.5
CHECK_S = 60.0
_KNOWN_COST_S, _CHECK_COST_S = 11.0, 11.0
# A quarter of that where all joints are moved at once.
AT_ONCE = Plan(mode="whole", dynamics=False)
_AT_ONCE_SHARE = 0.3


class Checks(NamedTuple):
    """Checks of one robot, with a link changed and as it was."""

    changed: tuple[WearTrial, ...]
    unchanged: tuple[WearTrial, ...]


def wear_cases(changed: int, unchanged: int, seed: int, shortened: bool = False) -> list[Case]:
    """Return the one case; each of its trials is about one robot, recorded once for all its checks.

    `shortened`: the robot is known and checked by a motion of all joints at once, not joint by joint.
    """
    robots = max(-(-unchanged // DAYS), -(-changed // DAYS), 1)
    # Another thousand robots for another seed: no benchmark makes that many.
    first = 1000 * DAYS * seed
    days = [range(first + DAYS * robot, first + DAYS * (robot + 1)) for robot in range(robots)]
    work = []
    for robot, own in enumerate(days):
        worn, same = own[: _share(changed, robots, robot)], own[: _share(unchanged, robots, robot)]
        cost_s = _KNOWN_COST_S + _CHECK_COST_S * (len(worn) + len(same))
        plan, share = (AT_ONCE, _AT_ONCE_SHARE) if shortened else (None, 1.0)
        work.append(Trial(checks_of_one_robot, (tuple(worn), tuple(same), plan), share * cost_s))
    name = f"{ROBOT}, wear" + (", by all joints at once" if shortened else "")
    return [Case(name, tuple(work), partial(_summary, name))]


def checks_of_one_robot(changed: Sequence[int], unchanged: Sequence[int], plan: Plan | None = None) -> Checks:
    """Check a robot on several days, one after the other in one process; plan: see `wear_trial`."""
    return Checks(
        tuple(wear_trial(seed, True, ROBOT, change_m=CHANGE_M, plan=plan) for seed in changed),
        tuple(wear_trial(seed, False, ROBOT, change_m=CHANGE_M, plan=plan) for seed in unchanged),
    )


def _share(checks: int, robots: int, robot: int) -> int:
    """Return how many of the checks are those of one robot."""
    return checks // robots + (robot < checks % robots)


def _summary(case: str, robots: Sequence[Checks]) -> Summary:
    changed = [check for robot in robots for check in robot.changed]
    unchanged = [check for robot in robots for check in robot.unchanged]
    size_mm = scaled(largest([check.size_error_m for check in changed]), 1e3)
    spent_s = largest([check.robot_time_s for check in changed + unchanged])
    what = f"{1e3 * CHANGE_M:.0f} mm"
    return Summary(
        (
            count(case, f"{what} not found, or not located", [not (c.found and c.located) for c in changed]),
            Row(case, f"size of the {what}, largest error [mm]", None, size_mm, None, SIZE_MM),
            count(case, "false alarms without a change", [check.false_alarm for check in unchanged]),
            Row(case, "robot time of a check, longest [s]", None, spent_s, None, CHECK_S),
        )
    )

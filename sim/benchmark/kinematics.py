"""The benchmark of kinematics: its cases, and what holds over all of them."""

from collections.abc import Sequence
from fnmatch import fnmatch
from typing import NamedTuple

from coordinator.plan import Motions
from sim.benchmark.arms import SHORTENED, arm_cases
from sim.benchmark.case import Case, CaseResult
from sim.benchmark.joints import joint_cases
from sim.benchmark.networks import network_cases
from sim.benchmark.row import Row, coverage
from sim.benchmark.topologies import topology_cases
from sim.benchmark.wears import wear_cases
from sim.experiments.arm_trial import arm_plan

KINEMATIC_TRIALS = 13
ALL = "all cases"


class KinematicEffort(NamedTuple):
    """How many trials there are of everything; `shortened`: whether arms move less long than they may."""

    joints: int
    arms: int
    robots: int
    networks: int
    changed: int
    unchanged: int
    shortened: bool = False


QUICK_KINEMATICS = KinematicEffort(joints=1, arms=1, robots=1, networks=1, changed=1, unchanged=1, shortened=True)


def full_kinematics(trials: int = KINEMATIC_TRIALS) -> KinematicEffort:
    """Return the effort that the bars are meant for, with that many trials a case."""
    return KinematicEffort(trials, trials, robots=200, networks=trials, changed=trials, unchanged=100)


def kinematic_cases(effort: KinematicEffort, seed: int, motions: Motions | None = None) -> list[Case]:
    """Return all cases, in the order in which they are reported; `motions`: see `arm_plan`."""
    calibrated = arm_plan("joint", "calibrated", motions)
    plan = calibrated.model_copy(update=SHORTENED) if effort.shortened else calibrated
    return [
        *joint_cases(effort.joints, seed),
        *arm_cases(effort.arms, seed, effort.shortened, motions),
        *topology_cases(effort.robots, seed, effort.shortened),
        *network_cases(effort.networks, seed, plan),
        *wear_cases(effort.changed, effort.unchanged, seed, effort.shortened),
    ]


def chosen(cases: Sequence[Case], pattern: str) -> list[Case]:
    """Return the cases whose name holds the pattern, in which * and ? stand for anything."""
    return [case for case in cases if fnmatch(case.name, f"*{pattern}*")]


def over_all(results: Sequence[CaseResult]) -> list[Row]:
    """Return the rows that are about all cases together; none where no case claimed an interval."""
    off = [value for result in results for value in result.summary.sigmas_off]
    return [coverage(ALL, off)] if off else []

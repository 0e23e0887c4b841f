"""Link change: a displaced link of a known robot is detected, located and sized; no other is reported.

The robot is recorded once and checked on many days: the modules and their errors stay the same, noise, drift
and network differ.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.baseline.baseline_robot import BaselineRobot
from coordinator.baseline.check import check, check_plan
from coordinator.excitation.plan import Plan
from coordinator.identification.identified import Kinematics
from coordinator.identification.identify import identify_kinematics
from module_agent.model.chain import BASE, Array, Chain
from module_agent.network_emulation.profile_file import network
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, count, largest, scaled
from sim.geometry.link_parts import FreePose, Part
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain
from sim.robot.variants import at_random_site
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session

ROBOT = "a2085_06"
NOISE = "x5-uncalibrated"
CHANGE_M = 2e-3
# Seeds that share a robot: it is recorded once for all of them in a process.
DAYS = 20
PARALLEL = 0.999


class LinkChangeTrial(NamedTuple):
    """The result of one check of a robot with one displaced link, or none.

    located: the check reported a change, and named exactly the displaced link. size_error_m: error of the
    displacement's length, None if it was not located. false_alarm: a link was named that had not changed.
    """

    located: bool
    size_error_m: float | None
    false_alarm: bool
    robot_time_s: float


class LinkChange(NamedTuple):
    """A link's far end displaced by `displacement_m` (3,), in the frame of the IMU of its module `child`."""

    child: str
    displacement_m: Array


def link_change_trial(seed: int, changed: bool, plan: Plan | None = None) -> LinkChangeTrial:
    """Check a known robot with one link displaced, or unchanged.

    Args:
        seed: `DAYS` successive seeds are days of the same robot; link and direction follow from it.
        changed: whether a link is displaced.
        plan: of the session that the robot is known from; its motions are those of the check.
    """
    known = _known(seed // DAYS, plan or Plan(dynamics=False))
    change = draw_link_change(load_robot(ROBOT), seed, CHANGE_M) if changed else None
    report = check(known, _recorded(seed // DAYS, 1 + seed % DAYS, check_plan(known, Plan()), change))
    named = [link for link in report.links if link.changed]
    if change is None:
        return LinkChangeTrial(False, None, report.changed, report.robot_time_s)
    located = report.changed and [link.child for link in named] == [change.child]
    size_error_m = None
    if located:
        size_m = np.linalg.norm(1e-3 * np.array(named[0].displacement_mm))
        size_error_m = float(abs(size_m - np.linalg.norm(change.displacement_m)))
    wrong = any(link.child != change.child for link in named)
    return LinkChangeTrial(located, size_error_m, wrong, report.robot_time_s)


def with_link_change(robot: Robot, change: LinkChange) -> Robot:
    """Return a robot with one link displaced at its far end, with everything beyond it.

    Raises:
        ValueError: the robot has no such module.
    """
    if change.child not in robot.serials:
        raise ValueError(
            f"robot {robot.name} has no module {change.child}; it has {', '.join(robot.serials)}"
        )
    k = robot.serials.index(change.child)
    # The link ends in the module's housing frame, or in its output frame: at q = 0 both are parallel to its
    # IMU's.
    x, y, z = (float(v) for v in change.displacement_m)
    part = Part(pose=FreePose(xyz_m=(x, y, z)))
    module = robot.modules[k]
    longer = module.model_copy(update={"link": (*module.link, part)})
    return robot.model_copy(update={"modules": (*robot.modules[:k], longer, *robot.modules[k + 1 :])})


def draw_link_change(robot: Robot, seed: int, change_m: float) -> LinkChange:
    """Draw a link and an observable direction.

    A displacement along an axis shows in the motions of the joints further up; where all of these have
    parallel axes, as at the first link of an arm, no joint's motion shows it.
    """
    rng = np.random.default_rng((seed, 0x57EA2))
    chain = true_chain(robot)
    k = int(rng.integers(1, len(chain.serials)))
    direction = rng.standard_normal(3)
    hidden = _hidden(chain, k)
    if hidden is not None:
        direction -= hidden * (hidden @ direction)
    root = direction / np.linalg.norm(direction)
    return LinkChange(chain.serials[k], change_m * chain.imu_home[k, :3, :3].T @ root)


def _hidden(chain: Chain, child: int) -> Array | None:
    """Return the unobservable direction of a displacement in the root frame, None if there is none."""
    parent = chain.parent[child]
    axes = chain.axis[list(chain.ancestors(parent))] if parent != BASE else np.zeros((0, 3))
    return axes[-1] if len(axes) and np.all(np.abs(axes @ axes[-1]) > PARALLEL) else None


@lru_cache(maxsize=1)
def _known(seed: int, plan: Plan) -> BaselineRobot:
    return _recorded(seed, 0, plan, None)


def _recorded(seed: int, day: int, plan: Plan, change: LinkChange | None) -> BaselineRobot:
    robot = at_random_site(load_robot(ROBOT), seed)
    robot = robot if change is None else with_link_change(robot, change)
    # Other robots have other days: no two checks share their noise.
    noise_seed = seed * (DAYS + 1) + day
    settings = VirtualSettings(robot, network("lan"), seed, NOISE, noise_seed=noise_seed)
    return known_robot(settings, plan, day)


def known_robot(settings: VirtualSettings, plan: Plan, day: int) -> BaselineRobot:
    """Record a robot on one of its days and identify its chain: what other days are compared with."""
    explored: list[Kinematics] = []
    recording = record_session(settings, plan, on_explored=explored.append)
    kinematics = identify_kinematics(recording, explored=explored[0] if explored else None)
    return BaselineRobot(Path(f"day {day}"), recording, kinematics)


SIZE_MM = 0.5
CHECK_S = 60.0
_KNOWN_COST_S, _CHECK_COST_S = 11.0, 11.0
# A quarter of that where all joints are moved at once.
AT_ONCE = Plan(mode="simultaneous", dynamics=False)
_AT_ONCE_SHARE = 0.3


class Checks(NamedTuple):
    """Checks of one robot, with a link changed and as it was."""

    changed: tuple[LinkChangeTrial, ...]
    unchanged: tuple[LinkChangeTrial, ...]


def link_change_cases(changed: int, unchanged: int, seed: int, shortened: bool = False) -> list[Case]:
    """Return the one case; each of its trials is one robot, recorded once for all its checks.

    `shortened`: the robot is known and checked by a motion of all joints at once, not joint by joint.
    """
    robots = max(-(-unchanged // DAYS), -(-changed // DAYS), 1)
    # Another thousand robots for another seed: no benchmark makes that many.
    first = 1000 * DAYS * seed
    days = [range(first + DAYS * robot, first + DAYS * (robot + 1)) for robot in range(robots)]
    work = []
    for robot, own in enumerate(days):
        changed_on, same = own[: _share(changed, robots, robot)], own[: _share(unchanged, robots, robot)]
        cost_s = _KNOWN_COST_S + _CHECK_COST_S * (len(changed_on) + len(same))
        plan, share = (AT_ONCE, _AT_ONCE_SHARE) if shortened else (None, 1.0)
        work.append(Trial(checks_of_one_robot, (tuple(changed_on), tuple(same), plan), share * cost_s))
    name = f"{ROBOT}, link change" + (", by all joints at once" if shortened else "")
    return [Case(name, work, _summary, NOISE, "a baseline run")]


def checks_of_one_robot(changed: Sequence[int], unchanged: Sequence[int], plan: Plan | None = None) -> Checks:
    """Check a robot on several days, one after the other in one process; plan: see `link_change_trial`."""
    return Checks(
        tuple(link_change_trial(seed, True, plan) for seed in changed),
        tuple(link_change_trial(seed, False, plan) for seed in unchanged),
    )


def _share(checks: int, robots: int, robot: int) -> int:
    """Return the number of checks of one robot."""
    return checks // robots + (robot < checks % robots)


def _summary(robots: Sequence[Checks]) -> Summary:
    changed = [check for robot in robots for check in robot.changed]
    unchanged = [check for robot in robots for check in robot.unchanged]
    size_mm = scaled(largest([check.size_error_m for check in changed]), 1e3)
    spent_s = largest([check.robot_time_s for check in changed + unchanged])
    what = f"{1e3 * CHANGE_M:.0f} mm"
    return Summary(
        [
            count(f"{what} not detected, or not located", [not check.located for check in changed]),
            Row(f"size of the {what}, largest error [mm]", size_mm, SIZE_MM),
            count("false alarms without a change", [check.false_alarm for check in unchanged]),
            Row("robot time of a check, longest [s]", spent_s, CHECK_S),
        ]
    )

"""Link change: a displaced link of a known robot is detected, located and sized; no other is reported.

The robot is recorded once and checked on many days: the modules and their errors stay the same, noise, drift
and network differ.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.baseline.baseline_robot import BaselineRobot
from coordinator.baseline.check import check, check_plan
from coordinator.baseline.check_report import CheckReport, LinkCheck
from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify_kinematics
from module_agent.model.chain import BASE, Array, Chain
from module_agent.network_emulation.profile_file import network as network_named
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, count, largest, scaled
from sim.geometry.link_parts import FreePose, Part
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain
from sim.robot.variants import at_random_site
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session

# Seeds that share a robot: it is recorded once for all of them in a process.
DAYS = 20
PARALLEL = 0.999


class LinkChangeTrial(NamedTuple):
    """The result of one check of a robot with one displaced link, or none.

    detected: the check reported a change. located: it named exactly the displaced link.
    size_error_m: error of the displacement's length, vector_error_m: of the displacement; None if it was not
    located. false_alarm: it named a link that had not changed. child: the module of the displaced link.
    """

    detected: bool
    located: bool
    size_error_m: float | None
    false_alarm: bool
    robot_time_s: float
    vector_error_m: float | None
    child: str | None
    words: tuple[str, ...]


class LinkChange(NamedTuple):
    """A link's far end displaced by `displacement_m` (3,), in the frame of the IMU of its module `child`."""

    child: str
    displacement_m: Array


class _Subject(NamedTuple):
    """A robot and the settings of its checks."""

    robot: str
    noise: str
    network: str
    seed: int
    plan: Plan


def link_change_trial(
    seed: int,
    changed: bool,
    robot: str = "a2085_06",
    noise: str = "x5-uncalibrated",
    network: str = "lan",
    change_m: float = 2e-3,
    plan: Plan | None = None,
) -> LinkChangeTrial:
    """Check a known robot with one link displaced, or unchanged.

    Args:
        seed: `DAYS` successive seeds are days of the same robot; link and direction follow from it.
        changed: whether a link is displaced.
        robot: a shipped robot, or a robot file.
        noise, network: profiles.
        change_m: the displacement.
        plan: of the session that the robot is known from; its motions are those of the check.
    """
    subject = _Subject(robot, noise, network, seed // DAYS, plan or Plan(dynamics=False))
    change = draw_link_change(load_robot(robot), seed, change_m) if changed else None
    known = _known(subject)
    later = _recorded(subject, 1 + seed % DAYS, check_plan(known, Plan()), change)
    return _trial(check(known, later), change)


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
def _known(subject: _Subject) -> BaselineRobot:
    return _recorded(subject, 0, subject.plan, None)


def _recorded(subject: _Subject, day: int, plan: Plan, change: LinkChange | None) -> BaselineRobot:
    robot = at_random_site(load_robot(subject.robot), subject.seed)
    settings = VirtualSettings(
        robot if change is None else with_link_change(robot, change),
        network_named(subject.network),
        subject.seed,
        subject.noise,
        # Other robots have other days: no two checks share their noise.
        noise_seed=subject.seed * (DAYS + 1) + day,
    )
    recording = record_session(settings, plan)
    return BaselineRobot(Path(f"day {day}"), recording, identify_kinematics(recording))


def _trial(report: CheckReport, change: LinkChange | None) -> LinkChangeTrial:
    named = [link for link in report.links if link.changed]
    child = change.child if change is not None else None
    located = [link.child for link in named] == [child]
    errors = _errors(named, change) if located and change is not None else (None, None)
    return LinkChangeTrial(
        detected=report.changed,
        located=located,
        size_error_m=errors[0],
        false_alarm=report.changed if change is None else any(link.child != child for link in named),
        robot_time_s=report.robot_time_s,
        vector_error_m=errors[1],
        child=child,
        words=tuple(report.summary),
    )


def _errors(named: Sequence[LinkCheck], change: LinkChange) -> tuple[float, float]:
    """Return the error of the estimated displacement, of its length and as a vector [m]."""
    estimated = 1e-3 * np.array(named[0].displacement_mm)
    true = change.displacement_m
    return (
        float(abs(np.linalg.norm(estimated) - np.linalg.norm(true))),
        float(np.linalg.norm(estimated - true)),
    )


ROBOT = "a2085_06"
CHANGE_M = 2e-3
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
    return [Case(name, tuple(work), partial(_summary, name))]


def checks_of_one_robot(changed: Sequence[int], unchanged: Sequence[int], plan: Plan | None = None) -> Checks:
    """Check a robot on several days, one after the other in one process; plan: see `link_change_trial`."""
    return Checks(
        tuple(link_change_trial(seed, True, ROBOT, change_m=CHANGE_M, plan=plan) for seed in changed),
        tuple(link_change_trial(seed, False, ROBOT, change_m=CHANGE_M, plan=plan) for seed in unchanged),
    )


def _share(checks: int, robots: int, robot: int) -> int:
    """Return the number of checks of one robot."""
    return checks // robots + (robot < checks % robots)


def _summary(case: str, robots: Sequence[Checks]) -> Summary:
    changed = [check for robot in robots for check in robot.changed]
    unchanged = [check for robot in robots for check in robot.unchanged]
    size_mm = scaled(largest([check.size_error_m for check in changed]), 1e3)
    spent_s = largest([check.robot_time_s for check in changed + unchanged])
    what = f"{1e3 * CHANGE_M:.0f} mm"
    return Summary(
        (
            count(
                case,
                f"{what} not detected, or not located",
                [not (c.detected and c.located) for c in changed],
            ),
            Row(case, f"size of the {what}, largest error [mm]", None, size_mm, None, SIZE_MM),
            count(case, "false alarms without a change", [check.false_alarm for check in unchanged]),
            Row(case, "robot time of a check, longest [s]", None, spent_s, None, CHECK_S),
        )
    )

"""What a seed stands for: a robot, a network profile and the faults of one session.

Every draw has a stream of its own, by the seed and a name. The kind of a fault is that with the largest of
numbers that belong to the kinds: a kind that is added changes only the seeds that it wins.
"""

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple
from zlib import crc32

import numpy as np

from coordinator.excitation.plan import Plan
from module_agent.control.safety import Safety
from module_agent.model.catalogue import module_type
from module_agent.model.errors import UsageError
from sim.faults.fault import KINDS, NATURES, Fault
from sim.physics.engine import Physics
from sim.robot.robot_file import Robot, load_robot
from sim.virtual_time.run import QUICK_PLAN

# Shipped robots, and how many of their modules: two to four joints, and a tree.
SMALL_ROBOTS = (
    ("thesis_171_horizontal", 2),
    ("thesis_171_vertical", 2),
    ("thesis_350_horizontal", 2),
    ("a2085_03", 3),
    ("a2085_04", 4),
    ("tree_y", 3),
)
NETWORKS = ("none", "lan", "wifi")
# A session of two joints takes 15 s, and 37 s with motions for inertia. Where another fault ends it before,
# those that were to come have not begun, and count for nothing.
LATEST_S, LATEST_DYNAMIC_S = 14.0, 36.0
# What a coordinator plans, and how many of the sessions of each kind there are. `inertia` and `d-optimal`
# identify inertia as well, joint by joint or all at once: they take three times as long.
PlanName = Literal["short", "simultaneous", "optimised", "inertia", "d-optimal"]
PLANS: dict[PlanName, Plan] = {
    "short": QUICK_PLAN,
    "simultaneous": QUICK_PLAN.model_copy(update={"mode": "simultaneous"}),
    "optimised": QUICK_PLAN.model_copy(update={"motions": "optimised"}),
    "inertia": QUICK_PLAN.model_copy(update={"dynamics": True}),
    "d-optimal": QUICK_PLAN.model_copy(update={"dynamics": True, "excitation": "d-optimal"}),
}
SHARES = (0.74, 0.08, 0.08, 0.05, 0.05)
# The share of sessions whose coordinator is told how many modules there are, as most users would.
EXPECTING = 0.75
SHORTEST_S, LONGEST_S = 0.02, 1.5
# From where a joint begins, and its home, to the limits of its position, at the least and at the most: the
# motions of a short session go to half a radian, and near a limit they would be slowed down.
ROOM_RAD = (0.8, 1.4)
# The range of a module's speed over its type's, at the least: no motion of a session is faster.
SLOWEST = 0.75


class Schedule(NamedTuple):
    """One session: robot, network profile by name, faults in the order of their time, the world's engine.

    expects: whether the coordinator is told how many modules there are. planned: what it plans, by name.
    """

    seed: int
    robot: Robot
    network: str
    faults: tuple[Fault, ...]
    physics: Physics = "compiled"
    expects: bool = True
    planned: PlanName = "short"

    @property
    def plan(self) -> Plan:
        """What the coordinator plans."""
        return PLANS[self.planned]

    @property
    def clock_sick(self) -> frozenset[str]:
        """The modules whose clock is sick: when the truth was at an instant of theirs is not known."""
        serials = self.robot.serials
        return frozenset(serials[f.module] for f in self.faults if f.nature.part == "clock")


def draw(seed: int, robot: Robot | None = None, planned: PlanName | None = None) -> Schedule:
    """Draw the session of a seed, the same one always. What is given replaces what would be drawn."""
    rng = _stream(seed, "robot")
    # Small robots first: three in four have two joints.
    index = int(rng.integers(3)) if rng.random() < 0.75 else int(rng.integers(3, len(SMALL_ROBOTS)))
    network = str(_stream(seed, "network").choice(NETWORKS))
    drawn = (
        first_modules(load_robot(SMALL_ROBOTS[index][0]), SMALL_ROBOTS[index][1]) if robot is None else robot
    )
    count = int(_stream(seed, "count").choice((1, 2, 3), p=(0.6, 0.3, 0.1)))
    if planned is None:
        planned = tuple(PLANS)[int(_stream(seed, "plan").choice(len(PLANS), p=SHARES))]
    latest_s = LATEST_DYNAMIC_S if PLANS[planned].dynamics else LATEST_S
    faults = [_fault(seed, number, len(drawn.modules), latest_s) for number in range(count)]
    expects = bool(_stream(seed, "expect").random() < EXPECTING)
    ordered = tuple(sorted(faults, key=lambda fault: fault.at_s))
    return Schedule(seed, drawn, network, ordered, expects=expects, planned=planned)


def position_ranges(schedule: Schedule) -> dict[str, tuple[float, float]]:
    """Return the range [rad] that each module of the session is configured to stay in, by serial.

    It contains where the joint begins and its home, and what a session plans has room about both.
    """
    ranges = {}
    for module in schedule.robot.modules:
        low, high = _stream(schedule.seed, module.serial, "range").uniform(*ROOM_RAD, 2).tolist()
        ends_rad = module.start_rad, QUICK_PLAN.home_rad
        ranges[module.serial] = (round(min(ends_rad) - low, 3), round(max(ends_rad) + high, 3))
    return ranges


def speed_limits(schedule: Schedule) -> dict[str, float]:
    """Return the speed [rad/s] that every second module is configured to in both directions, by serial."""
    limits = {}
    for module in schedule.robot.modules:
        rng = _stream(schedule.seed, module.serial, "speed")
        if rng.random() < 0.5:
            share = float(rng.uniform(SLOWEST, 1.0))
            limits[module.serial] = round(share * module_type(module.type).max_speed_rad_s, 3)
    return limits


def safety(schedule: Schedule) -> dict[str, Safety]:
    """Return what each module of the session is configured to, by serial."""
    speeds = speed_limits(schedule)
    return {
        serial: Safety(position_rad=ends_rad, velocity_rad_s=(-speeds[serial], speeds[serial]))
        if serial in speeds
        else Safety(position_rad=ends_rad)
        for serial, ends_rad in position_ranges(schedule).items()
    }


def first_modules(robot: Robot, modules: int) -> Robot:
    """Return the robot without all but its first modules.

    Raises:
        UsageError: fewer than two, or more than it has.
    """
    if not 2 <= modules <= len(robot.modules):
        raise UsageError(f"{modules} modules of {robot.name}: it has {len(robot.modules)}, two are the least")
    return robot.model_copy(update={"modules": robot.modules[:modules]})


def simpler(schedule: Schedule) -> Iterator[Schedule]:
    """Yield what is simpler by one step: fewer faults, modules or plans, no delays, shorter faults."""
    faults = schedule.faults
    if len(faults) > 1:
        for k in range(len(faults)):
            yield schedule._replace(faults=faults[:k] + faults[k + 1 :])
    modules = len(schedule.robot.modules)
    if modules > 2:
        within = tuple(fault._replace(module=min(fault.module, modules - 2)) for fault in faults)
        yield schedule._replace(robot=first_modules(schedule.robot, modules - 1), faults=within)
    if schedule.network != NETWORKS[0]:
        yield schedule._replace(network=NETWORKS[0])
    if schedule.planned != "short":
        yield schedule._replace(planned="short")
    for k, fault in enumerate(faults):
        for_s = LONGEST_S if math.isinf(fault.for_s) else round(0.5 * fault.for_s, 3)
        if NATURES[fault.kind].ends != "never" and for_s >= SHORTEST_S:
            yield schedule._replace(faults=(*faults[:k], fault._replace(for_s=for_s), *faults[k + 1 :]))


def _stream(seed: int, *names: object) -> np.random.Generator:
    return np.random.default_rng((seed, *(crc32(str(name).encode()) for name in names)))


def _fault(seed: int, number: int, modules: int, latest_s: float) -> Fault:
    kind = max(KINDS, key=lambda each: _stream(seed, number, each, "kind").random())
    rng, ends = _stream(seed, number, kind), NATURES[kind].ends
    return Fault(
        kind=kind,
        at_s=round(float(rng.uniform(0.0, latest_s)), 3),
        for_s=math.inf if ends == "never" or (ends == "either" and rng.random() < 0.5) else _lasting(rng),
        module=int(rng.integers(modules)),
        size=min(round(float(rng.random()), 3), 0.999),
    )


def _lasting(rng: np.random.Generator) -> float:
    return round(float(rng.uniform(SHORTEST_S, LONGEST_S)), 3)

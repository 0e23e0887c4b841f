"""What a seed stands for: a robot, a network profile and the faults of one session."""

from typing import NamedTuple

import numpy as np

from sim.faults.fault import KINDS, Fault
from sim.robot.robot_file import Robot, load_robot

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
# A session of two joints takes 15 s; a fault after its end is none.
LATEST_S = 14.0
MAX_FAULTS = 3


class Schedule(NamedTuple):
    """One session: the robot, its network profile by name, and faults in the order of their time."""

    seed: int
    robot: Robot
    network: str
    faults: tuple[Fault, ...]


def draw(seed: int, robot: Robot | None = None) -> Schedule:
    """Draw the session of a seed; the same seed draws the same. `robot` replaces the one drawn."""
    rng = np.random.default_rng(seed)
    # Small robots first: three in four have two joints.
    index = int(rng.integers(3)) if rng.random() < 0.75 else int(rng.integers(3, len(SMALL_ROBOTS)))
    network = str(rng.choice(NETWORKS))
    drawn = _small(*SMALL_ROBOTS[index]) if robot is None else robot
    count = 1 + int(rng.random() < 0.3) + int(rng.random() < 0.1)
    faults = [_fault(rng, len(drawn.modules)) for _ in range(min(count, MAX_FAULTS))]
    return Schedule(seed, drawn, network, tuple(sorted(faults, key=lambda fault: fault.at_s)))


def _small(name: str, modules: int) -> Robot:
    robot = load_robot(name)
    return robot.model_copy(update={"modules": robot.modules[:modules]})


def _fault(rng: np.random.Generator, modules: int) -> Fault:
    return Fault(
        kind=KINDS[int(rng.integers(len(KINDS)))],
        at_s=round(float(rng.uniform(0.0, LATEST_S)), 3),
        for_s=round(float(rng.uniform(0.02, 1.5)), 3),
        module=int(rng.integers(modules)),
        byte=int(rng.integers(1 << 16)),
    )

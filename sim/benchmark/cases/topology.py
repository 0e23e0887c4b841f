"""Topology: parents and mounting must be identified rightly for every random robot.

Everything but the fast motions is as in a run: the agents' firmware and estimates, the network's faults, the
session's discovery, link check, leases, travel, rest and slow motions, and those that it repeats in doubt.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from coordinator.excitation.plan import Plan
from coordinator.identification.topology_search import search_topology
from coordinator.recording.recording import Recording
from coordinator.topology.topology import Topology, TopologyError
from module_agent.model.errors import RobotError
from module_agent.network_emulation.profile_file import network as named_network
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, count, largest
from sim.imperfections.noise_profile import NoiseProfile
from sim.robot.random_robot import random_robot
from sim.robot.robot_file import BASE, Robot
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session

# Short waits and brisk travel, for up to 16 joints; the slow motion is the thesis', a little shorter.
PLAN = Plan(
    topology_only=True,
    dynamics=False,
    discover_s=0.3,
    link_s=0.3,
    rest_s=0.5,
    settle_s=0.2,
    travel_speed_rad_s=1.2,
    constant_duration_s=0.4,
)


class TopologyTrial(NamedTuple):
    """The result for one robot.

    differences: errors of the topology, described; empty if all is right. confidence: the coordinator's
    probability of its least certain answer, 0 without one. repeats: motions repeated for doubt.
    robot_time_s: from discovery to the robot's release; NaN of a session that failed.
    """

    seed: int
    modules: int
    differences: tuple[str, ...]
    confidence: float
    repeats: int
    robot_time_s: float


def topology_trial(
    seed: int, noise: str | NoiseProfile = "x5-uncalibrated", network: str = "lan", plan: Plan = PLAN
) -> TopologyTrial:
    """Identify the topology of the random robot of a seed in virtual time; all noise has the same seed.

    A session that fails has its reason as the difference.
    """
    robot = random_robot(seed)
    try:
        recording = record_session(VirtualSettings(robot, named_network(network), seed, noise), plan)
    except RobotError as error:
        return TopologyTrial(seed, len(robot.modules), (str(error),), 0.0, 0, float("nan"))
    return compared(robot, seed, recording)


def compared(robot: Robot, seed: int, recording: Recording) -> TopologyTrial:
    """Find the topology in a recording and compare it with the robot's."""
    wrong: tuple[str, ...]
    try:
        topology = search_topology(recording, robot.serials).topology
        wrong, confidence = differences(robot, topology), topology.confidence
    except TopologyError as error:
        wrong, confidence = (str(error),), 0.0
    return TopologyTrial(
        seed=seed,
        modules=len(robot.modules),
        differences=wrong,
        confidence=confidence,
        repeats=sum(e.what == "done" and e.step.startswith("settle/") for e in recording.journal),
        robot_time_s=float(np.ptp([event.t_ns for event in recording.journal])) * 1e-9,
    )


def differences(robot: Robot, topology: Topology) -> tuple[str, ...]:
    """Describe the errors of a topology, in the order of the robot's modules."""
    serials = topology.serials
    words = [f"module {s} does not exist" for s in serials if s not in robot.serials]
    on = {s: serials[p] if p >= 0 else BASE for s, p in zip(serials, topology.parent, strict=True)}
    turned = dict(zip(serials, topology.reversed, strict=True))
    for module in robot.modules:
        if module.serial not in on:
            words.append(f"module {module.serial} was not found")
            continue
        if on[module.serial] != module.parent:
            words.append(f"module {module.serial} is on {module.parent}, found on {on[module.serial]}")
        if turned[module.serial] != (module.mounted == "reversed"):
            words.append(f"module {module.serial} is mounted {module.mounted}, found the other way round")
    return tuple(words)


NOISE = "x5-uncalibrated"
_COST_S = 6.0
AMONG = 10


def topology_cases(robots: int, seed: int, small: bool = False) -> list[Case]:
    """Return the one case of random robots; their seeds follow one another from the benchmark's.

    `small`: of every `AMONG` of them only the one with the fewest modules.
    """
    among = AMONG if small else 1
    first = robots * among * seed
    drawn = [range(first + among * number, first + among * (number + 1)) for number in range(robots)]
    work = tuple(Trial(topology_trial, (_smallest(seeds), NOISE), _COST_S) for seeds in drawn)
    case = f"random robots, {NOISE}" + (f", the smallest of {AMONG}" if small else "")
    return [Case(case, work, partial(_summary, case))]


def _smallest(seeds: Sequence[int]) -> int:
    return seeds[0] if len(seeds) == 1 else min(seeds, key=lambda seed: len(random_robot(seed).modules))


def _summary(case: str, trials: Sequence[TopologyTrial]) -> Summary:
    wrong = [bool(trial.differences) for trial in trials]
    least = min((trial.confidence for trial in trials), default=None)
    return Summary(
        (
            count(case, "wrong topology or mounting", wrong),
            Row(case, "least confidence of all", None, least),
            Row(case, "motions repeated for doubt, most", None, largest([float(t.repeats) for t in trials])),
        )
    )

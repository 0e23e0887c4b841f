"""Topology: parents and mounting must be identified rightly for every random robot.

Everything but the fast motions is as in a run: the agents' firmware and estimates, the network's faults, the
session's discovery, link check, leases, travel, rest and slow motions, and those that it repeats in doubt.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.excitation.plan import Plan
from coordinator.identification.topology_search import search_topology
from coordinator.topology.topology import TopologyError
from module_agent.model.errors import RobotError
from module_agent.network_emulation.profile_file import network as named_network
from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.cases.arm import KNOWN
from sim.benchmark.row import Row, count, largest
from sim.robot.random_robot import random_robot
from sim.robot.robot_tree import true_chain
from sim.scoring.chain_score import topology_differences
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session

NOISE = "x5-uncalibrated"
AMONG = 10
_COST_S = 6.0
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


def topology_trial(seed: int, network: str = "lan") -> TopologyTrial:
    """Identify the topology of the random robot of a seed in virtual time; all noise has the same seed.

    A session that fails has its reason as the difference.
    """
    robot = random_robot(seed)
    begun = TopologyTrial(seed, len(robot.modules), (), 0.0, 0, float("nan"))
    try:
        recording = record_session(VirtualSettings(robot, named_network(network), seed, NOISE), PLAN)
    except RobotError as error:
        return begun._replace(differences=(str(error),))
    begun = begun._replace(
        repeats=sum(e.what == "done" and e.step.startswith("settle/") for e in recording.journal),
        robot_time_s=float(np.ptp([event.t_ns for event in recording.journal])) * 1e-9,
    )
    try:
        topology = search_topology(recording, robot.serials).topology
    except TopologyError as error:
        return begun._replace(differences=(str(error),))
    differences = topology_differences(topology, true_chain(robot))
    return begun._replace(differences=tuple(differences), confidence=topology.confidence)


def topology_cases(robots: int, seed: int, small: bool = False) -> list[Case]:
    """Return the one case of random robots; their seeds follow one another from the benchmark's.

    `small`: of every `AMONG` of them only the one with the fewest modules.
    """
    among = AMONG if small else 1
    first = robots * among * seed
    drawn = [range(first + among * number, first + among * (number + 1)) for number in range(robots)]
    work = [Trial(topology_trial, (_smallest(seeds),), _COST_S) for seeds in drawn]
    name = f"random robots, {NOISE}" + (f", the smallest of {AMONG}" if small else "")
    return [Case(name, work, _summary, NOISE, KNOWN["uncalibrated"])]


def _smallest(seeds: Sequence[int]) -> int:
    return seeds[0] if len(seeds) == 1 else min(seeds, key=lambda seed: len(random_robot(seed).modules))


def _summary(trials: Sequence[TopologyTrial]) -> Summary:
    return Summary(
        [
            count("wrong topology or mounting", [bool(trial.differences) for trial in trials]),
            Row("least confidence of all", min((trial.confidence for trial in trials), default=None)),
            Row("motions repeated for doubt, most", largest([float(trial.repeats) for trial in trials])),
        ]
    )

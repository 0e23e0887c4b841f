"""Does a robot that nobody has drawn find out how it is built? The coordinator's session on random robots.

Everything but the fast motions is as in a run: the agents' firmware and estimates, the network's faults, the
session's discovery, link check, leases, travel, rest and slow motions, and those that it repeats in doubt.
"""

from typing import NamedTuple

import numpy as np

from coordinator.failure import explain
from coordinator.kinematics.topology import Topology, TopologyError
from coordinator.plan import Plan
from coordinator.recording import Recording
from coordinator.topology_search import search_topology
from module_agent.wire.network_file import network as named_network
from sim.noise_profile import NoiseProfile
from sim.random_robot import random_robot
from sim.robot_file import BASE, Robot
from sim.virtual_robot import VirtualSettings
from sim.virtual_session import record_session

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
    """What came out for one robot. `differences` say in words what is wrong, empty if all is right.

    confidence: the probability that the coordinator itself gives to its least certain answer; 0 without one.
    repeats: the motions that it repeated for doubt. robot_time_s: from discovery to the robot's release; NaN
        of a session that did not come to its end.
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
    """Let the random robot of a seed find its topology in virtual time, all chance of the same seed.

    A session that does not come to its end has found nothing, and why is the difference.
    """
    robot = random_robot(seed)
    try:
        recording = record_session(VirtualSettings(robot, named_network(network), seed, noise), plan)
    except Exception as error:
        failure = explain(error)
        if failure is None:
            raise
        return TopologyTrial(seed, len(robot.modules), (failure.text,), 0.0, 0, float("nan"))
    return judged(robot, seed, recording)


def judged(robot: Robot, seed: int, recording: Recording) -> TopologyTrial:
    """Find the topology in a recording and compare it with the robot's."""
    wrong: tuple[str, ...]
    try:
        found = search_topology(recording, robot.serials).topology
        wrong, confidence = differences(robot, found), found.confidence
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


def differences(robot: Robot, found: Topology) -> tuple[str, ...]:
    """Say in words what is wrong with a topology, in the robot's order."""
    words = [f"module {s} does not exist" for s in found.serials if s not in robot.serials]
    on = {
        serial: found.serials[p] if p >= 0 else BASE
        for serial, p in zip(found.serials, found.parent, strict=True)
    }
    turned = dict(zip(found.serials, found.reversed, strict=True))
    for module in robot.modules:
        if module.serial not in on:
            words.append(f"module {module.serial} was not found")
            continue
        if on[module.serial] != module.parent:
            words.append(f"module {module.serial} is on {module.parent}, found on {on[module.serial]}")
        if turned[module.serial] != (module.mounted == "reversed"):
            words.append(f"module {module.serial} is mounted {module.mounted}, found the other way round")
    return tuple(words)

"""Does a robot that nobody has drawn find out how it is built? The coordinator's session on random robots.

Everything but the fast motions is as in a run: the agents' firmware and estimates, the network's faults, the
session's discovery, link check, leases, travel, rest and slow motions. Nothing is written to disk.
"""

import asyncio
from typing import NamedTuple

import numpy as np

from coordinator.interruption import run_to_end
from coordinator.journal import JournalEvent
from coordinator.kinematics.topology import Topology
from coordinator.plan import Plan
from coordinator.radio import Radio
from coordinator.recording import JOURNAL_TOPIC, Entry, Recording
from coordinator.robot_link import RobotLink
from coordinator.session import Session
from coordinator.topology_search import search_topology
from module_agent.wire.messages import Message
from module_agent.wire.network_file import network as named_network
from module_agent.wire.refusal import WireError
from sim.noise_profile import NoiseProfile
from sim.random_robot import random_robot
from sim.robot_file import BASE, Robot
from sim.virtual_loop import VirtualLoop
from sim.virtual_robot import VirtualRobot, VirtualSettings

COORDINATOR = "coordinator"
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
    repeats: the motions that it repeated for doubt. robot_time_s: from discovery to the robot's release.
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
    """Let the random robot of a seed find its topology in virtual time, all chance of the same seed."""
    return robot_trial(random_robot(seed), seed, noise, network, plan)


def robot_trial(
    robot: Robot, seed: int, noise: str | NoiseProfile, network: str, plan: Plan = PLAN
) -> TopologyTrial:
    """Let any robot find its topology in virtual time."""
    loop = VirtualLoop()
    simulated = VirtualRobot(VirtualSettings(robot, named_network(network), seed, noise), loop)
    observer = _Observer()
    radio = Radio(
        simulated.endpoint(COORDINATOR), robot.name, lambda: loop.now_ns, loop.call_soon, observer.record
    )
    link = RobotLink(radio, observer.recording, lambda: loop.now_ns, COORDINATOR)
    session = Session(link, radio, observer.recording, plan, lambda: loop.now_ns, observer.journal, observer)
    simulated.start()
    try:
        run_to_end(loop, loop.create_task(_to_end(session, radio, simulated)))
        return _judged(robot, seed, observer)
    finally:
        simulated.close()
        loop.close()


async def _to_end(session: Session, radio: Radio, simulated: VirtualRobot) -> None:
    radio.start()
    try:
        await session.run(len(simulated.world.modules))
    finally:
        radio.close()
        simulated.stop()
        await asyncio.sleep(0)


class _Observer:
    """Records a session in memory and finds the topology when all joints are explored."""

    def __init__(self) -> None:
        self.recording = Recording()
        self.topology: Topology | None = None
        self.failure = ""

    def record(self, entry: Entry) -> Message | None:
        try:
            message = self.recording.add(entry)
        except (WireError, ValueError):
            return None
        return message if isinstance(message, Message) else None

    def journal(self, event: JournalEvent) -> None:
        self.recording.add(Entry("journal", JOURNAL_TOPIC, event.t_ns, event.encode()))

    def step(self, index: int, total: int, text: str) -> None:
        """Nobody watches."""

    def note(self, text: str) -> None:
        """Nobody reads."""

    def estimates(self, joint: str) -> None:
        """Nothing is drawn."""

    async def explored(self) -> None:
        try:
            self.topology = search_topology(self.recording, sorted(self.recording.modules)).topology
        except ValueError as error:
            self.failure = str(error)


def _judged(robot: Robot, seed: int, observer: _Observer) -> TopologyTrial:
    times = [event.t_ns for event in observer.recording.journal]
    found = observer.topology
    repeats = sum(e.what == "done" and e.step.startswith("settle/") for e in observer.recording.journal)
    return TopologyTrial(
        seed=seed,
        modules=len(robot.modules),
        differences=differences(robot, found) if found is not None else (observer.failure,),
        confidence=found.confidence if found is not None else 0.0,
        repeats=repeats,
        robot_time_s=float(np.ptp(times)) * 1e-9,
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

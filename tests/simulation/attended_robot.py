"""An attendant at the known arm in virtual time; another program moves the arm, and things happen to it."""

import asyncio
import shutil
from collections.abc import Callable
from pathlib import Path

from coordinator.attendant.attend_session import AttendSession, Site
from coordinator.baseline.baseline_robot import load_baseline
from coordinator.live_robot.messenger import Messenger, Sender
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.monitoring.monitor import MonitorUpdate
from coordinator.recording.recording import Recording
from coordinator.recording.versions import Versions
from coordinator.runtime.event_loop import run_to_end
from module_agent.network_emulation.profile_file import network
from sim.benchmark.cases.monitored_robot import move_about, ordinary_motions
from sim.benchmark.cases.monitoring import KNOWN_PLAN
from sim.robot.robot_file import Robot
from sim.virtual_time.loop import VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from tests.simulation.known_arm import ARM, NETWORK, NOISE, SEED

UTC = "2026-01-05T10:00:00+00:00"


class Ears:
    """Keeps what the attendant says, with the time [s]."""

    def __init__(self) -> None:
        self.said: list[tuple[float, str]] = []
        self.noted: list[str] = []

    def say(self, text: str, t_ns: int) -> None:
        self.said.append((1e-9 * t_ns, text))

    def report(self, update: MonitorUpdate) -> None:
        self.noted += update.notes

    def heard(self, words: str) -> list[float]:
        return [at_s for at_s, text in self.said if words in text]


class Scene:
    """The known arm, or what is made of it, with an attendant at a copy of its folder."""

    def __init__(self, known: Path, folder: Path, day: int = 5):
        shutil.copytree(known, folder)
        self.versions = Versions(folder)
        self.ears = Ears()
        self.loop = VirtualLoop()
        self.network = VirtualNetwork(self.loop)
        self.robots: list[VirtualRobot] = []
        self.put_up(ARM, day)
        self.site = Site(
            robot=ARM.name,
            connect=lambda: self.robot.endpoint("attendant"),
            clock=self.clock,
            post=self.loop.call_soon,
            sender=Sender("attendant", b"attendant-secret"),
            utc=lambda: UTC,
            inline=True,
        )
        self.session = AttendSession(self.site, self.versions, self.ears)

    @property
    def robot(self) -> VirtualRobot:
        """The robot that is there."""
        return self.robots[-1]

    def clock(self) -> int:
        return self.loop.now_ns

    def put_up(self, robot: Robot, day: int) -> None:
        """Switch the robot on, in place of the one that was there: its modules are those of the same seed."""
        for earlier in self.robots[-1:]:
            for serial in list(earlier.hosts):
                earlier.kill(serial)
            earlier.stop()
        settings = VirtualSettings(robot, network(NETWORK), SEED, NOISE, noise_seed=day)
        self.robots.append(VirtualRobot(settings, self.loop, self.network))
        self.robot.start()

    def at(self, when_s: float, call: Callable[[], None]) -> None:
        self.loop.schedule_ns(round(when_s * 1e9), call)

    def plays(self, until_s: float, moved_until_s: float = 0.0) -> None:
        """Let time pass, in which another program first moves the robot."""

        async def story() -> None:
            attending = asyncio.create_task(self.session.run(round(until_s * 1e9)))
            if moved_until_s:
                await self._moved(moved_until_s)
            await attending

        try:
            run_to_end(self.loop, self.loop.create_task(story()))
        finally:
            for robot in self.robots:
                robot.close()
            self.loop.close()

    async def _moved(self, until_s: float) -> None:
        known, recording = load_baseline(self.versions.folder), Recording()
        plan = KNOWN_PLAN.model_copy(update={"excitation_s": 4.0, "excitation_motions": 6})
        motions = ordinary_motions(known.chain, known.recording, plan, 1006)
        messenger = Messenger(
            self.robot.endpoint("mover"), ARM.name, self.clock, self.loop.call_soon, recording.accept
        )
        group = ModuleGroup(messenger, recording, self.clock, Sender("mover", b"secret-of-mover-"))
        messenger.start()
        try:
            await move_about(group, messenger, motions, len(ARM.modules), round(until_s * 1e9), self.loop)
        finally:
            messenger.close()

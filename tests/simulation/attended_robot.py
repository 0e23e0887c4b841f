"""An attendant at the known arm in virtual time; another program moves the arm, and things happen to it."""

import asyncio
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.api import load_run
from coordinator.attendant.attend_session import AttendSession, Site
from coordinator.attendant.remeasure import Remeasurement
from coordinator.attendant.workspace import Box, Workspace
from coordinator.baseline.baseline_robot import load_baseline
from coordinator.identification.result import Result
from coordinator.live_robot.messenger import Messenger, Sender
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.monitoring.monitor import MonitorUpdate
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import RESULT
from coordinator.recording.versions import Versions
from coordinator.runtime.event_loop import run_to_end
from coordinator.torque_control.gravity_model import GravityModel, gravity_model, gravity_model_of_result
from module_agent.model.regressor import inverse_dynamics
from module_agent.network_emulation.profile_file import network
from sim.benchmark.cases.link_change import LinkChange, with_link_change
from sim.benchmark.cases.monitored_robot import move_about, ordinary_motions
from sim.benchmark.cases.monitoring import KNOWN_PLAN
from sim.robot.robot_file import Robot
from sim.robot.robot_tree import true_chain, true_inertia
from sim.robot.variants import as_built
from sim.scoring.chain_score import link_length_m
from sim.virtual_time.loop import VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from tests.simulation.known_arm import ARM, LOADED, NETWORK, NOISE, SEED

# The arm reaches 0.7 m.
ROOM = Workspace(box=Box(low_m=(-1.0, -1.0, -0.9), high_m=(1.0, 1.0, 1.1)), joints={"all": (-1.2, 1.2)})
UTC = "2026-01-05T10:00:00+00:00"


class Ears:
    """Keeps what the attendant says, with the time [s]."""

    def __init__(self) -> None:
        self.said: list[tuple[float, str]] = []
        self.noted: list[str] = []

    def say(self, text: str, t_ns: int) -> None:
        self.said.append((1e-9 * t_ns, text))

    def warn(self, text: str, t_ns: int) -> None:
        self.say(text, t_ns)

    def report(self, update: MonitorUpdate) -> None:
        self.noted += update.notes

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        self.noted.append(f"[{index}/{total}] {text}")

    def note(self, text: str) -> None:
        self.noted.append(text)

    def heard(self, words: str) -> list[float]:
        return [at_s for at_s, text in self.said if words in text]


class Scene:
    """The known arm, or what is made of it, with an attendant at a copy of its folder."""

    def __init__(self, known: Path, folder: Path, workspace: Workspace | None = None, day: int = 5):
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
        measurer = None if workspace is None else self._measurer(workspace)
        self.session = AttendSession(self.site, self.versions, self.ears, measurer)

    def _measurer(self, workspace: Workspace) -> Remeasurement:
        return Remeasurement(self.site, self.versions, workspace, self.ears)

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


def _renamed(robot: Robot, serial: str, to: str) -> Robot:
    """Return the robot with another module of the same type in place of its last one."""
    modules = (*robot.modules[:-1], robot.modules[-1].model_copy(update={"serial": to}))
    assert robot.serials[-1] == serial, "a module that carries none"
    return robot.model_copy(update={"modules": modules})


def _extended(robot: Robot, serial: str) -> Robot:
    """Return the robot with one more module, linked like its last one, at its end."""
    last = robot.modules[-1]
    more = last.model_copy(update={"serial": serial, "parent": last.serial})
    return robot.model_copy(update={"modules": (*robot.modules, more)})


class Change(NamedTuple):
    """What the arm is afterwards, whether its modules are others, and how long another moves it [s]."""

    robot: Robot
    plugged: bool
    moved_until_s: float


CHANGED_S = 6.0
LAST = ARM.serials[-1]
CHANGES = {
    "0.2 kg put on": Change(LOADED, False, 16.0),
    "a link displaced by 5 mm": Change(
        with_link_change(ARM, LinkChange(LAST, np.full(3, 5e-3 / np.sqrt(3.0)))), False, 12.0
    ),
    "a module exchanged": Change(_renamed(ARM, LAST, "spare"), True, 0.0),
    "a module added": Change(_extended(ARM, "wrist"), True, 0.0),
}


class Remeasured(NamedTuple):
    """How long it took from a change to the new model [s], the links' errors in sigmas, torques' errors.

    gravity_nm: rms over random poses and all joints of the error of the torque that is fed forward against
    gravity; gravity_before_nm: the same of the model before, None if its modules are others.
    """

    robot_time_s: float
    link_sigmas: dict[str, float]
    gravity_nm: float
    gravity_before_nm: float | None


def remeasured(scene: Scene, change: Change) -> Remeasured:
    """Let a change happen to the arm of a scene; return what became of its model."""

    def happen() -> None:
        if change.plugged:
            scene.put_up(change.robot, 7)
        else:
            scene.robot.world.become(change.robot)

    scene.at(CHANGED_S, happen)
    scene.plays(CHANGED_S + 130.0, change.moved_until_s)
    (done_s,) = scene.ears.heard("is the model from now on")
    built = as_built(change.robot, SEED, NOISE)
    truth, run = true_chain(built), load_run(scene.versions.folder)
    sigmas = {
        link.child: (link.link_length_mm - 1e3 * link_length_m(truth, truth.serials.index(link.child)))
        / link.link_length_sigma_mm
        for link in run.result.links
        if link.parent in truth.serials
    }
    before = gravity_model_of_result(
        Result.model_validate_json((scene.versions.folder / RESULT).read_bytes())
    )
    now = gravity_model(scene.versions.folder)
    return Remeasured(
        done_s - CHANGED_S,
        sigmas,
        _gravity_error_nm(now, built),
        _gravity_error_nm(before, built) if before.chain.serials == truth.serials else None,
    )


def _gravity_error_nm(model: GravityModel, built: Robot) -> float:
    truth, phi = true_chain(built), true_inertia(built).reshape(-1)
    assert model.chain.serials == truth.serials
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (50, len(truth.serials)))
    still = np.zeros_like(q)
    wanted = inverse_dynamics(truth, phi, q, still, still)
    fed = np.array([model.effort_nm(pose, np.zeros_like(pose)) for pose in q])
    return float(np.sqrt(np.mean((fed - wanted) ** 2)))

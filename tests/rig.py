"""A simulated robot in virtual time, every module an agent process of its own, to be broken at will."""

import itertools
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from coordinator.identification.result import Result
from coordinator.live_robot.messenger import Messenger, Sender
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.recording.recording import Recording
from coordinator.runtime.event_loop import end_tasks
from coordinator.session.run import Run, RunConfig
from module_agent.network_emulation.profile import PROFILES, NetworkProfile
from sim.physics.engine import Physics
from sim.robot.robot_file import load_robot
from sim.virtual_time.cable import Cable, CableState
from sim.virtual_time.loop import VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from sim.world.truth import write_truth

T = TypeVar("T")
SECRET = b"a-secret-of-16-b"


class Notes:
    """A screen that keeps what it is told."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        self.lines.append(f"[{index}/{total}] {text}")

    def note(self, text: str) -> None:
        self.lines.append(text)


class Rig(VirtualRobot):
    """World, network and agents of one robot that ticks from the start; `cut` severs the coordinator from it.

    `beside` is a rig whose network, and with it whose time, this one shares. `hebi_rate_hz` as in
    `VirtualSettings`.
    """

    def __init__(
        self,
        robot: str,
        network: str | NetworkProfile = "none",
        seed: int = 0,
        tap: Callable[[int, str, str, str, bytes], None] | None = None,
        noise: str = "x5",
        beside: "Rig | None" = None,
        hebi_rate_hz: float | None = None,
        physics: Physics | None = None,
        **firmware: Any,
    ):
        self._guest = beside is not None
        self.cable = CableState()
        loop = VirtualLoop() if beside is None else beside.loop
        shared = VirtualNetwork(loop, tap) if beside is None else beside.network
        impaired = PROFILES[network] if isinstance(network, str) else network
        settings = VirtualSettings(
            load_robot(robot), impaired, seed, noise, hebi_rate_hz=hebi_rate_hz, physics=physics
        )
        super().__init__(settings, loop, shared, **firmware)
        self.notes: list[str] = []
        self.start()

    def _draws(self, settings: VirtualSettings) -> tuple[np.random.SeedSequence, Iterator[int]]:
        """Boot ids in order, so that those of a restarted module are known and tell rigs apart."""
        return np.random.SeedSequence(settings.seed), itertools.count(101 + 1000 * settings.seed)

    @property
    def cut(self) -> bool:
        return self.cable.cut

    @cut.setter
    def cut(self, cut: bool) -> None:
        self.cable.cut = cut

    def state(self, serial: str) -> str:
        return self.hosts[serial].modules[0].firmware.state

    def at(self, when_s: float, call: Callable[[], None]) -> None:
        """Do something at a virtual time."""
        self.loop.call_at(when_s, call)

    def when(self, condition: Callable[[], bool], call: Callable[[], None]) -> None:
        """Do something once, at the first tick at which a condition holds."""

        def watch() -> None:
            if condition():
                self.on_tick.remove(watch)
                call()

        self.on_tick.append(watch)

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        return self.loop.run_until_complete(work)

    def group(self, sender: str = "tester") -> tuple[Messenger, Recording, ModuleGroup]:
        """A coordinator's hold on the robot."""
        recording, loop = Recording(), self.loop

        def clock() -> int:
            return loop.now_ns

        way = Cable(self.endpoint(sender), self.loop, self.cable)
        messenger = Messenger(way, self.robot.name, clock, loop.call_soon, recording.accept)
        messenger.start()
        return messenger, recording, ModuleGroup(messenger, recording, clock, Sender(sender, SECRET))

    def session(
        self,
        out: Path,
        plan: Plan,
        resume: bool = False,
        sender: str = "coordinator",
        expects: bool = True,
    ) -> Result:
        """Run a whole identification and write its folder, truth included."""
        result = self.run(self.begin(out, plan, resume, sender, expects=expects).run())
        write_truth(out / "truth.json", self.world.robot)
        self.truth.save(out / "truth.npz")
        return result

    def begin(
        self,
        out: Path,
        plan: Plan,
        resume: bool = False,
        sender: str = "coordinator",
        expect: int | None = None,
        expects: bool = True,
    ) -> Run:
        """Make a coordinator that is to run a whole identification; without `expects`, of what there is."""
        notes = Notes()
        config = RunConfig(
            self.robot.name,
            out,
            Sender(sender, SECRET),
            plan,
            (expect or len(self.serials)) if expects else None,
            resume=resume,
            inline=True,
        )
        run = Run(
            config,
            Cable(self.endpoint(sender), self.loop, self.cable),
            lambda: self.loop.now_ns,
            self.loop.call_soon,
            notes,
        )
        self.notes = notes.lines
        return run

    def end_tasks(self) -> None:
        """End what a killed coordinator has left behind, as the end of its process would."""
        end_tasks(self.loop)

    def close(self) -> None:
        self.stop()
        if not self._guest:
            self.end_tasks()
        super().close()
        if not self._guest:
            self.loop.close()


@contextmanager
def silent(group: ModuleGroup) -> Iterator[None]:
    """Renew no lease meanwhile, as a program that hangs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(group.commander, "renew", lambda **_how: None)
        yield

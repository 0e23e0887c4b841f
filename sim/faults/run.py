"""One session with faults: agents, coordinator and world in virtual time, by the product's own code."""

import asyncio
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.excitation.plan import Plan
from coordinator.live_robot.messenger import Sender
from coordinator.recording.run_folder import SESSION
from coordinator.session.run import Run, RunConfig
from module_agent.host import AgentHost
from module_agent.model.errors import RobotError
from module_agent.network_emulation.profile_file import network
from sim.faults.fault import Fault
from sim.faults.plant_witness import PlantWitness
from sim.faults.schedule import Schedule
from sim.virtual_time.cable import Cable, CableState
from sim.virtual_time.loop import VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from sim.virtual_time.run import SilentScreen
from sim.world.truth import write_truth

COORDINATOR, SUCCESSOR = "coordinator", "successor"
# Half the thesis' durations suffice for topology and kinematics.
PLAN = Plan(
    dynamics=False,
    discover_s=0.3,
    link_s=0.3,
    settle_s=0.3,
    rest_s=1.0,
    travel_speed_rad_s=1.5,
    sine_centre_s=1.2,
    sine_sigma_s=0.5,
)
# Four joints take 30 s; every motion may be repeated twice, and a run be resumed.
LIMIT_S = 180.0
# How long motors are observed after the coordinator has ended: several lifetimes.
AFTERWARDS_S = 1.0
# By how much messages are delayed.
DELAY_S = 0.1
# When a coordinator that was killed is started again, its lease of the modules has lapsed.
RESTART_S = 2.0


class Ending(NamedTuple):
    """How a session ended: `result`, `lost` (its coordinator was killed), `unbounded`, or an error's name."""

    name: str
    text: str = ""


class _Killed(BaseException):
    """SIGKILL of the coordinator: nothing of it runs afterwards."""


class _OutOfTime(BaseException):
    """The session has not ended within `LIMIT_S`."""


class FaultyRobot(VirtualRobot):
    """A robot to be broken at will; agents can be restarted any number of times."""

    def _draws(self, settings: VirtualSettings) -> tuple[np.random.SeedSequence, Iterator[int]]:
        return np.random.SeedSequence(settings.seed), itertools.count(101)

    def end_tasks(self) -> None:
        """End what a killed coordinator has left behind, as the end of its process would."""
        remaining = sorted(asyncio.all_tasks(self.loop), key=lambda task: task.get_name())

        async def end() -> None:
            for task in remaining:
                task.cancel()
            await asyncio.gather(*remaining, return_exceptions=True)

        self.loop.run_until_complete(end())


def run_schedule(schedule: Schedule, out: Path, witness: PlantWitness) -> Ending:
    """Run the session of a schedule into a folder, truth included, and return how it ended.

    Any exception but a `RobotError` is a defect of the product, and passes.
    """
    loop = VirtualLoop()
    settings = VirtualSettings(schedule.robot, network(schedule.network), schedule.seed, "x5")
    robot = FaultyRobot(settings, loop, VirtualNetwork(loop, witness.tap))
    session = _Session(schedule, robot, out)
    robot.on_tick.append(lambda: witness.check(robot))
    try:
        return session.run()
    finally:
        robot.end_tasks()
        robot.close()
        loop.close()


class _Session:
    """One session: its coordinator, restarted if the schedule says so, and its faults."""

    def __init__(self, schedule: Schedule, robot: FaultyRobot, out: Path):
        self._schedule = schedule
        self._robot = robot
        self._out = out
        self._cable = CableState()
        self._disturbances: list[Fault] = []
        self._sender = COORDINATOR
        self._restarts = False
        self._over = False

    def run(self) -> Ending:
        robot, loop = self._robot, self._robot.loop
        robot.start()
        for fault in self._schedule.faults:
            loop.call_at(fault.at_s, self._begin, fault)
        loop.call_at(LIMIT_S, self._end_of_time)
        ending = self._coordinate(resume=False)
        if ending.name == "lost" and self._restarts:
            self._sender = SUCCESSOR
            ending = self._coordinate(resume=True)
        self._over = True
        if ending.name != "unbounded":
            self._wait(AFTERWARDS_S)
        if ending.name == "result":
            write_truth(self._out / "truth.json", robot.world.robot)
            robot.truth.save(self._out / "truth.npz")
        return ending

    def _coordinate(self, resume: bool) -> Ending:
        robot, loop = self._robot, self._robot.loop
        config = RunConfig(
            robot=robot.robot.name,
            out=self._out,
            sender=Sender(self._sender, b"a-secret-of-16-b"),
            plan=PLAN,
            expect=len(robot.serials),
            resume=resume,
            inline=True,
            refined_previews=0,
        )
        cable = Cable(robot.endpoint(self._sender), loop, self._cable)
        try:
            run = Run(config, cable, lambda: loop.now_ns, loop.call_soon, SilentScreen())
            loop.run_until_complete(run.run())
        except RobotError as error:
            return Ending(type(error).__name__, str(error))
        except _Killed:
            self._bury()
            return Ending("lost")
        except _OutOfTime:
            return Ending("unbounded", f"no end within {LIMIT_S:.0f} s")
        return Ending("result")

    def _bury(self) -> None:
        """Let the coordinator's remains end without a trace in what it had written, and time pass."""
        session = self._out / SESSION
        crashed = session.read_bytes()
        self._robot.end_tasks()
        session.write_bytes(crashed)
        self._wait(RESTART_S)

    def _wait(self, for_s: float) -> None:
        loop = self._robot.loop
        loop.run_until_complete(asyncio.sleep(for_s))

    def _end_of_time(self) -> None:
        if not self._over:
            raise _OutOfTime

    def _begin(self, fault: Fault) -> None:
        if self._over:
            return
        beginnings: dict[str, Callable[[Fault], object]] = {
            "agent crash": self._crash,
            "agent freeze": self._freeze,
            "agent thaw": self._thaw,
            "agent reboot": self._reboot,
            "coordinator crash": self._kill,
            "coordinator restart": self._restart,
        }
        beginnings.get(fault.kind, self._disturb)(fault)

    def _later(self, fault: Fault, call: Callable[[], None]) -> None:
        self._robot.loop.call_later(fault.for_s, call)

    def _crash(self, fault: Fault) -> None:
        serial = self._robot.serials[fault.module]
        if serial in self._robot.hosts:
            self._robot.kill(serial)

    def _freeze(self, fault: Fault) -> AgentHost | None:
        serial = self._robot.serials[fault.module]
        host = self._robot.hosts.get(serial)
        if host is not None:
            self._robot.freeze(serial)
        return host

    def _thaw(self, fault: Fault) -> None:
        serial, host = self._robot.serials[fault.module], self._freeze(fault)
        if host is not None:
            self._later(fault, lambda: self._robot.hosts.update({serial: host}))

    def _reboot(self, fault: Fault) -> None:
        serial = self._robot.serials[fault.module]
        if serial in self._robot.hosts:
            self._robot.kill(serial)
            self._later(fault, lambda: self._robot.boot(serial))

    def _kill(self, fault: Fault) -> None:
        if self._sender == COORDINATOR:
            self._robot.network.kill(COORDINATOR)
            raise _Killed

    def _restart(self, fault: Fault) -> None:
        self._restarts = True
        self._kill(fault)

    def _disturb(self, fault: Fault) -> None:
        self._disturbances.append(fault)
        self._set_cable()

        def mend() -> None:
            self._disturbances.remove(fault)
            self._set_cable()

        self._later(fault, mend)

    def _set_cable(self) -> None:
        """Let the cable do what all disturbances that go on together make of it."""
        present, cable = {fault.kind: fault for fault in self._disturbances}, self._cable
        corrupted = present.get("corrupted messages")
        cable.cut = "partition" in present
        cable.flip = None if corrupted is None else corrupted.byte
        cable.copies = int("duplicated messages" in present)
        cable.delay_s = DELAY_S if "delayed messages" in present else 0.0

"""One session with faults: agents, coordinator and world in virtual time, by the product's own code."""

import asyncio
import json
import math
import resource
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from coordinator.identification.result import Result
from coordinator.live_robot.messenger import Sender
from coordinator.recording.run_folder import RESULT, SESSION
from coordinator.runtime.event_loop import end_tasks
from coordinator.session.run import Run, RunConfig
from module_agent.model.catalogue import module_type
from module_agent.model.errors import RobotError
from module_agent.network_emulation.profile_file import network
from module_agent.wire.keys import parse
from sim.faults.fault import Fault
from sim.faults.faulty_robot import BEGINNINGS, FaultyRobot
from sim.faults.intruder import ATTACKS, OVERHEARD, Intruder
from sim.faults.plant_witness import PlantWitness
from sim.faults.reckless_holder import RecklessHolder, Target
from sim.faults.schedule import Schedule, position_ranges, safety, speed_limits
from sim.virtual_time.cable import Cable, CableState
from sim.virtual_time.loop import NS_PER_S, VirtualLoop
from sim.virtual_time.network import Tap, VirtualNetwork
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.run import SilentScreen
from sim.world.truth import write_truth

COORDINATOR, SUCCESSOR, RECKLESS = "coordinator", "successor", "reckless holder"
SECRET = b"a-secret-of-16-b"
# Four joints take 30 s, 75 s with inertia; every motion may be repeated twice, and a run be resumed.
LIMIT_S = 300.0
# How long motors are observed after the coordinator has ended: several lifetimes.
AFTERWARDS_S = 1.0
# Endings that leave a result.
WITH_RESULT = ("result", "suspect")
# By how much messages are delayed.
DELAY_S = 0.1
# When a coordinator that was killed is started again, its lease of the modules has lapsed.
RESTART_S = 2.0


class Ending(NamedTuple):
    """How a session ended: `result`, `suspect`, `lost`, `unbounded`, or by the name of an error.

    suspect: a result that its program does not believe as usual, by exit code 5; the text says why. lost: its
    coordinator was killed. at_s: when it ended. unheard: modules that were not announced then, which a
    coordinator cannot miss that is not told how many there are.
    """

    name: str
    text: str = ""
    at_s: float = math.inf
    unheard: frozenset[str] = frozenset()


class _Killed(BaseException):
    """SIGKILL of the coordinator: nothing of it runs afterwards."""


class _OutOfTime(BaseException):
    """The session has not ended within `LIMIT_S`."""


def witness_of(schedule: Schedule) -> PlantWitness:
    """Return who is to observe the session of a schedule."""
    faults, serials = schedule.faults, schedule.robot.serials
    reckless = [_reckless(fault) for fault in faults if fault.kind == "reckless holder"]
    # A range is that of the module's own encoder.
    blind = {serials[fault.module] for fault in faults if fault.nature.part == "encoder"}
    ranges = {serial: ends for serial, ends in position_ranges(schedule).items() if serial not in blind}
    commanders = {name: name for name in (COORDINATOR, SUCCESSOR)} | dict.fromkeys(reckless, COORDINATOR)
    return PlantWitness(commanders, ranges, speed_limits(schedule))


def _reckless(fault: Fault) -> str:
    """Return the name of the endpoint of a reckless holder."""
    return f"{RECKLESS} {fault.module} {fault.at_s}"


def run_schedule(schedule: Schedule, out: Path, witness: PlantWitness) -> Ending:
    """Run the session of a schedule into a folder, truth included, and return how it ended.

    Any exception but a `RobotError` is a defect of the product, and passes.
    """
    loop = VirtualLoop()
    taps: list[Tap] = []

    def tap(now_ns: int, endpoint: str, kind: str, key: str, payload: bytes) -> None:
        for each in taps:
            each(now_ns, endpoint, kind, key, payload)

    settings = VirtualSettings(
        schedule.robot,
        network(schedule.network),
        schedule.seed,
        "x5",
        physics=schedule.physics,
        safety=safety(schedule),
    )
    robot = FaultyRobot(settings, loop, VirtualNetwork(loop, tap), schedule.faults)
    session = _Session(schedule, robot, out, taps)
    taps.append(partial(session.witnessed, witness))
    robot.on_run.append(partial(witness.check, robot))
    try:
        return session.run()
    finally:
        limit_file_size(None)
        end_tasks(loop)
        robot.close()
        loop.close()


class _Session:
    """One session: its coordinator, restarted if the schedule says so, and its faults."""

    def __init__(self, schedule: Schedule, robot: FaultyRobot, out: Path, taps: list[Tap]):
        self._schedule = schedule
        self._robot = robot
        self._out = out
        self._taps = taps
        self._cable = CableState()
        self._way: Cable | None = None
        self._disturbances: list[Fault] = []
        self._sender = COORDINATOR
        self._restarts = self._killed = False
        self._full = 0
        self._strikers: dict[Fault, Intruder | RecklessHolder] = {}
        self._over = False

    def run(self) -> Ending:
        robot, loop = self._robot, self._robot.loop
        robot.start()
        for fault in self._schedule.faults:
            if fault.kind == "intruder":
                self._await_intruder(fault)
            elif fault.kind == "reckless holder":
                self._await_reckless(fault)
            loop.schedule_ns(round(fault.at_s * NS_PER_S), partial(self._begin, fault))
        loop.schedule_ns(round(LIMIT_S * NS_PER_S), self._end_of_time)
        ending = self._coordinate(resume=False)
        if ending.name == "lost" and self._restarts:
            self._sender = SUCCESSOR
            ending = self._coordinate(resume=True)
        if not self._schedule.expects:
            ending = ending._replace(unheard=frozenset(robot.serials) - robot.announced)
        ending = ending._replace(at_s=loop.now_ns / NS_PER_S)
        self._over = True
        if ending.name != "unbounded":
            self._wait(AFTERWARDS_S)
        limit_file_size(None)
        if ending.name in WITH_RESULT:
            write_truth(self._out / "truth.json", robot.world.robot)
            if self._schedule.plan.dynamics:
                robot.truth.save(self._out / "truth.npz")
        return ending

    def witnessed(
        self, witness: PlantWitness, now_ns: int, endpoint: str, kind: str, key: str, payload: bytes
    ) -> None:
        """Let the witness see a message: what a coordinator sent is as old as it left its program."""
        if self._way is not None and endpoint == self._sender and self._way.given_ns is not None:
            now_ns = self._way.given_ns
        witness.tap(now_ns, endpoint, kind, key, payload)

    def _coordinate(self, resume: bool) -> Ending:
        robot, loop = self._robot, self._robot.loop
        config = RunConfig(
            robot=robot.robot.name,
            out=self._out,
            sender=Sender(self._sender, SECRET),
            plan=self._schedule.plan,
            expect=len(robot.serials) if self._schedule.expects else None,
            resume=resume,
            inline=True,
            refined_previews=0,
            # No invariant looks at it, and its library waits for ever where its file cannot grow.
            keeps_view=False,
        )
        self._way = cable = Cable(robot.endpoint(self._sender), loop, self._cable)
        task: asyncio.Task[Result] | None = None
        try:
            run = Run(config, cable, lambda: loop.now_ns, loop.call_soon, SilentScreen())
            task = loop.create_task(run.run())
            loop.run_until_complete(task)
        except RobotError as error:
            if task is not None and not task.done():
                raise  # of an agent: it has died of it
            return Ending(type(error).__name__, str(error))
        except _Killed:
            self._bury()
            return Ending("lost")
        except _OutOfTime:
            return Ending("unbounded", f"no end within {LIMIT_S:.0f} s")
        return self._judged_by_itself()

    def _judged_by_itself(self) -> Ending:
        """Return how a program ends that has a result: what it says of it is in its file."""
        suspicions = json.loads((self._out / RESULT).read_text()).get("suspicions", [])
        return Ending("suspect", "; ".join(suspicions)) if suspicions else Ending("result")

    def _bury(self) -> None:
        """Let the coordinator's remains end without a trace in what it had written, and time pass."""
        session = self._out / SESSION
        crashed = session.read_bytes()
        end_tasks(self._robot.loop)
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
        if fault.kind in BEGINNINGS:
            self._robot.begin(fault)
            return
        beginnings: dict[str, Callable[[Fault], None]] = {
            "coordinator crash": self._kill,
            "coordinator restart": self._restart,
            "coordinator freeze": self._freeze,
            "intruder": self._strike,
            "reckless holder": self._strike,
            "disk full": self._fill_disk,
        }
        part = fault.nature.part
        if fault.kind in beginnings or part == "network":
            beginnings.get(fault.kind, self._disturb)(fault)

    def _later(self, for_s: float, call: Callable[[], None]) -> None:
        loop = self._robot.loop
        loop.schedule_ns(loop.now_ns + round(for_s * NS_PER_S), call)

    def _kill(self, fault: Fault) -> None:
        """Kill the first coordinator, once: its successor is to come to its end."""
        if not self._killed:
            self._killed = True
            self._robot.network.kill(COORDINATOR)
            raise _Killed

    def _restart(self, fault: Fault) -> None:
        self._restarts = True
        self._kill(fault)

    def _freeze(self, fault: Fault) -> None:
        self._robot.loop.freeze_tasks(round(fault.for_s * NS_PER_S))

    def _disturb(self, fault: Fault) -> None:
        self._disturbances.append(fault)
        self._set_cable()

        def mend() -> None:
            self._disturbances.remove(fault)
            self._set_cable()

        self._later(fault.for_s, mend)

    def _set_cable(self) -> None:
        """Let the cable do what all disturbances that go on together make of it."""
        present, cable = {fault.kind: fault for fault in self._disturbances}, self._cable
        corrupted = present.get("corrupted messages")
        cable.cut = "partition" in present
        cable.flip = None if corrupted is None else int(corrupted.size * (1 << 16))
        cable.copies = int("duplicated messages" in present)
        cable.delay_s = DELAY_S if "delayed messages" in present else 0.0

    def _await_intruder(self, fault: Fault) -> None:
        """Let an intruder hear all that is said; which module it attacks, and how, is in the fault's size."""
        robot = self._robot
        attack, part = divmod(fault.size * len(ATTACKS), 1.0)
        serial = robot.serials[int(part * len(robot.serials))]
        endpoint = robot.endpoint(f"intruder {fault.at_s}")
        intruder = Intruder(endpoint, robot.robot.name, serial, int(attack), self._schedule.seed)

        def overhear(now_ns: int, endpoint: str, kind: str, at: str, payload: bytes) -> None:
            leaf = parse(at).leaf if endpoint == self._sender and kind != "reply" else None
            if leaf in OVERHEARD and parse(at).serial == serial:
                intruder.overhear(leaf, payload)

        self._taps.append(overhear)
        self._strikers[fault] = intruder

    def _await_reckless(self, fault: Fault) -> None:
        """Let a second program with the coordinator's name and secret hear the module to be commanded."""
        robot, module = self._robot.robot, self._robot.robot.modules[fault.module]
        range_rad = position_ranges(self._schedule)[module.serial]
        target = Target(robot.name, module.serial, module_type(module.type), range_rad)
        endpoint, sender = self._robot.endpoint(_reckless(fault)), Sender(COORDINATOR, SECRET)
        self._strikers[fault] = RecklessHolder(endpoint, target, sender, fault.size)

    def _strike(self, fault: Fault) -> None:
        loop, striker = self._robot.loop, self._strikers[fault]
        until_ns = loop.now_ns + round(fault.for_s * NS_PER_S)

        def strike() -> None:
            if loop.now_ns >= until_ns:
                striker.close()
            else:
                striker.strike()
                self._later(striker.period_s, strike)

        strike()

    def _fill_disk(self, fault: Fault) -> None:
        """Let no file grow beyond what the recording has: writing on fails, as on a full disk."""
        session = self._out / SESSION
        size = session.stat().st_size if session.exists() else 0
        self._full += 1
        limit_file_size(size)

        def free() -> None:
            self._full -= 1
            if not self._full:
                limit_file_size(None)

        self._later(fault.for_s, free)


def limit_file_size(size: int | None) -> None:
    """Let the files of this process grow to a size in bytes, None for any."""
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard if size is None else size, hard))

"""A simulated robot in virtual time, every module an agent process of its own, to be broken at will."""

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from coordinator.excitation.plan import Plan
from coordinator.identification.result import Result
from coordinator.live_robot.messenger import Messenger
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.recording.recording import Entry, Recording
from coordinator.session.run import Run, RunConfig
from module_agent.firmware.config import config_of
from module_agent.hardware.hardware import SensorSample
from module_agent.hardware.loop_inside import LoopInside
from module_agent.hardware.wires import WiredModule
from module_agent.host import AgentHost, InlineWorker
from module_agent.network_emulation.impaired_transport import ImpairedTransport
from module_agent.network_emulation.profile import NetworkProfile, profile
from module_agent.transport.transport import Event, Reply, Request, Sample, Transport, Undeclare
from module_agent.wire.messages import Message
from module_agent.wire.refusal import WireError
from sim.robot.robot_file import load_robot
from sim.virtual_time.loop import LoopScheduler, VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from sim.world.truth import TruthLog, write_truth
from sim.world.world import World

T = TypeVar("T")
TICK_S = 1e-3


class Notes:
    """A screen that keeps what it is told."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def step(self, index: int, total: int, text: str) -> None:
        self.lines.append(f"[{index}/{total}] {text}")

    def note(self, text: str) -> None:
        self.lines.append(text)


class _Wires:
    """The hardware of one module of the rig's world."""

    def __init__(self, rig: "Rig", index: int):
        self._rig = rig
        self._index = index

    @property
    def modules(self) -> Sequence[WiredModule]:
        return [self._rig.world.modules[self._index]]

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        return [self._rig.samples[self._index]]

    def close(self) -> None:
        self._rig.pwm[self._index] = 0.0


class _Cuttable:
    """A transport whose endpoint can be cut off the network and joined again, as by pulling its cable."""

    def __init__(self, rig: "Rig", inner: Transport):
        self._rig = rig
        self._inner = inner

    def publish(self, key: str, payload: bytes) -> None:
        if not self._rig.cut:
            self._inner.publish(key, payload)

    def subscribe(self, key_expr: str, sink: Callable[[Event], None]) -> Undeclare:
        return self._inner.subscribe(key_expr, self._filtered(sink))

    def serve(self, key_expr: str, sink: Callable[[Event], None]) -> Undeclare:
        return self._inner.serve(key_expr, self._filtered(sink))

    def query(
        self, key: str, payload: bytes, timeout_s: float, sink: Callable[[Event], None], tag: int
    ) -> None:
        if self._rig.cut:
            lost = Reply(tag, key, None, "Timeout")
            self._rig.loop.call_later(timeout_s, sink, lost)
        else:
            self._inner.query(key, payload, timeout_s, sink, tag)

    def declare_alive(self, key: str) -> Undeclare:
        return self._inner.declare_alive(key)

    def watch_alive(self, key_expr: str, sink: Callable[[Event], None]) -> Undeclare:
        return self._inner.watch_alive(key_expr, sink)

    def close(self) -> None:
        self._inner.close()

    def _filtered(self, sink: Callable[[Event], None]) -> Callable[[Event], None]:
        def pass_on(event: Event) -> None:
            if not (self._rig.cut and isinstance(event, Sample | Request)):
                sink(event)

        return pass_on


class Rig:
    """World, network and agents of one robot; `cut` severs the coordinator from all of them.

    `beside` is a rig whose network, and with it whose time, this one shares.
    """

    def __init__(
        self,
        robot: str,
        network: str | NetworkProfile = "none",
        seed: int = 0,
        tap: Callable[[int, str, str, str, bytes], None] | None = None,
        noise: str = "x5",
        beside: "Rig | None" = None,
        **firmware: Any,
    ):
        self.robot = load_robot(robot)
        self._guest = beside is not None
        self.loop = VirtualLoop() if beside is None else beside.loop
        self.world = World(self.robot, seed, noise)
        self.network = VirtualNetwork(self.loop, tap) if beside is None else beside.network
        self.serials = self.robot.serials
        self.cut = False
        self.truth = TruthLog(self.world)
        self.pwm = [0.0] * len(self.serials)
        self.samples: Sequence[SensorSample] = []
        self.watchers: list[Callable[[], None]] = []
        self._profile = profile(network) if isinstance(network, str) else network
        self._seeds = np.random.SeedSequence(seed)
        self._firmware = firmware
        self._boots = 100 + 1000 * seed
        self.hosts: dict[str, AgentHost] = {}
        self._loops: dict[str, LoopInside] = {}
        for serial in self.serials:
            self.boot(serial)
        self._ticking = True
        self.loop.call_soon(self._tick, self.loop.time() + TICK_S)

    def boot(self, serial: str, **settings: Any) -> None:
        """Start the agent of a module, under a boot id of its own; `settings` of its firmware come first."""
        index = self.serials.index(serial)
        loop_inside = self._loops[serial] = LoopInside(_Wires(self, index))
        (module,) = loop_inside.information
        self._boots += 1
        config = config_of(module, self._boots, **self._firmware)._replace(**settings)
        self.hosts[serial] = AgentHost(
            self.robot.name,
            loop_inside,
            self.endpoint(f"agent-{serial}"),
            [config],
            InlineWorker(),
        )

    def kill(self, serial: str) -> None:
        """Do to an agent what SIGKILL does; its motor then gets zero PWM."""
        self.network.kill(f"agent-{serial}")
        del self.hosts[serial]
        self.pwm[self.serials.index(serial)] = 0.0

    def freeze(self, serial: str) -> None:
        """Stop an agent in its tracks: its token stays, nothing else does."""
        del self.hosts[serial]
        self.pwm[self.serials.index(serial)] = 0.0

    def endpoint(self, name: str) -> Transport:
        rng = np.random.default_rng(self._seeds.spawn(1)[0])
        return ImpairedTransport(
            self.network.endpoint(name),
            self._profile,
            rng,
            LoopScheduler(self.loop),
            receiver="module" if name.startswith("agent-") else "coordinator",
        )

    def _tick(self, next_s: float) -> None:
        if not self._ticking:
            return
        self.samples = self.world.step(self.pwm)
        for serial, host in list(self.hosts.items()):
            host.cycle()
            # On the bus this PWM goes into the next exchange, and so into the very next step of the world.
            (self.pwm[self.serials.index(serial)],) = self._loops[serial].pwm
        self.truth.record()
        for watcher in self.watchers:
            watcher()
        self.loop.call_at(next_s, self._tick, next_s + TICK_S)

    def state(self, serial: str) -> str:
        return self.hosts[serial].modules[0].firmware.state

    def at(self, when_s: float, call: Callable[[], None]) -> None:
        """Do something at a virtual time."""
        self.loop.call_at(when_s, call)

    def when(self, condition: Callable[[], bool], call: Callable[[], None]) -> None:
        """Do something once, at the first tick at which a condition holds."""

        def watch() -> None:
            if condition():
                self.watchers.remove(watch)
                call()

        self.watchers.append(watch)

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        return self.loop.run_until_complete(work)

    def link(self, sender: str = "tester") -> tuple[Messenger, Recording, ModuleGroup]:
        """A coordinator's hold on the robot."""
        recording = Recording()

        def record(entry: Entry) -> Message | None:
            try:
                message = recording.add(entry)
            except WireError:
                return None
            return message if isinstance(message, Message) else None

        radio = Messenger(
            _Cuttable(self, self.endpoint(sender)),
            self.robot.name,
            lambda: self.loop.now_ns,
            self.loop.call_soon,
            record,
        )
        radio.start()
        return radio, recording, ModuleGroup(radio, recording, lambda: self.loop.now_ns, sender)

    def session(self, out: Path, plan: Plan, resume: bool = False, sender: str = "coordinator") -> Result:
        """Run a whole identification and write its folder, truth included."""
        result = self.run(self.begin(out, plan, resume, sender).run())
        write_truth(out / "truth.json", self.robot)
        self.truth.save(out / "truth.npz")
        return result

    def begin(
        self,
        out: Path,
        plan: Plan,
        resume: bool = False,
        sender: str = "coordinator",
        expect: int | None = None,
    ) -> Run:
        """Make a coordinator that is to run a whole identification."""
        notes = Notes()
        config = RunConfig(
            self.robot.name, out, sender, plan, expect or len(self.serials), resume=resume, inline=True
        )
        run = Run(
            config,
            _Cuttable(self, self.endpoint(sender)),
            lambda: self.loop.now_ns,
            self.loop.call_soon,
            notes,
        )
        self.notes = notes.lines
        return run

    def end_tasks(self) -> None:
        """End what a killed coordinator has left behind, as the end of its process would."""
        left = sorted(asyncio.all_tasks(self.loop), key=lambda task: task.get_name())

        async def end() -> None:
            for task in left:
                task.cancel()
            await asyncio.gather(*left, return_exceptions=True)

        self.loop.run_until_complete(end())

    def close(self) -> None:
        self._ticking = False
        if not self._guest:
            self.end_tasks()
        for host in self.hosts.values():
            host.close()
        self.world.close()
        if not self._guest:
            self.loop.close()

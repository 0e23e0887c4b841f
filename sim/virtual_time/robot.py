"""One robot in virtual time: world, network, and one agent for every module, on one event loop."""

import asyncio
import itertools
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from coordinator.runtime.event_loop import Interruption, run_to_end
from module_agent.control.safety import Safety
from module_agent.firmware.config import config_of
from module_agent.firmware.quiet_ticks import QUIET, QuietTicks
from module_agent.hardware.hardware import Modules, SensorSample, WiredModule
from module_agent.hardware.hebi_modules import HebiModules
from module_agent.hardware.hebi_network import describe
from module_agent.hardware.loop_inside import LoopInside
from module_agent.host import AgentHost, InlineWorker
from module_agent.network_emulation.impaired_transport import ImpairedTransport
from module_agent.network_emulation.profile import NetworkProfile
from sim.geometry.pose import Array
from sim.hebi_stand_in.library import Group, StandIn
from sim.hebi_stand_in.modules import ModuleNetwork
from sim.imperfections.noise_profile import NoiseProfile
from sim.physics.engine import Physics
from sim.robot.robot_file import Robot
from sim.virtual_time.loop import LoopScheduler, VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from sim.virtual_time.quiet_run import QuietRun
from sim.world.external_force import Push
from sim.world.truth import TruthLog
from sim.world.world import TICK_NS, World

T = TypeVar("T")


class VirtualSettings(NamedTuple):
    """The settings of a virtual robot; every seed in it follows from `seed`.

    `noise_seed` makes it another day of the same robot: other noise and network, the same modules.
    `pushes` act on the world from outside; `physics` is the engine that moves its bodies. `safety` are the
    limits of modules by serial; the others have their type's. With `hebi_rate_hz` the agents speak to the
    modules at this rate through the driver of real ones, over a stand-in for hebi-py.
    """

    robot: Robot
    profile: NetworkProfile
    seed: int = 0
    noise: str | NoiseProfile | None = None
    noise_seed: int | None = None
    pushes: tuple[Push, ...] = ()
    imu_rate_hz: float = 250.0
    physics: Physics | None = None
    safety: Mapping[str, Safety] = MappingProxyType({})
    hebi_rate_hz: float | None = None


class Wire:
    """The wires inside one module: the world's tick has passed already when the agent asks for it."""

    def __init__(self, robot: "VirtualRobot", index: int):
        self._robot = robot
        self._index = index

    @property
    def modules(self) -> Sequence[WiredModule]:
        """The module, alone."""
        return (self._robot.world.modules[self._index],)

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        """Return the module's sample of the tick that has passed; `pwm` is taken by the robot itself."""
        return (self._robot.world.readings[self._index],)

    def close(self) -> None:
        """Turn the motor off."""
        self._robot.pwm[self._index] = 0.0


@contextmanager
def virtual_robot(settings: VirtualSettings, **firmware: Any) -> "Iterator[VirtualRobot]":
    """Yield a robot in a loop of its own, see `VirtualRobot`; both end with the context."""
    robot = VirtualRobot(settings, VirtualLoop(), **firmware)
    try:
        yield robot
    finally:
        robot.close()
        robot.loop.close()


class VirtualRobot:
    """Ticks the world and all agents once a virtual millisecond.

    Every agent has its own endpoint on the network, impaired by separate draws, like an agent process.
    `pwm` is what the motors get in the next tick; `on_tick` are called at the end of every tick. `on_run` are
    called after a call of one or more ticks, before what their agents do is sent: they receive what
    `QuietRun.seen` has of each.

    Args:
        settings: robot, network, noise and seeds.
        loop: the event loop in whose time it lives.
        network: the network of another robot to be part of; by default its own.
        firmware: settings of all modules' firmware, as in `FirmwareConfig`.
    """

    def __init__(
        self,
        settings: VirtualSettings,
        loop: VirtualLoop,
        network: VirtualNetwork | None = None,
        **firmware: Any,
    ):
        self.loop = loop
        self.robot = settings.robot
        self.serials = settings.robot.serials
        self._index = {serial: index for index, serial in enumerate(self.serials)}
        options = {
            name: getattr(settings, name) for name in ("noise_seed", "pushes", "imu_rate_hz", "physics")
        }
        self.world = World(settings.robot, settings.seed, settings.noise, **options)
        self.network = VirtualNetwork(loop) if network is None else network
        self.truth = self._truth_of(self.world)
        self.pwm = [0.0] * len(self.serials)
        self._quiet = QuietTicks(len(self.serials))
        self._hebi_rate_hz = settings.hebi_rate_hz
        self.hebi = None if settings.hebi_rate_hz is None else ModuleNetwork(self.world.modules)
        self._ticks = 0
        self._run = QuietRun(self.world, self.truth, self._quiet)
        self.on_tick: list[Callable[[], None]] = []
        self.on_run: list[Callable[[Array], None]] = []
        self._profile = settings.profile
        self._safety = settings.safety
        self._endpoint_seeds, self._boot_ids = self._draws(settings)
        self._firmware = firmware
        self.hosts: dict[str, AgentHost] = {}
        for serial in self.serials:
            self.boot(serial)
        self._running = False

    def _truth_of(self, world: World) -> TruthLog:
        """Return what steps the world, and gives the modules its readings."""
        return TruthLog(world)

    def _draws(self, settings: VirtualSettings) -> tuple[np.random.SeedSequence, Iterator[int]]:
        """Return the seeds of endpoints, and boot ids."""
        day = settings.seed if settings.noise_seed is None else (settings.seed, settings.noise_seed)
        endpoints, boots = np.random.SeedSequence(day).spawn(2)
        rng = np.random.default_rng(boots)
        first = rng.integers(1, 2**63, size=len(self.serials)).tolist()
        # Those of modules that start again.
        return endpoints, itertools.chain(first, iter(lambda: int(rng.integers(1, 2**63)), 0))

    def endpoint(self, name: str) -> ImpairedTransport:
        """Return a transport of the virtual network, impaired as the profile says."""
        rng = np.random.default_rng(self._endpoint_seeds.spawn(1)[0])
        return ImpairedTransport(
            self.network.endpoint(name),
            self._profile,
            rng,
            LoopScheduler(self.loop),
            receiver="module" if name in self.serials else "coordinator",
        )

    def boot(self, serial: str, **firmware: Any) -> None:
        """Start the agent of a module under a new boot id; `firmware` are settings of this module alone."""
        place = self._index[serial]
        modules = self._modules(place)
        config = config_of(modules.information[0], next(self._boot_ids), **self._firmware)._replace(
            **firmware
        )
        endpoint = self.endpoint(serial)
        self.hosts[serial] = AgentHost(
            *(self.robot.name, modules, endpoint, [config], InlineWorker()),
            *((self._quiet, place) if self.hebi is None else ()),
        )

    def _modules(self, place: int) -> Modules:
        """Return the hardware of one module's agent: the simulated module, or the driver of real ones."""
        if self.hebi is None or self._hebi_rate_hz is None:
            return LoopInside(Wire(self, place), self._safety)
        library = StandIn(self.hebi)
        group = Group([self.hebi.all[place]], lambda: True)
        information = describe(library, group, self._hebi_rate_hz)
        # The robot's tick calls the agents when they are due.
        return HebiModules(library, group, information, lambda: None)

    def start(self) -> None:
        """Begin to tick."""
        self._running = True
        self.loop.call_soon(self._tick)

    def _tick(self) -> None:
        if not self._running:
            return
        if self.hebi is None:
            self._tick_agents()
        else:
            self._tick_hebi(self.hebi)
        for call in self.on_tick:
            call()
        self.loop.schedule_ns(self.loop.now_ns + TICK_NS, self._tick)

    def _tick_hebi(self, modules: ModuleNetwork) -> None:
        """Let the modules tick by themselves, and all agents where a tick of theirs is due."""
        self.pwm[:] = modules.tick(self.truth.exchange(self.pwm))
        self._ticks += 1
        if self._ticks % round(1e9 / (TICK_NS * (self._hebi_rate_hz or 1.0))) == 0:
            for host in list(self.hosts.values()):
                host.cycle()

    def _tick_agents(self) -> None:
        """Let all agents tick, with the loops of their modules."""
        hosts, quiet = list(self.hosts.items()), self._quiet
        busy = [place for _, host in hosts for place in host.collect()]
        ahead, ticks = 0 if self.on_tick else self.truth.ticks_ahead, 1
        if not ahead:
            readings = self.truth.exchange(self.pwm)
            results = quiet.run(readings, busy)
            self._run.see(self.pwm)
        else:
            alone = not busy and not any(host.has_work for _, host in hosts)
            alive = [self._index[serial] for serial, _ in hosts]
            most = self._ticks_alone(ahead) if alone else 1
            ticks, results = self._run.run(self.pwm, alive, busy, most)
            readings = self.truth.readings
            self.loop.pass_ns((ticks - 1) * TICK_NS)
        for see in self.on_run:
            see(self._run.seen[:ticks])
        for serial, host in hosts:
            if results[self._index[serial]] != QUIET or host.has_work:
                host.finish(readings, results)
        pwm = quiet.pwm.tolist()
        for serial, _ in hosts:
            self.pwm[self._index[serial]] = pwm[self._index[serial]]

    def _ticks_alone(self, most: int) -> int:
        """Return how many ticks there are, this one included, before anything else happens, or `most`."""
        free_ns = self.loop.free_ns
        return most if free_ns is None else min(max(1 + (free_ns - 1) // TICK_NS, 1), most)

    def kill(self, serial: str) -> None:
        """End an agent as SIGKILL does: its motor gets zero PWM, its network endpoint is gone.

        A module on HEBI's network goes on under its last command for the command's lifetime.
        """
        self.freeze(serial)
        self.network.kill(serial)

    def freeze(self, serial: str) -> None:
        """Run an agent no more, as SIGSTOP does: its motor gets zero PWM, its endpoint stays."""
        del self.hosts[serial]
        if self.hebi is not None:
            return
        self._quiet.detach(self._index[serial])
        self.pwm[self._index[serial]] = 0.0

    def complete(
        self,
        work: Coroutine[Any, Any, T],
        on_signal: Callable[[Interruption], None] = lambda interruption: None,
    ) -> T:
        """Tick until `work` ends, and then end with the loop; return its result or raise its error.

        `on_signal` receives the function that a signal handler calls to end the work with
        `asyncio.CancelledError` after its clean-up.
        """

        async def ticking() -> T:
            try:
                return await work
            finally:
                self.stop()
                await asyncio.sleep(0)

        self.start()
        task = self.loop.create_task(ticking())
        on_signal(Interruption(self.loop, task))
        return run_to_end(self.loop, task)

    def stop(self) -> None:
        """Tick no more."""
        self._running = False

    def close(self) -> None:
        """End agents and world."""
        self.stop()
        for host in self.hosts.values():
            host.close()
        self.world.close()

"""One robot in virtual time: world, network, and one agent for every module, on one event loop."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from module_agent.firmware.config import config_of
from module_agent.hardware.hardware import SensorSample
from module_agent.hardware.loop_inside import LoopInside
from module_agent.hardware.wires import WiredModule
from module_agent.host import AgentHost, InlineWorker
from module_agent.network_emulation.impaired_transport import ImpairedTransport
from module_agent.network_emulation.profile import NetworkProfile
from module_agent.transport.transport import Transport
from sim.imperfections.noise_profile import NoiseProfile
from sim.robot.robot_file import Robot
from sim.virtual_time.loop import LoopScheduler, VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from sim.world.external_force import Push
from sim.world.truth import TruthLog
from sim.world.world import TICK_NS, World


class VirtualSettings(NamedTuple):
    """What a virtual robot is told; every seed in it follows from `seed`.

    `noise_seed` makes it another day of the same robot: other noise and network, the same modules.
    `pushes` act on the world from outside.
    """

    robot: Robot
    profile: NetworkProfile
    seed: int = 0
    noise: str | NoiseProfile | None = None
    feedback_rate_hz: float = 250.0
    noise_seed: int | None = None
    pushes: tuple[Push, ...] = ()


class _Wires:
    """The wires inside one module: the world's tick has passed already when the agent asks for it."""

    def __init__(self, robot: "VirtualRobot", index: int):
        self._robot = robot
        self._index = index

    @property
    def modules(self) -> Sequence[WiredModule]:
        return (self._robot.world.modules[self._index],)

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        return (self._robot.samples[self._index],)

    def close(self) -> None:
        self._robot.pwm[self._index] = 0.0


class VirtualRobot:
    """Ticks the world and all agents once a virtual millisecond.

    Every agent has its own endpoint on the network, impaired by its own draws, as a process of its own has.
    """

    def __init__(self, settings: VirtualSettings, loop: VirtualLoop):
        day = settings.seed if settings.noise_seed is None else (settings.seed, settings.noise_seed)
        seeds = np.random.SeedSequence(day).spawn(2)
        self.loop = loop
        self.world = World(
            settings.robot,
            settings.seed,
            settings.noise,
            noise_seed=settings.noise_seed,
            pushes=settings.pushes,
        )
        self.network = VirtualNetwork(loop)
        self.truth = TruthLog(self.world)
        self.pwm = [0.0] * len(self.world.modules)
        self.samples: Sequence[SensorSample] = ()
        self._profile = settings.profile
        self._network_seeds = seeds[0]
        boots = np.random.default_rng(seeds[1]).integers(1, 2**63, size=len(self.world.modules))
        self.hosts: dict[str, AgentHost] = {}
        self._loops: dict[str, LoopInside] = {}
        for index, (serial, boot) in enumerate(zip(settings.robot.serials, boots, strict=True)):
            loop_inside = self._loops[serial] = LoopInside(_Wires(self, index))
            (module,) = loop_inside.information
            self.hosts[serial] = AgentHost(
                settings.robot.name,
                loop_inside,
                self.endpoint(serial),
                [config_of(module, int(boot), feedback_rate_hz=settings.feedback_rate_hz)],
                InlineWorker(),
            )
        self._index = {module.serial: index for index, module in enumerate(self.world.modules)}
        self._running = False

    def endpoint(self, name: str) -> Transport:
        """Return a transport of the virtual network, impaired as the profile says."""
        rng = np.random.default_rng(self._network_seeds.spawn(1)[0])
        return ImpairedTransport(
            self.network.endpoint(name),
            self._profile,
            rng,
            LoopScheduler(self.loop),
            receiver="module" if any(name == m.serial for m in self.world.modules) else "coordinator",
        )

    def start(self) -> None:
        """Begin to tick."""
        self._running = True
        self.loop.call_soon(self._tick)

    def _tick(self) -> None:
        if not self._running:
            return
        self.samples = self.world.step(self.pwm)
        self.truth.record()
        for serial, host in self.hosts.items():
            host.cycle()
            (self.pwm[self._index[serial]],) = self._loops[serial].pwm
        self.loop.schedule_ns(self.loop.now_ns + TICK_NS, self._tick)

    def kill(self, serial: str) -> None:
        """End an agent as SIGKILL does: its motor gets zero PWM, its network endpoint is gone."""
        del self.hosts[serial]
        self.network.kill(serial)
        self.pwm[self._index[serial]] = 0.0

    def stop(self) -> None:
        """Tick no more."""
        self._running = False

    def close(self) -> None:
        """End agents and world."""
        self.stop()
        for host in self.hosts.values():
            host.close()
        self.world.close()

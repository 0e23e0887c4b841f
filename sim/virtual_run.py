"""A whole run in virtual time: the same agents, coordinator and world in one process."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.plan import Plan
from coordinator.result import Result
from coordinator.run import Run, RunConfig
from coordinator.viewer_feed import Screen
from module_agent.catalogue import module_type
from module_agent.firmware.config import FirmwareConfig, catalogue_limits
from module_agent.hardware import HardwareModule
from module_agent.host import AgentHost, InlineWorker
from module_agent.wire.impaired_transport import ImpairedTransport
from module_agent.wire.network_profile import NetworkProfile, profile
from module_agent.wire.transport import Transport
from sim.robot_file import Robot
from sim.truth import TruthLog, write_truth
from sim.virtual_loop import LoopScheduler, VirtualLoop
from sim.virtual_network import VirtualNetwork
from sim.world import InProcessHardware, World

TICK_S = 0.001
COORDINATOR = "coordinator"


class VirtualConfig(NamedTuple):
    """What a virtual run is told; every seed in it follows from `seed`."""

    robot: Robot
    out: Path
    seed: int = 0
    network: str = "lan"
    noise: str | None = None
    plan: Plan = Plan()
    connect_viewer: str | None = None
    feedback_rate_hz: float = 250.0


class VirtualRobot:
    """World, network and agents of one robot on one virtual loop; `tick` is called once a millisecond."""

    def __init__(self, config: VirtualConfig, loop: VirtualLoop):
        seeds = np.random.SeedSequence(config.seed).spawn(3)
        self.loop = loop
        self.world = World(config.robot, config.seed, config.noise)
        self.network = VirtualNetwork(loop)
        self._profile: NetworkProfile = profile(config.network)
        self._network_seeds = seeds[0]
        boots = np.random.default_rng(seeds[1]).integers(1, 2**63, size=len(self.world.modules))
        configs = [
            _firmware(module, int(boot), config.feedback_rate_hz)
            for module, boot in zip(self.world.modules, boots, strict=True)
        ]
        self.host = AgentHost(
            config.robot.name,
            InProcessHardware(self.world),
            self.endpoint("agents"),
            configs,
            InlineWorker(),
        )
        self.truth = TruthLog(self.world)
        self._running = False

    def endpoint(self, name: str) -> Transport:
        """Return a transport of the virtual network, impaired as the profile says."""
        rng = np.random.default_rng(self._network_seeds.spawn(1)[0])
        return ImpairedTransport(self.network.endpoint(name), self._profile, rng, LoopScheduler(self.loop))

    def start(self) -> None:
        """Begin to tick, once a virtual millisecond."""
        self._running = True
        self.loop.call_soon(self._tick, self.loop.time() + TICK_S)

    def _tick(self, next_s: float) -> None:
        if not self._running:
            return
        self.host.cycle()
        self.truth.record()
        self.loop.call_at(next_s, self._tick, next_s + TICK_S)

    def stop(self) -> None:
        """Tick no more."""
        self._running = False

    def close(self) -> None:
        """End agents and world."""
        self.stop()
        self.host.close()
        self.world.close()


def _firmware(module: HardwareModule, boot: int, rate_hz: float) -> FirmwareConfig:
    kind = module_type(module.module_type)
    return FirmwareConfig(
        serial=module.serial,
        kind=kind,
        boot=boot,
        limits=catalogue_limits(kind),
        tick_ns=module.tick_ns,
        imu_period_ns=module.imu_period_ns,
        feedback_rate_hz=rate_hz,
    )


def run_virtual(
    config: VirtualConfig, screen: Screen, between: Callable[[VirtualRobot], None] | None = None
) -> Result:
    """Run one identification in virtual time and write the run's folder, truth included.

    `between` is handed the robot before the run begins, to schedule faults on its loop.
    """
    loop = VirtualLoop()
    robot = VirtualRobot(config, loop)
    try:
        run = Run(
            RunConfig(
                robot=config.robot.name,
                out=config.out,
                sender=COORDINATOR,
                plan=config.plan,
                expect=len(robot.world.modules),
                connect_viewer=config.connect_viewer,
                inline=True,
            ),
            robot.endpoint(COORDINATOR),
            lambda: loop.now_ns,
            loop.call_soon,
            screen,
        )
        if between is not None:
            between(robot)
        robot.start()
        result: Result = loop.run_until_complete(_to_end(run, robot))
        write_truth(config.out / "truth.json", config.robot)
        robot.truth.save(config.out / "truth.npz")
        return result
    finally:
        robot.close()
        loop.close()


async def _to_end(run: Run, robot: VirtualRobot) -> Result:
    try:
        return await run.run()
    finally:
        robot.stop()
        await asyncio.sleep(0)

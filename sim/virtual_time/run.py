"""A whole run in virtual time: the same agents, coordinator and world in one process."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from coordinator.excitation.plan import Plan
from coordinator.identification.result import Result
from coordinator.live_robot.messenger import Sender
from coordinator.runtime.event_loop import Interruption
from coordinator.session.run import Run, RunConfig
from coordinator.viewer.feed import Screen
from module_agent.control.safety import Safety
from module_agent.network_emulation.profile_file import network
from sim.imperfections.noise_profile import NoiseProfile
from sim.physics.engine import Physics
from sim.robot.robot_file import Robot
from sim.robot.robot_tree import true_chain
from sim.scoring.truth_view import TruthView
from sim.virtual_time.robot import VirtualRobot, VirtualSettings, virtual_robot
from sim.world.external_force import Push
from sim.world.truth import write_truth

COORDINATOR = "coordinator"
SENDER = Sender(COORDINATOR, b"virtual-secret-1")
# Half the thesis' durations: enough for topology, kinematics and every fault.
QUICK_PLAN = Plan(
    dynamics=False,
    discover_s=0.3,
    link_s=0.3,
    settle_s=0.3,
    rest_s=1.0,
    travel_speed_rad_s=1.5,
    sine_centre_s=1.2,
    sine_sigma_s=0.5,
)


class VirtualConfig(NamedTuple):
    """Settings of a virtual run; all randomness follows from `seed`, and from `noise_seed` if given.

    `baseline`, `measured`, `report` and `refined_previews` as in `RunConfig`; by default there is no preview.
    `pushes` act on the robot from outside. `safety` are the limits of modules by serial.
    """

    robot: Robot
    out: Path
    seed: int = 0
    network: str = "lan"
    noise: str | NoiseProfile | None = None
    plan: Plan = Plan()
    noise_seed: int | None = None
    refined_previews: int = 0
    baseline: Path | None = None
    pushes: tuple[Push, ...] = ()
    imu_rate_hz: float = 250.0
    physics: Physics | None = None
    measured: tuple[Path, ...] = ()
    report: bool = False
    safety: Mapping[str, Safety] = MappingProxyType({})


class SilentScreen:
    """A screen that shows nothing."""

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        """Ignore the beginning of a step."""

    def note(self, text: str) -> None:
        """Ignore a note."""


def run_virtual(
    config: VirtualConfig,
    screen: Screen = SilentScreen(),  # noqa: B008 - it has no state
    between: Callable[[VirtualRobot], None] | None = None,
    on_signal: Callable[[Interruption], None] = lambda interruption: None,
) -> Result:
    """Run one identification in virtual time and write the run's folder, truth included.

    `between` receives the robot before the run begins, to schedule faults on its loop; `on_signal` as in
    `VirtualRobot.complete`.
    """
    settings = VirtualSettings(
        robot=config.robot,
        profile=network(config.network),
        seed=config.seed,
        noise=config.noise,
        noise_seed=config.noise_seed,
        pushes=config.pushes,
        imu_rate_hz=config.imu_rate_hz,
        physics=config.physics,
        safety=config.safety,
    )
    with virtual_robot(settings, imu=config.plan.imu) as robot:
        run = Run(
            RunConfig(
                robot=config.robot.name,
                out=config.out,
                sender=SENDER,
                plan=config.plan,
                expect=len(robot.world.modules),
                inline=True,
                refined_previews=config.refined_previews,
                baseline=config.baseline,
                measured=config.measured,
                report=config.report,
            ),
            robot.endpoint(COORDINATOR),
            lambda: robot.loop.now_ns,
            robot.loop.call_soon,
            screen,
            TruthView(true_chain(robot.world.robot), [module.type for module in config.robot.modules]),
        )
        if between is not None:
            between(robot)
        result = robot.complete(run.run(), on_signal)
        write_truth(config.out / "truth.json", config.robot, robot.world)
        robot.truth.save(config.out / "truth.npz")
        return result

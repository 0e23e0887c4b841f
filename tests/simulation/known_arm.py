"""A kit arm with modules as delivered, and its runs on several days, which several files are about."""

from pathlib import Path

from coordinator.excitation.plan import Plan
from coordinator.runtime.terminal import Terminal
from sim.benchmark.cases.monitoring import Subject
from sim.geometry.link_parts import FreePose
from sim.robot.robot_file import load_robot
from sim.robot.variants import loaded
from sim.virtual_time.robot import VirtualRobot
from sim.virtual_time.run import VirtualConfig, run_virtual

ARM = load_robot("a2085_03")
SEED, NETWORK, NOISE = 6, "lan", "x5"
PLAN: Plan = Subject(brief=True).plan
HELD = FreePose(mass_kg=0.2, com_xyz_m=(0.04, 0.0, 0.02), inertia=(1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0))
LOADED = loaded(ARM, ARM.serials[-1], HELD)
GRASPED_S = 20.0


def lived(out: Path, day: int, grasps: bool) -> Path:
    """Run the arm on some day, and let it grasp something meanwhile."""

    def between(robot: VirtualRobot) -> None:
        if grasps:
            robot.loop.schedule_ns(round(GRASPED_S * 1e9), lambda: robot.world.become(LOADED))

    config = VirtualConfig(ARM, out, seed=SEED, noise_seed=day, network=NETWORK, noise=NOISE, plan=PLAN)
    run_virtual(config, Terminal(True), between)
    return out

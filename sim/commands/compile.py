"""`x5-sim compile`: compile all kernels before the first run needs them, in parallel processes.

The machine code is kept where every later process finds it: in the `__pycache__` of the package, or in the
cache folder of the user if the package is read-only.
"""

import asyncio
import subprocess
import sys
import threading
import time
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import typer

from module_agent.model.errors import RobotError

if TYPE_CHECKING:
    from sim.robot.robot_file import Robot

# Modules with kernels. A group is compiled in a process of its own.
GROUPS = {
    "world": (
        "sim.physics.rigid_kernels",
        "sim.physics.engine",
        "sim.actuator.actuator_kernel",
        "sim.actuator.thermal",
        "sim.sensors.imu",
        "sim.sensors.joint",
        "sim.sensors.sensors",
        "sim.sensors.alteration",
        "sim.world.world_kernel",
        "sim.virtual_time.quiet_run",
        "sim.world.barrier",
        "module_agent.firmware.tick_kernel",
        "module_agent.firmware.run_kernel",
        "module_agent.firmware.bus_run",
        "module_agent.hardware.bus_client",
        "module_agent.hardware.packet_kernel",
    ),
    "regressor": ("module_agent.model.regressor_kernel",),
    "IMUs' readings": ("coordinator.batch_estimation.imu_kernel",),
}
ROBOT = "thesis_171_horizontal"
# Samples that are enough to fit a chain to.
REST = 8
# The world compiles what it needs before it serves.
COMPILED_S = 300.0


def compile_kernels() -> None:
    """Compile all kernels, so that the first run does not wait for them."""
    started_s = time.monotonic()
    workers = [subprocess.Popen([sys.executable, "-m", "sim.commands.compile", name]) for name in GROUPS]
    failed = [name for name, worker in zip(GROUPS, workers, strict=True) if worker.wait() != 0]
    if failed:
        raise RobotError(
            f"the kernels of {', '.join(failed)} were not compiled, for the reason above; "
            "a run compiles them when it needs them"
        )
    typer.echo(f"all kernels are compiled, after {time.monotonic() - started_s:.0f} s", err=True)


def call_kernels(group: str) -> None:
    """Call every kernel of a group with arguments of the types that a run has."""
    calls = {"world": _call_world, "regressor": _call_regressor, "IMUs' readings": _call_estimator}
    calls[group]()


def _call_world() -> None:
    from module_agent.firmware.quiet_ticks import QuietTicks
    from module_agent.network_emulation.profile import PROFILES
    from sim.physics.engine import Physics
    from sim.robot.robot_file import load_robot
    from sim.sensors.alteration import alter, unaltered
    from sim.virtual_time.robot import VirtualSettings, virtual_robot
    from sim.world.world import World

    robot = load_robot(ROBOT)
    engines: tuple[Physics, ...] = ("compiled", "pybullet")
    for physics in engines:
        world = World(robot, seed=1, physics=physics)
        readings = world.exchange([0.0] * len(robot.modules))
        world.close()
    read = readings.integers, readings.floats
    alter(0, *read, tuple(unaltered(len(readings))), *read)
    QuietTicks(len(readings)).run(readings, busy=[])
    _call_bus(robot)
    with virtual_robot(VirtualSettings(robot, PROFILES["none"])) as alone:
        alone.complete(asyncio.sleep(0.01))


def _call_bus(robot: "Robot") -> None:
    from module_agent.firmware.bus_run import BusRun
    from module_agent.firmware.quiet_ticks import QuietTicks
    from module_agent.hardware.bus_client import BusClient
    from module_agent.hardware.loop_inside import LoopInside
    from sim.world.bus_server import BusServer
    from sim.world.truth import TruthLog
    from sim.world.world import World

    with TemporaryDirectory() as folder, BusServer(f"{folder}/bus", TruthLog(World(robot, seed=1))) as server:
        stopping: list[bool] = []
        serving = threading.Thread(target=server.run, args=(None, lambda: bool(stopping)))
        serving.start()
        try:
            bus = BusClient(f"{folder}/bus", robot.serials, COMPILED_S)
            loops = LoopInside(bus)
            BusRun(loops, bus, QuietTicks(len(robot.serials)), np.zeros(1, np.uint8)).run([], 1)
            loops.close()
        finally:
            stopping.append(True)
            serving.join()


def _call_regressor() -> None:
    from module_agent.model.regressor import inverse_dynamics, torque_regressor
    from sim.robot.robot_file import load_robot
    from sim.robot.robot_tree import true_chain

    robot = load_robot(ROBOT)
    chain, still = true_chain(robot), np.zeros((1, len(robot.modules)))
    torque_regressor(chain, still, still, still)
    inverse_dynamics(chain, np.ones(10 * len(robot.modules)), still, still, still)


def _call_estimator() -> None:
    from coordinator.batch_estimation.estimator import refine_chain
    from coordinator.batch_estimation.imu_prediction import body_motions, imu_readings
    from coordinator.batch_estimation.link_compliance import link_loads
    from coordinator.batch_estimation.sensor_data import SensorData
    from coordinator.synchronisation.motion_windows import RATE_HZ
    from module_agent.model.catalogue import module_type
    from sim.robot.robot_file import load_robot
    from sim.robot.robot_tree import true_chain

    robot = load_robot(ROBOT)
    types = [module_type(one.type) for one in robot.modules]
    chain, at_rest = true_chain(robot), np.zeros((REST, len(robot.modules)))
    refine_chain(chain, SensorData(*(at_rest,) * 3, *imu_readings(chain, *(at_rest,) * 3)))
    link_loads(chain, types, body_motions(chain, *(at_rest,) * 3), at_rest, RATE_HZ)


if __name__ == "__main__":
    call_kernels(sys.argv[1])

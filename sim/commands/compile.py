"""`x5-sim compile`: compile all kernels before the first run needs them, in parallel processes.

The machine code is kept where every later process finds it: in the `__pycache__` of the package, or in the
cache folder of the user if the package is read-only.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import typer

from module_agent.model import compiled as kernels
from module_agent.model.errors import RobotError

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

# Modules with kernels. A group is compiled in a process of its own.
GROUPS = {
    "bodies": ("sim.physics.rigid_kernels",),
    "actuators and sensors": (
        "sim.actuator.actuator_kernel",
        "sim.actuator.thermal",
        "sim.sensors.imu",
        "sim.sensors.joint",
        "sim.sensors.sensors",
    ),
    "regressor": ("module_agent.model.regressor_kernel",),
    "firmware": ("module_agent.firmware.tick_kernel",),
}
# Enough for the IMU to be read.
TICKS = 10


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


def compile_group(modules: tuple[str, ...]) -> None:
    """Compile the kernels of some modules; those of others, which a run calls in between, are interpreted."""
    # Kernels take the decorator from its module when theirs is imported, which is in `call_kernels`.
    for name, decorator in (("compiled", kernels.compiled), ("inlined", kernels.inlined)):
        vars(kernels)[name] = partial(_of_group, modules, decorator)
    call_kernels()


def _of_group(
    modules: tuple[str, ...], decorator: Decorator, function: Callable[..., Any]
) -> Callable[..., Any]:
    return decorator(function) if function.__module__ in modules else _interpreted(function)


def call_kernels() -> None:
    """Call every kernel with arguments of the types that a run has."""
    from module_agent.firmware.quiet_ticks import QuietTicks
    from module_agent.model.regressor import inverse_dynamics, torque_regressor
    from sim.robot.robot_file import load_robot
    from sim.robot.robot_tree import true_chain
    from sim.world.world import World

    robot = load_robot("thesis_171_horizontal")
    still = np.zeros((1, len(robot.modules)))
    world = World(robot, seed=1)
    for _ in range(TICKS):
        readings = world.exchange(still[0].tolist())
    QuietTicks(len(readings)).run(readings, busy=[])
    world.close()
    chain = true_chain(robot)
    torque_regressor(chain, still, still, still)
    inverse_dynamics(chain, np.ones(10 * len(robot.modules)), still, still, still)


def _interpreted(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function to which the fields of a structured row are attributes, as they are to Numba."""

    def call(*arguments: Any) -> Any:
        structured = (isinstance(a, np.ndarray) and a.dtype.names is not None for a in arguments)
        return function(
            *(a.view(np.recarray) if s else a for a, s in zip(arguments, structured, strict=True))
        )

    return call


if __name__ == "__main__":
    compile_group(GROUPS[sys.argv[1]])

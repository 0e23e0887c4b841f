"""What `x5-sim compile` compiles is what runs need."""

import gc
import re
from pathlib import Path
from typing import Any

from numba.core.dispatcher import Dispatcher

import sim
from module_agent.firmware import run_kernel, tick_kernel
from module_agent.hardware import bus_client, packet_kernel
from sim.commands.compile import GROUPS, call_kernels
from sim.robot.robot_file import load_robot
from sim.world import world_kernel
from sim.world.external_force import Push
from sim.world.world import World
from sim.world.world_kernel import PARTS


def signatures() -> dict[str, list[Any]]:
    """Return the compiled signatures of every kernel of the package."""
    kernels = [o for o in gc.get_objects() if isinstance(o, Dispatcher)]
    return {
        f"{k.py_func.__module__}.{k.py_func.__name__}": list(k.signatures)
        for k in kernels
        if k.py_func.__module__.partition(".")[0] in ("module_agent", "coordinator", "sim")
    }


def test_every_module_with_kernels_is_compiled() -> None:
    root = Path(sim.__file__ or "").parents[1]
    with_kernels = {
        ".".join(path.relative_to(root).with_suffix("").parts)
        for package in ("module_agent", "coordinator", "sim")
        for path in (root / package).rglob("*.py")
        if re.search(r"^@compiled(_with\(.*\))?$", path.read_text(), re.MULTILINE)
    }
    assert {module for group in GROUPS.values() for module in group} == with_kernels


def test_a_run_needs_no_other_signatures() -> None:
    for group in GROUPS:
        call_kernels(group)
    before = signatures()
    compiled = {name.rpartition(".")[0] for name, types in before.items() if types}
    # Machine code that is kept has that of the parts in it, which are not loaded then.
    on_bus = run_kernel, bus_client, packet_kernel
    parts = {part.__name__ for part in (*PARTS, world_kernel, tick_kernel, *on_bus)}
    assert compiled | parts == {module for group in GROUPS.values() for module in group}
    robot = load_robot("arm6")
    push = Push(serial=robot.modules[-1].serial, force_n=(0.0, 0.0, -1.0), for_s=1.0)
    world = World(robot, seed=2, pushes=(push,))
    for _ in range(20):
        world.step([0.1] * len(robot.modules))
    world.close()
    assert signatures() == before

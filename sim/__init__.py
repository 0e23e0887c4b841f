"""The simulated world in place of hardware: physics, sensors, network, launcher, experiments.

As a library: `from sim import simulate, load_robot`. The names are imported when they are used, so that
`import sim` alone loads neither physics nor numerics.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim.robot.robot_file import load_robot
    from sim.virtual_time.simulation import Simulation, simulate

_HOMES = {
    "load_robot": "sim.robot.robot_file",
    "Simulation": "sim.virtual_time.simulation",
    "simulate": "sim.virtual_time.simulation",
}

__all__ = ["Simulation", "load_robot", "simulate"]


def __getattr__(name: str) -> object:
    """Import a name of the library face at its first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'sim' has no attribute {name!r}; its library has {', '.join(__all__)}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])

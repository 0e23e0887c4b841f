"""The motors' temperatures: winding, housing and body as one chain of heat capacities to the ambient air."""

from collections.abc import Sequence

import numpy as np

from module_agent.catalogue import ModuleType
from sim.pose import Array, read_only

AMBIENT_C = 25.0
CAPACITIES_J_K = (0.367, 16.6, 1250.0)
RESISTANCES_K_W = (4.626, 1.0, 8.0)


def heat_flow(dt_s: float) -> Array:
    """Return the matrix (3, 3) that takes temperatures above the ambient through one explicit Euler step."""
    a, b, c = 1.0 / np.array(RESISTANCES_K_W)
    flow = np.array([[-a, a, 0.0], [a, -a - b, b], [0.0, b, -b - c]])
    return read_only(np.eye(3) + dt_s * flow / np.array(CAPACITIES_J_K)[:, None])


class Windings:
    """The temperatures of n modules above the ambient, rows winding, housing, body: (3, n) [K]."""

    def __init__(self, types: Sequence[ModuleType], dt_s: float):
        self.above_k = np.zeros((3, len(types)))
        self._flow = heat_flow(dt_s)
        self._kelvin_per_a2 = dt_s * np.array([t.motor.resistance_ohm for t in types]) / CAPACITIES_J_K[0]

    def step(self, current_a: Array) -> None:
        """Heat the windings with their currents (n,) for one step."""
        self.above_k = self._flow @ self.above_k
        self.above_k[0] += self._kelvin_per_a2 * current_a * current_a

    @property
    def winding_c(self) -> Array:
        """The windings' temperatures, (n,) [deg C]."""
        celsius: Array = self.above_k[0] + AMBIENT_C
        return celsius

"""The motors' temperatures: winding, housing and body as one chain of heat capacities to the ambient air."""

from typing import NamedTuple

import numpy as np

from module_agent.model.catalogue import AMBIENT_C, CAPACITIES_J_K, COPPER_PER_K, RESISTANCES_K_W
from module_agent.model.compiled import compiled
from module_agent.model.read_only import read_only
from sim.geometry.pose import Array


def heat_flow(dt_s: float) -> Array:
    """Return the matrix (3, 3) that takes temperatures above the ambient through one explicit Euler step."""
    a, b, c = 1.0 / np.array(RESISTANCES_K_W)
    flow = np.array([[-a, a, 0.0], [a, -a - b, b], [0.0, b, -b - c]])
    return read_only(np.eye(3) + dt_s * flow / np.array(CAPACITIES_J_K)[:, None])


class Heat(NamedTuple):
    """Temperatures above the ambient, rows winding, housing, body, (3, n) [K], and what changes them.

    flow (3, 3): the temperatures after a step from those before it. kelvin_per_w: of a winding in a step.
    """

    above_k: Array
    flow: Array
    kelvin_per_w: float
    ambient_c: float
    copper_per_k: float


@compiled
def warm(heat: Heat, heat_w: Array) -> None:
    """Advance the temperatures by one step in which the windings get heat (n,)."""
    above_k, flow = heat.above_k, heat.flow
    for i in range(above_k.shape[1]):
        winding, housing, body = above_k[0, i], above_k[1, i], above_k[2, i]
        for r in range(3):
            above_k[r, i] = flow[r, 0] * winding + flow[r, 1] * housing + flow[r, 2] * body
        above_k[0, i] += heat.kelvin_per_w * heat_w[i]


class Windings:
    """The temperatures of n modules above the ambient, rows winding, housing, body: (3, n) [K].

    `heat` multiplies the losses: with 0 they stay at the ambient temperature.
    """

    def __init__(self, n: int, dt_s: float, heat: float = 1.0):
        self.above_k = np.zeros((3, n))
        self.arrays = Heat(
            self.above_k, np.array(heat_flow(dt_s)), heat * dt_s / CAPACITIES_J_K[0], AMBIENT_C, COPPER_PER_K
        )

    def step(self, heat_w: Array) -> None:
        """Heat the windings with their losses (n,) for one step."""
        warm(self.arrays, heat_w)

    @property
    def winding_c(self) -> Array:
        """The windings' temperatures, (n,) [deg C]."""
        celsius: Array = self.above_k[0] + AMBIENT_C
        return celsius

    @property
    def resistance_factor(self) -> Array:
        """The windings' resistances over those at the ambient temperature, (n,)."""
        factor: Array = 1.0 + COPPER_PER_K * self.above_k[0]
        return factor

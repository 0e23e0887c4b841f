"""How warm a motor's winding gets from the current that it is going to carry.

Winding, housing and body are three heat capacities in a row; in the seconds of a motion the winding follows
its losses, the housing warms a little, and the body does not. Constants are the manufacturer's.
"""

import numpy as np

from module_agent.dynamics.chain import Array

AMBIENT_C = 25.0
WINDING_J_K, HOUSING_J_K = 0.367, 16.6
WINDING_K_W, HOUSING_K_W = 4.626, 1.0
# Copper's resistance grows by this share for every kelvin above the ambient, at which it is catalogued.
COPPER_PER_K = 0.00393


def winding_c(cold_w: Array, step_s: float, start_c: float) -> Array:
    """Return the winding's temperature (m,) [deg C] from `start_c` on.

    Args:
        cold_w: (m,) the losses i^2 R that the current makes in a winding at the ambient temperature [W].
        step_s: between them; much less than the winding's 1.7 s.
        start_c: as measured. The housing is as warm as the first losses leave it to be.
    """
    found = np.empty(len(cold_w))
    winding = start_c
    warm_w = float(cold_w[0]) * _growth(winding)
    body = housing = max(AMBIENT_C, winding - WINDING_K_W * warm_w)
    for k, watt in enumerate(cold_w.tolist()):
        found[k] = winding
        into_housing_w = (winding - housing) / WINDING_K_W
        winding += step_s * (watt * _growth(winding) - into_housing_w) / WINDING_J_K
        housing += step_s * (into_housing_w - (housing - body) / HOUSING_K_W) / HOUSING_J_K
    return found


def resistance_factor(temperature_c: Array) -> Array:
    """Return a winding's resistance over that at the ambient temperature, (m,)."""
    found: Array = 1.0 + COPPER_PER_K * (temperature_c - AMBIENT_C)
    return found


def _growth(temperature_c: float) -> float:
    return 1.0 + COPPER_PER_K * (temperature_c - AMBIENT_C)

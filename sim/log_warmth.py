"""How warm a logged module was inside when its log began."""

import numpy as np

from sim.physics.thermal import AMBIENT_C, heat_flow
from sim.pose import Array, read_only
from sim.real_log import RealLog

_STEP_S = 0.01


def start_warmth(log: RealLog) -> Array:
    """Return winding, housing and body above the ambient at the log's beginning, (3,) [K], read-only.

    The winding's temperature is recorded. Housing and body are not: they are those from which the module's
    heat capacities cool the winding as recorded, by least squares. The motor's own heat during the log is
    left out: of a module that is warm from work before and idles, it is a few tenths of a kelvin.
    """
    steps = np.rint((log.t_s - log.t_s[0]) / _STEP_S).astype(np.int64)
    flow = heat_flow(_STEP_S)
    power, rows = np.eye(3), np.empty((steps[-1] + 1, 3))
    for step in range(len(rows)):
        rows[step] = power[0]
        power = power @ flow
    shares = rows[steps]
    above = log.winding_temperature_c - AMBIENT_C
    rest, *_ = np.linalg.lstsq(shares[:, 1:], above - shares[:, 0] * above[0])
    return read_only(np.array([above[0], *rest]))

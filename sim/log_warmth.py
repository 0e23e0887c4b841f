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
    # The winding's row of flow^steps, by eigenvalues: heat flows between neighbours only, so they are real.
    decays, modes = np.linalg.eig(heat_flow(_STEP_S))
    shares = (modes[0] * decays ** steps[:, None]) @ np.linalg.inv(modes)
    above = log.winding_temperature_c - AMBIENT_C
    rest, *_ = np.linalg.lstsq(shares[:, 1:], above - shares[:, 0] * above[0])
    return read_only(np.array([above[0], *rest]))

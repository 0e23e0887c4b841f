"""What modules read in place of what their sensors give: added, held, and taken from another module's sensor.

One alteration holds for a span of ticks; only a drift of a clock changes within it.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.hardware.hardware import SensorSample
from module_agent.model.compiled import compiled
from sim.geometry.pose import Array
from sim.sensors.sensors import Integers

# Of a sample: its times come first, then what sensors read.
TIMES = 2
COLUMNS = len(SensorSample._fields)


class Alteration(NamedTuple):
    """What is altered in the readings of n modules; all but times as floats, columns as in `Readings`.

    source (n, COLUMNS): whose reading it is. keeps (n, COLUMNS): whether the reading counts, or is lost.
    added (n, COLUMNS): what is added to it, or stands in its place. added_ns (n, TIMES): the same of times.
    drifts (d, 3): module, rate, and the world time from which its clock drifts [ns].
    """

    source: NDArray[np.int64]
    keeps: NDArray[np.bool_]
    added: Array
    added_ns: Integers
    drifts: Array


def unaltered(modules: int) -> Alteration:
    """Return an alteration that changes nothing."""
    return Alteration(
        source=np.repeat(np.arange(modules), COLUMNS).reshape(modules, COLUMNS),
        keeps=np.ones((modules, COLUMNS), np.bool_),
        added=np.zeros((modules, COLUMNS)),
        added_ns=np.zeros((modules, TIMES), np.int64),
        drifts=np.zeros((0, 3)),
    )


@compiled
def alter(
    t_ns: int, integers: Integers, floats: Array, alteration: Any, own_integers: Integers, own_floats: Array
) -> None:
    """Write what modules read at a world time [ns], as `Readings`, from what their sensors give then."""
    source, keeps, added, added_ns, drifts = alteration
    for i in range(floats.shape[0]):
        for c in range(TIMES):
            own_integers[i, c] = added_ns[i, c] + (integers[i, c] if keeps[i, c] else 0)
        for c in range(TIMES, COLUMNS):
            if not keeps[i, c]:
                own_floats[i, c] = added[i, c]
            elif added[i, c] != 0.0:
                own_floats[i, c] = floats[source[i, c], c] + added[i, c]
            else:
                own_floats[i, c] = floats[source[i, c], c]
    for k in range(drifts.shape[0]):
        gained_ns = np.int64(np.rint(drifts[k, 1] * (t_ns - drifts[k, 2])))
        for c in range(TIMES):
            own_integers[np.int64(drifts[k, 0]), c] += gained_ns

"""How a module's clock maps to session time, from round trips.

A module answers at a time that lies between sending and receiving; the middle is wrong by at most half the
round trip, so the quickest trips say most. Offset and drift are fitted by least squares with weights that
fall with the excess of a trip over the quickest one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.recording import RoundTrip

Times = NDArray[np.int64]

# Half a tick of waiting inside the module: trips closer than this to the quickest are equally good.
FLOOR_NS = 300_000.0
# Shorter than this, a slope is noise: crystals are within 100 ppm, which is 1 ms in 10 s.
SHORTEST_FIT_NS = 10_000_000_000


class ClockMap(NamedTuple):
    """session = module + offset_ns + drift * (module - origin_ns).

    `uncertainty_ns` is half the quickest trip.
    """

    origin_ns: int
    offset_ns: float
    drift: float
    uncertainty_ns: float

    def to_session(self, module_ns: Times) -> Times:
        """Map module times (n,) to session times (n,), both integer nanoseconds."""
        # The offset can be years of uptime, which a float does not tell to the nanosecond.
        whole, rest = self._split()
        since = module_ns - self.origin_ns
        mapped: Times = module_ns + whole + np.rint(rest + self.drift * since).astype(np.int64)
        return mapped

    def to_module(self, session_ns: Times) -> Times:
        """Undo `to_session`, to 1 ns: session times (n,) to module times (n,), integer nanoseconds."""
        whole, rest = self._split()
        since = (session_ns - whole - self.origin_ns - rest) / (1.0 + self.drift)
        mapped: Times = session_ns - whole - np.rint(rest + self.drift * since).astype(np.int64)
        return mapped

    def _split(self) -> tuple[int, float]:
        whole = round(self.offset_ns)
        return whole, self.offset_ns - whole


def map_clock(trips: Sequence[RoundTrip]) -> ClockMap:
    """Fit a module's clock to its round trips.

    Raises:
        ValueError: no round trip.
    """
    if not trips:
        raise ValueError("no round trip with this module: its clock cannot be mapped")
    sent, received, module = (np.array(column, dtype=np.int64) for column in zip(*trips, strict=True))
    origin = int(module[0])
    base = int(sent[0]) - origin
    trip = (received - sent).astype(np.float64)
    middle = (sent - (module + base)).astype(np.float64) + 0.5 * trip
    weight = 1.0 / (trip - trip.min() + FLOOR_NS)
    since = (module - origin).astype(np.float64)
    if since.max() - since.min() < SHORTEST_FIT_NS:
        offset, drift = float(np.average(middle, weights=weight**2)), 0.0
    else:
        drift, offset = (float(x) for x in np.polyfit(since, middle, 1, w=weight))
    return ClockMap(origin, base + offset, drift, 0.5 * float(trip.min()))

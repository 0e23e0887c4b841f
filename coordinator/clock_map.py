"""How the modules' clocks map to session time and to each other, from round trips.

A module answers at a time that lies between sending and receiving; the middle is wrong by at most half the
round trip, so the quickest trips say most. Offset and drift are fitted by least squares with weights that
fall with the excess of a trip over the quickest one.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.recording import RoundTrip

Times = NDArray[np.int64]

# Half a tick of waiting inside the module: trips closer than this to the quickest are equally good.
FLOOR_NS = 300_000.0
# Shorter than this, a slope is noise: crystals are within 100 ppm, which is 1 ms in 10 s.
SHORTEST_FIT_NS = 10_000_000_000
# Questions to two modules that were asked within this are compared with each other.
SAME_MOMENT_NS = 5_000_000
FEWEST_PAIRS = 5


_Columns = tuple[Times, Times, Times]


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
    return _map(_columns(trips))


def _map(trips: _Columns) -> ClockMap:
    sent, received, module = trips
    origin = int(module[0])
    base = int(sent[0]) - origin
    trip = (received - sent).astype(np.float64)
    middle = (sent - (module + base)).astype(np.float64) + 0.5 * trip
    offset, drift = _fit(module - origin, middle, 1.0 / (trip - trip.min() + FLOOR_NS))
    return ClockMap(origin, base + offset, drift, 0.5 * float(trip.min()))


def map_clocks(trips: Mapping[str, Sequence[RoundTrip]]) -> dict[str, ClockMap]:
    """Map all modules to one time base that runs as their own clocks do: that of the first module.

    The base is that clock, shifted to session time once. The session's own clock would not do: a simulated
    world that falls behind its machine stretches it, and lengths would come out wrong by the square of the
    stretch. Two modules that were asked at the same moment tell their clocks apart, whatever that moment was.

    Raises:
        ValueError: a module has no round trip.
    """
    columns = {name: _columns(trips[name]) for name in sorted(trips)}
    reference, *others = columns
    whole = _map(columns[reference])
    base = ClockMap(whole.origin_ns, whole.offset_ns, 0.0, whole.uncertainty_ns)
    return {reference: base, **{name: _beside(base, columns[reference], columns[name]) for name in others}}


def _beside(base: ClockMap, reference: _Columns, trips: _Columns) -> ClockMap:
    """Return the map of a module whose trips went out beside those of the reference, whose map is `base`."""
    sent_r, received_r, module_r = reference
    sent, received, module = trips
    order = np.argsort(sent_r, kind="stable")
    at = np.clip(np.searchsorted(sent_r[order], sent), 1, len(order) - 1) if len(order) > 1 else None
    if at is None:
        return _map(trips)
    before, after = order[at - 1], order[at]
    near = np.where(np.abs(sent_r[after] - sent) < np.abs(sent_r[before] - sent), after, before)
    same = np.abs(sent_r[near] - sent) <= SAME_MOMENT_NS
    if np.count_nonzero(same) < FEWEST_PAIRS:
        return _map(trips)
    near, sent, received, module = near[same], sent[same], received[same], module[same]
    apart = 0.5 * ((sent - sent_r[near]) + (received - received_r[near])).astype(np.float64)
    origin = int(module[0])
    shift = int(module_r[near[0]]) - origin
    offset = (module_r[near] - (module + shift)).astype(np.float64) + apart
    trip = (received - sent + received_r[near] - sent_r[near]).astype(np.float64)
    constant, drift = _fit(module - origin, offset, 1.0 / (trip - trip.min() + FLOOR_NS))
    return ClockMap(origin, base.offset_ns + shift + constant, drift, 0.5 * float(trip.min()))


def _columns(trips: Sequence[RoundTrip]) -> _Columns:
    if not trips:
        raise ValueError("no round trip with this module: its clock cannot be mapped")
    sent, received, module = (np.array(column, dtype=np.int64) for column in zip(*trips, strict=True))
    return sent, received, module


def _fit(since: Times, offset: NDArray[np.float64], weight: NDArray[np.float64]) -> tuple[float, float]:
    """Return offset and drift of a line, drift zero over a time too short for one."""
    x = since.astype(np.float64)
    if x.max() - x.min() < SHORTEST_FIT_NS:
        return float(np.average(offset, weights=weight**2)), 0.0
    drift, constant = (float(value) for value in np.polyfit(x, offset, 1, w=weight))
    return constant, drift

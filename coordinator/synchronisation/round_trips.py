"""How the modules' clocks map to session time and to each other, from round trips.

A module answers at a time that lies between sending and receiving; the middle is wrong by at most half the
round trip, so the quickest trips say most. Offset and drift are fitted by least squares with weights that
fall with the excess of a trip over the quickest one: the tail of slow trips has no say, however heavy.
What no number of trips tells is how the quickest one divides into there and back.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.recording.recording import RoundTrip
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap, Times

# Half a tick of waiting inside the module: trips closer than this to the quickest are equally good.
FLOOR_NS = 300_000.0
# Shorter than this, a slope is noise: crystals are within 100 ppm, which is 1 ms in 10 s.
SHORTEST_FIT_NS = 10_000_000_000
# Questions to two modules that were asked within this are compared with each other.
SAME_MOMENT_NS = 5_000_000
FEWEST_PAIRS = 5
# What holds up one trip holds up its neighbours: their errors count as one within this.
TOGETHER_NS = 500_000_000
# A crystal's rate where no slope is fitted; and what temperature does to it within a session.
CRYSTAL_DRIFT, MIN_DRIFT_SIGMA = 1e-4, 1e-7


_Columns = tuple[Times, Times, Times]


def map_clock(trips: Sequence[RoundTrip]) -> ClockMap:
    """Fit a module's clock to its round trips.

    Raises:
        DataError: no round trip.
    """
    return _map(_columns(trips))


def _map(trips: _Columns) -> ClockMap:
    sent, received, module = trips
    origin = int(module[0])
    base = int(sent[0]) - origin
    trip = (received - sent).astype(np.float64)
    middle = (sent - (module + base)).astype(np.float64) + 0.5 * trip
    return _fitted(origin, base, _fit(module - origin, middle, trip), trip)


def map_clocks(trips: Mapping[str, Sequence[RoundTrip]]) -> dict[str, ClockMap]:
    """Map all modules to one time base that runs as their own clocks do: that of the first module.

    The base is that clock, shifted to session time once. The session's own clock would not do: a simulated
    world that falls behind its machine stretches it, and lengths would come out wrong by the square of the
    stretch. Two modules that were asked at the same moment tell their clocks apart, whatever that moment was.

    Raises:
        DataError: a module has no round trip.
    """
    columns = {name: _columns(trips[name]) for name in sorted(trips)}
    reference, *others = columns
    whole = _map(columns[reference])
    base = whole._replace(drift=0.0, drift_sigma=0.0)
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
    both = (received - sent + received_r[near] - sent_r[near]).astype(np.float64)
    line = _fit(module - origin, offset, both)
    found = _fitted(origin, shift, line, (received - sent).astype(np.float64))
    return found._replace(offset_ns=base.offset_ns + found.offset_ns)


def _columns(trips: Sequence[RoundTrip]) -> _Columns:
    if not trips:
        raise DataError("no round trip with this module: its clock cannot be mapped")
    sent, received, module = (np.array(column, dtype=np.int64) for column in zip(*trips, strict=True))
    return sent, received, module


class _Line(NamedTuple):
    """offset = constant + slope * (since - centre), with standard deviations."""

    centre_ns: int
    constant_ns: float
    slope: float
    constant_sigma_ns: float
    slope_sigma: float


def _fitted(origin_ns: int, base_ns: int, line: _Line, trip_ns: NDArray[np.float64]) -> ClockMap:
    # There may take any share of the quickest trip: uniform, so that half of it is root three sigmas.
    divided = 0.5 * float(trip_ns.min()) / np.sqrt(3.0)
    sigma = float(np.hypot(divided, line.constant_sigma_ns))
    drift_sigma = max(line.slope_sigma, MIN_DRIFT_SIGMA)
    return ClockMap(origin_ns + line.centre_ns, base_ns + line.constant_ns, line.slope, sigma, drift_sigma)


def _fit(since: Times, offset: NDArray[np.float64], trip: NDArray[np.float64]) -> _Line:
    """Fit a line, of slope zero over a time too short for one.

    Sigmas are those of weighted least squares whose errors differ in size and come together (White, 1980;
    Liang and Zeger, 1986): from the scatter of what the trips of one moment add to the estimate.
    """
    weight = (trip - trip.min() + FLOOR_NS) ** -2.0
    weight = weight / weight.sum()
    centre = round(float(weight @ since))
    x = (since - centre).astype(np.float64)
    constant = float(weight @ offset)
    moments = np.unique(since // TOGETHER_NS, return_inverse=True)[1]
    if x.max() - x.min() < SHORTEST_FIT_NS:
        scatter = np.bincount(moments, weight * (offset - constant))
        return _Line(centre, constant, 0.0, float(np.linalg.norm(scatter)), CRYSTAL_DRIFT)
    lever = weight * x / float(weight @ x**2)
    slope = float(lever @ (offset - constant))
    rest = offset - constant - slope * x
    sigmas = (float(np.linalg.norm(np.bincount(moments, share * rest))) for share in (weight, lever))
    return _Line(centre, constant, slope, *sigmas)

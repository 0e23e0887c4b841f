"""Maps of the modules' clocks to session time and to each other, from round trips.

A module answers at a time between sending and receiving; the middle is off by at most half the round trip, so
that short trips are the most informative. Offset and drift are fitted by least squares with weights that fall
with the excess of a trip over the shortest one: a heavy tail of slow trips has no influence. The asymmetry of
the shortest trip is not observable from round trips.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from coordinator.recording.recording import Recording, RoundTrip
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap, Times

# Half a tick of waiting inside the module: trips this close to the shortest have the same weight.
FLOOR_NS = 300_000.0
# Over a shorter time a slope is noise: crystals are within 100 ppm, which is 1 ms in 10 s.
MIN_FIT_NS = 10_000_000_000
# Requests to two modules within this time are compared with each other.
SAME_MOMENT_NS = 5_000_000
MIN_PAIRS = 5
# A delay affects successive trips: errors within this time count as one.
CORRELATED_NS = 500_000_000
# Sigma of a crystal's rate if no slope is fitted; least sigma, by its change with temperature in a session.
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
    return _fit(origin, base, module - origin, middle, trip, trip)


def map_clocks(trips: Mapping[str, Sequence[RoundTrip]]) -> dict[str, ClockMap]:
    """Map all modules to one time base: the first module's clock, shifted to session time by a constant.

    The session's own clock is not suitable: a simulated world that falls behind its machine stretches it, and
    lengths would be wrong by the square of the stretch. Requests to two modules at the same moment determine
    the difference of their clocks independently of the session's clock.

    Raises:
        DataError: a module has no round trip.
    """
    columns = {name: _columns(trips[name]) for name in sorted(trips)}
    reference, *others = columns
    whole = _map(columns[reference])
    base = whole._replace(drift=0.0, drift_sigma=0.0)
    return {reference: base} | {
        name: _relative_map(base, columns[reference], columns[name]) for name in others
    }


class BootClocks:
    """The clock maps of a finished recording: at every place of it those of the modules' boots there.

    A module that boots anew has another clock: its rows before and after do not follow one map.
    """

    def __init__(self, whole: Recording, serials: Sequence[str]):
        self._whole, self._serials = whole, tuple(serials)
        self._known: dict[tuple[int, ...], dict[str, ClockMap] | None] = {}

    def of(self, so_far: Recording) -> dict[str, ClockMap] | None:
        """Return the maps by serial; None where a module is unheard of yet, or its boot has no round trip."""
        if any(serial not in so_far.modules for serial in self._serials):
            return None
        boots = tuple(so_far.modules[serial].boot for serial in self._serials)
        if boots not in self._known:
            records = [self._whole.past.get(key) for key in zip(self._serials, boots, strict=True)]
            trips = {record.serial: record.round_trips for record in records if record is not None}
            whole = len(trips) == len(self._serials) and all(trips.values())
            self._known[boots] = map_clocks(trips) if whole else None
        return self._known[boots]


def simultaneous(reference_ns: Times, sent_ns: Times) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return which requests to the reference are nearest to those at (n,) times, and whether at once."""
    order = np.argsort(reference_ns, kind="stable")
    at = np.searchsorted(reference_ns[order], sent_ns)
    before, after = order[np.maximum(at - 1, 0)], order[np.minimum(at, len(order) - 1)]
    is_before = np.abs(reference_ns[after] - sent_ns) >= np.abs(reference_ns[before] - sent_ns)
    near = np.where(is_before, before, after)
    return near, np.abs(reference_ns[near] - sent_ns) <= SAME_MOMENT_NS


def _relative_map(base: ClockMap, reference: _Columns, trips: _Columns) -> ClockMap:
    """Return the map of a module from trips simultaneous with those of the reference, whose map is `base`."""
    sent_r, received_r, module_r = reference
    sent, received, module = trips
    near, same = simultaneous(sent_r, sent)
    if np.count_nonzero(same) < MIN_PAIRS:
        return _map(trips)
    near, sent, received, module = near[same], sent[same], received[same], module[same]
    apart = 0.5 * ((sent - sent_r[near]) + (received - received_r[near])).astype(np.float64)
    origin = int(module[0])
    shift = int(module_r[near[0]]) - origin
    offset = (module_r[near] - (module + shift)).astype(np.float64) + apart
    both = (received - sent + received_r[near] - sent_r[near]).astype(np.float64)
    fitted = _fit(origin, shift, module - origin, offset, both, (received - sent).astype(np.float64))
    return fitted._replace(offset_ns=base.offset_ns + fitted.offset_ns)


def _columns(trips: Sequence[RoundTrip]) -> _Columns:
    if not trips:
        raise DataError("no round trip with this module: its clock cannot be mapped")
    sent, received, module = (np.array(column, dtype=np.int64) for column in zip(*trips, strict=True))
    return sent, received, module


def _fit(
    origin_ns: int,
    base_ns: int,
    since_ns: Times,
    offset_ns: NDArray[np.float64],
    weighing_ns: NDArray[np.float64],
    trip_ns: NDArray[np.float64],
) -> ClockMap:
    """Fit a line to offsets beyond `base_ns`, of slope zero if the time is too short for one.

    `weighing_ns` are the durations that weigh the offsets. Sigmas are those of weighted least squares with
    heteroscedastic, clustered errors (White, 1980; Liang and Zeger, 1986), clustered by `CORRELATED_NS`.
    """
    weight = (weighing_ns - weighing_ns.min() + FLOOR_NS) ** -2.0
    weight = weight / weight.sum()
    centre = round(float(weight @ since_ns))
    x = (since_ns - centre).astype(np.float64)
    constant = float(weight @ offset_ns)
    moments = np.unique(since_ns // CORRELATED_NS, return_inverse=True)[1]
    rest = offset_ns - constant
    slope, drift_sigma = 0.0, CRYSTAL_DRIFT
    if x.max() - x.min() >= MIN_FIT_NS:
        lever = weight * x / float(weight @ x**2)
        slope = float(lever @ rest)
        rest = offset_ns - constant - slope * x
        drift_sigma = max(float(np.linalg.norm(np.bincount(moments, lever * rest))), MIN_DRIFT_SIGMA)
    scatter = float(np.linalg.norm(np.bincount(moments, weight * rest)))
    # The way there may be any share of the shortest trip: uniform, so that half of it is root three sigmas.
    sigma = float(np.hypot(0.5 * float(trip_ns.min()) / np.sqrt(3.0), scatter))
    return ClockMap(origin_ns + centre, base_ns + constant, slope, sigma, drift_sigma)

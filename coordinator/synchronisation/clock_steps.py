"""Steps of a module's clock against those of the session and of other modules, by round trips.

A round trip bounds the session's time of a module's answer from both sides, and so by how much the module's
clock is behind the session's: by sent - module at least, and by received - module at most. The session's
clock is no judge by itself, as a simulated world that falls behind makes all modules late, and one that
catches up makes them early. Two requests at the same moment bound by how much one module is behind the other,
whatever the session's clock does meanwhile.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from coordinator.recording.recording import RoundTrip
from coordinator.synchronisation.round_trips import simultaneous
from module_agent.signals.clock_map import Times

# What two clocks of crystals drift apart, and some more; the least step.
CRYSTAL, LEAP_NS = 3e-4, 10_000_000
# So many trips before and after an instant tell whether a clock stood then, unless they take so long that the
# drift of poor crystals counts. By so many other modules.
STEP_TRIPS, LONGEST_NS, WITNESSES = 10, 20_000_000_000, 3


def leapt(trips: Sequence[RoundTrip], others: Sequence[Sequence[RoundTrip]], module_ns: int) -> bool:
    """Return whether a module's clock, and not those of all others, is early after one of its instants.

    Args:
        trips: of the module. others: those of every other one.
        module_ns: the instant, in the module's time.
    """
    before = [trip.received_ns for trip in trips if trip.module_ns <= module_ns]
    if not before:
        return False
    early = [_early_after(other, max(before)) for other in others]
    return _early_after(trips, max(before)) and not (early and all(early))


def _early_after(trips: Sequence[RoundTrip], session_ns: int) -> bool:
    """Return whether a module's clock is ahead of the session's after an instant, compared with before."""
    before = [trip.sent_ns - trip.module_ns for trip in trips if trip.received_ns <= session_ns]
    after = [trip.received_ns - trip.module_ns for trip in trips if trip.sent_ns >= session_ns]
    if not before or not after:
        return False
    drift_ns = CRYSTAL * (trips[-1].received_ns - trips[0].sent_ns)
    return min(after) < max(before) - LEAP_NS - drift_ns


def clocks_that_stood(trips: Mapping[str, Sequence[RoundTrip]]) -> dict[str, float]:
    """Return for how long clocks stood, or by how much they went back, at the least [ns]; by serial.

    A clock stood if its module is behind most of the witnesses from one instant on, and behind the session:
    one that is behind a witness only is behind one that leapt. Witnesses are the modules that are most often
    asked at the same moment; of a module that is asked by itself nothing is known.
    """
    columns = {serial: _Trips.of(some) for serial, some in trips.items() if some}
    found = {}
    for serial, own in columns.items():
        pairs = [_paired(own, other) for name, other in columns.items() if name != serial]
        pairs = [pair for pair in pairs if len(pair[0].sent_ns) >= 2 * STEP_TRIPS]
        pairs.sort(key=lambda pair: len(pair[0].sent_ns), reverse=True)
        behind = [_step_behind(*pair) for pair in pairs[:WITNESSES]]
        stood = [ns for ns in behind if ns > 0.0]
        if 2 * len(stood) > len(behind):
            found[serial] = float(np.median(stood))
    return found


class _Trips(NamedTuple):
    """Trips (n,) as columns, in the order of sending."""

    sent_ns: Times
    received_ns: Times
    module_ns: Times

    @classmethod
    def of(cls, trips: Sequence[RoundTrip]) -> Self:
        return cls(*np.array(sorted(trips), dtype=np.int64).T)

    def at(self, which: NDArray[np.intp]) -> "_Trips":
        return _Trips(*(column[which] for column in self))


def _paired(own: _Trips, witness: _Trips) -> tuple[_Trips, _Trips]:
    """Return the trips to a module, and those to another one at the same moments."""
    near, same = simultaneous(witness.sent_ns, own.sent_ns)
    return own.at(np.flatnonzero(same)), witness.at(near[same])


def _step_behind(own: _Trips, witness: _Trips) -> float:
    """Return by how much a module falls behind another one, and the session, at once and for good [ns].

    Zero if it does not. Medians of successive trips leave out single answers that were stale.
    """
    ahead = witness.module_ns - own.module_ns
    least = _medians(ahead - (witness.received_ns - own.sent_ns))
    most = _medians(ahead - (witness.sent_ns - own.received_ns))
    windows = sliding_window_view(own.received_ns, 2 * STEP_TRIPS)
    span_ns = windows[:, -1] - windows[:, 0]
    steps = least[STEP_TRIPS:] - most[:-STEP_TRIPS] - CRYSTAL * span_ns
    steps[span_ns > LONGEST_NS] = -np.inf
    at = int(steps.argmax())
    step = float(steps[at])
    if step <= LEAP_NS:
        return 0.0
    drifted = CRYSTAL * (own.received_ns[at + 2 * STEP_TRIPS - 1 :] - own.received_ns[at])
    lasts = float((least[at + STEP_TRIPS :] + drifted).min()) > float(most[at]) + 0.5 * step
    session = own.sent_ns - own.module_ns, own.received_ns - own.module_ns
    late = _medians(session[0])[STEP_TRIPS:] - _medians(session[1])[:-STEP_TRIPS]
    # A world that is slow all the time makes every module late.
    unusual = float(late[at]) - max(float(np.median(late)), 0.0)
    return step if lasts and unusual > max(0.5 * step, LEAP_NS) else 0.0


def _medians(bound_ns: Times) -> NDArray[np.float64]:
    """Return the medians of all stretches of `STEP_TRIPS` successive bounds."""
    return np.asarray(np.median(sliding_window_view(bound_ns.astype(np.float64), STEP_TRIPS), axis=1))

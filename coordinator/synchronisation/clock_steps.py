"""Steps of a module's clock against those of the session and of other modules, by round trips.

A round trip bounds the session's time of a module's answer from both sides, and so by how much the module's
clock is behind the session's: by sent - module at least, and by received - module at most. The session's
clock is no judge by itself, as a simulated world that falls behind makes all modules late, and one that
catches up makes them early. Two requests at the same moment bound by how much one module is behind the other,
whatever the session's clock does meanwhile.
"""

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from coordinator.recording.recording import RoundTrip
from coordinator.synchronisation.round_trips import simultaneous
from module_agent.signals.clock_map import Times

# What two clocks of crystals drift apart, and some more; the least step.
CRYSTAL, LEAP_NS = 3e-4, 10_000_000
# So many trips before and after an instant tell whether a clock stood then: half a second of each, or more.
STEP_TRIPS = 10

_Bound = NDArray[np.float64]


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


def stood_ns(trips: Sequence[RoundTrip], witnesses: Sequence[Sequence[RoundTrip]]) -> float | None:
    """Return for how long a module's clock stood [ns], or went back by; None if it did not.

    It did if it is behind most of the witnesses from one instant on, and behind the session: one that is
    behind a witness only is a witness that leapt.

    Args:
        trips: of the module.
        witnesses: those of other modules, to which requests were sent along with its own.
    """
    behind = [ns for ns in (_step_behind(trips, other) for other in witnesses if other) if ns is not None]
    stood = [ns for ns in behind if ns > 0.0]
    return float(np.median(stood)) if 2 * len(stood) > len(behind) else None


def _step_behind(trips: Sequence[RoundTrip], witness: Sequence[RoundTrip]) -> float | None:
    """Return by how much a module falls behind another one, and the session, at once and for good [ns].

    Zero if it does not; None if too few requests to the two were simultaneous. Medians of successive trips
    leave out single answers that were stale.
    """
    if not trips:
        return None
    sent, received, module = _columns(trips)
    sent_w, received_w, module_w = _columns(witness)
    near, same = simultaneous(sent_w, sent)
    if np.count_nonzero(same) < 2 * STEP_TRIPS:
        return None
    sent, received, module, near = sent[same], received[same], module[same], near[same]
    ahead = module_w[near] - module
    least, most = _medians(ahead - (received_w[near] - sent)), _medians(ahead - (sent_w[near] - received))
    span = received[2 * STEP_TRIPS - 1 :] - received[: len(received) - 2 * STEP_TRIPS + 1]
    steps = least[STEP_TRIPS:] - most[:-STEP_TRIPS] - CRYSTAL * span
    at = int(steps.argmax())
    step = float(steps[at])
    lasts = float(least[at + STEP_TRIPS :].min()) > float(most[at]) + 0.5 * step
    late = float(_medians(sent - module)[at + STEP_TRIPS] - _medians(received - module)[at])
    return step if step > LEAP_NS and lasts and late > max(0.5 * step, LEAP_NS) else 0.0


def _medians(bound_ns: Times) -> _Bound:
    """Return the medians of all stretches of `STEP_TRIPS` successive bounds."""
    return np.asarray(np.median(sliding_window_view(bound_ns.astype(np.float64), STEP_TRIPS), axis=1))


def _columns(trips: Sequence[RoundTrip]) -> tuple[Times, Times, Times]:
    """Return sent, received and module times, in the order of sending."""
    columns = np.array(sorted(trips), dtype=np.int64)
    return columns[:, 0], columns[:, 1], columns[:, 2]

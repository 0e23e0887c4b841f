"""How old feedback is when it reaches the coordinator: from the sample to its arrival, by module.

The age of a message is that of its newest row, so that the wait for a batch to fill is not in it. Modules'
clocks are mapped to session time by round trips; half the shortest trip bounds what that leaves unknown.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.recording.recording import ModuleRecord, Recording
from coordinator.synchronisation.round_trips import map_clock
from module_agent.model.chain import Array


class FeedbackDelay(NamedTuple):
    """Percentiles of the delay from sample to coordinator of one module's messages [ms].

    `clock_sigma_ms` is one standard deviation of the clock's offset, by which all delays are off together.
    """

    serial: str
    messages: int
    p50_ms: float
    p99_ms: float
    max_ms: float
    clock_sigma_ms: float

    def shown(self, delay_ms: float) -> str:
        """Return one of these delays [ms] as text; below the clock's sigma it is not known any better."""
        if delay_ms < self.clock_sigma_ms:
            return f"< {max(0.1, self.clock_sigma_ms):.1f}"
        return f"{delay_ms:.1f}"


def feedback_delay(module: ModuleRecord) -> FeedbackDelay | None:
    """Return the delays of a module's feedback, None without feedback or without a round trip."""
    row_ns, arrival_ns = module.arrivals.columns()
    if not len(row_ns) or not module.trips:
        return None
    clock = map_clock(module.trips)
    return _delay(module, arrival_ns - clock.to_session(row_ns), clock.sigma_ns)


def recent_delay(module: ModuleRecord, since_ns: int) -> FeedbackDelay | None:
    """Return the delays of what arrived since a session time, between the first and the last round trip.

    The clock is interpolated between the middles of successive round trips: one line through all of them
    would be wrong by much more where a simulated world falls behind its machine, and stretches the modules'
    clocks unevenly. Each answer may have come at any moment of its trip. None without feedback or two trips.
    """
    trips = sorted(module.round_trips, key=lambda trip: trip.module_ns)
    row_ns, arrival_ns = module.arrivals.columns()
    if len(trips) < 2:
        return None
    sent_ns, received_ns, module_ns = np.array(trips, np.int64).T
    within = (row_ns >= module_ns[0]) & (row_ns <= module_ns[-1]) & (arrival_ns >= since_ns)
    if not within.any():
        return None
    # Relative times, since a float does not resolve years to the nanosecond.
    zero_ns, begin_ns = module_ns[0], sent_ns[0]
    middle = 0.5 * ((sent_ns - begin_ns) + (received_ns - begin_ns))
    sampled = np.interp((row_ns[within] - zero_ns).astype(float), (module_ns - zero_ns).astype(float), middle)
    sigma_ns = float(np.median(received_ns - sent_ns)) / np.sqrt(12.0)
    return _delay(module, (arrival_ns[within] - begin_ns) - sampled, sigma_ns)


def _delay(module: ModuleRecord, delay_ns: Array | NDArray[np.int64], sigma_ns: float) -> FeedbackDelay:
    p50, p99, largest = (1e-6 * float(p) for p in np.percentile(delay_ns, (50, 99, 100)))
    return FeedbackDelay(module.serial, len(delay_ns), p50, p99, largest, 1e-6 * sigma_ns)


def feedback_delays(recording: Recording) -> Iterator[FeedbackDelay]:
    """Yield the delays of the modules of a recording, by serial, as far as they are known."""
    for _, module in sorted(recording.modules.items()):
        if (delay := feedback_delay(module)) is not None:
            yield delay

"""How old feedback is when it reaches the coordinator: from the sample to its arrival, by module.

The age of a message is that of its newest row, so that the wait for a batch to fill is not in it. Modules'
clocks are mapped to session time by round trips; half the shortest trip bounds what that leaves unknown.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from coordinator.recording.recording import ModuleRecord, Recording
from coordinator.synchronisation.round_trips import map_clock


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


def feedback_delay(module: ModuleRecord) -> FeedbackDelay | None:
    """Return the delays of a module's feedback, None without feedback or without a round trip."""
    row_ns, arrival_ns = module.arrivals.columns()
    if not len(row_ns) or not module.trips:
        return None
    clock = map_clock(module.trips)
    delay_ms = 1e-6 * (arrival_ns - clock.to_session(row_ns))
    p50, p99, largest = (float(p) for p in np.percentile(delay_ms, (50, 99, 100)))
    return FeedbackDelay(module.serial, len(row_ns), p50, p99, largest, 1e-6 * clock.sigma_ns)


def feedback_delays(recording: Recording) -> Iterator[FeedbackDelay]:
    """Yield the delays of the modules of a recording, by serial, as far as they are known."""
    for _, module in sorted(recording.modules.items()):
        if (delay := feedback_delay(module)) is not None:
            yield delay

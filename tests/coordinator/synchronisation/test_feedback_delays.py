"""The delay of feedback is found from messages alone, whatever a module's clock says."""

from types import SimpleNamespace

import numpy as np
import pytest

from coordinator.recording.recording import Recording
from coordinator.synchronisation.feedback_delays import FeedbackDelay, feedback_delays, recent_delay
from module_agent.wire.keys import Leaf

OFFSET_NS, DRIFT = 7_000_000_000, 40e-6


def module_ns(session_ns: float) -> int:
    return round(session_ns * (1.0 + DRIFT)) + OFFSET_NS


def recorded(wire: SimpleNamespace, delays_ms: np.ndarray, trips: int = 200) -> Recording:
    """Return 50 messages a second of A, delayed as given, and round trips that take 0.4 ms each way."""
    recording, span_ns = Recording(), 20_000_000 * len(delays_ms)
    for number, delay_ms in enumerate(delays_ms):
        sent_ns = 20_000_000 * number
        rows = wire.rows(5 * number, 5)
        rows["t_ns"] = module_ns(sent_ns) - 4_000_000 * np.arange(4, -1, -1)
        message = wire.feedback(first=5 * number, rows=rows)
        recording.add(wire.publication(Leaf.FEEDBACK, message, sent_ns + round(1e6 * delay_ms)))
    for seq, sent_ns in enumerate(np.linspace(0, span_ns, trips).astype(int), start=1):
        recording.add(wire.request(Leaf.STATUS, wire.ask(seq=seq), t_ns=int(sent_ns)))
        answer = wire.status(re=seq, t_ns=module_ns(int(sent_ns) + 400_000))
        recording.add(wire.reply(Leaf.STATUS, answer, t_ns=int(sent_ns) + 800_000))
    return recording


def test_delays_are_those_of_the_network_whatever_offset_and_drift_of_the_clock(
    wire: SimpleNamespace,
) -> None:
    delays_ms = np.random.default_rng(1).lognormal(0.0, 1.0, 3000)
    (found,) = feedback_delays(recorded(wire, delays_ms))
    p50, p99, largest = np.percentile(delays_ms, (50, 99, 100))
    # Over this minute the clock drifts by 2.4 ms.
    assert (found.serial, found.messages) == ("A", 3000)
    assert found.p50_ms == pytest.approx(p50, abs=0.01)
    assert found.p99_ms == pytest.approx(p99, abs=0.01)
    assert found.max_ms == pytest.approx(largest, abs=0.01)
    # The way there may be any share of 0.8 ms.
    assert found.clock_sigma_ms == pytest.approx(0.4 / np.sqrt(3.0), rel=0.05)


def test_rows_that_are_asked_for_again_and_copies_of_messages_are_no_late_feedback(
    wire: SimpleNamespace,
) -> None:
    recording = recorded(wire, np.full(50, 1.0))
    late = 10_000_000_000
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(first=100), late))
    recording.add(wire.reply(Leaf.HISTORY, wire.feedback(first=300), late))
    (found,) = feedback_delays(recording)
    # Over a second no drift is fitted: 40 ppm are 0.02 ms at its ends.
    assert (found.messages, found.max_ms) == (50, pytest.approx(1.0, abs=0.03))


def test_without_a_round_trip_no_delay_is_claimed(wire: SimpleNamespace) -> None:
    assert list(feedback_delays(recorded(wire, np.full(50, 1.0), trips=0))) == []


def test_the_latest_delays_are_those_of_the_messages_since_then(wire: SimpleNamespace) -> None:
    # A minute of 1 ms, then ten seconds of 5 ms.
    recording = recorded(wire, np.concatenate([np.full(3000, 1.0), np.full(500, 5.0)]))
    found = recent_delay(recording.modules["A"], 60_000_000_000)
    assert found is not None
    # Its arrival at 60.001 s is of the message before the change, if at all.
    assert found.messages == pytest.approx(500, abs=1)
    assert found.p50_ms == pytest.approx(5.0, abs=0.01)
    assert found.clock_sigma_ms == pytest.approx(0.4 / np.sqrt(3.0), rel=0.05)
    assert recent_delay(recording.modules["A"], 80_000_000_000) is None


@pytest.mark.parametrize(
    ("delay_ms", "shown"), [(-0.21, "< 0.3"), (0.29, "< 0.3"), (0.31, "0.3"), (12.34, "12.3")]
)
def test_no_delay_is_shown_that_the_clock_does_not_tell_from_none(delay_ms: float, shown: str) -> None:
    assert FeedbackDelay("A", 9, delay_ms, delay_ms, delay_ms, 0.3).shown(delay_ms) == shown

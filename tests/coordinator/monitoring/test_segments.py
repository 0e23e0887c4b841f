"""Rows of modules with clocks of their own come onto one grid; holes and silence are named, not filled."""

import numpy as np
import pytest

from coordinator.monitoring.segments import Aligned, Alignment, Block, Segmenter, joined_blocks
from coordinator.recording.recording import Recording
from module_agent.signals.clock_map import ClockMap
from module_agent.wire.feedback_rows import ROW
from module_agent.wire.messages import Feedback

SERIALS = ("A", "B")
CLOCKS = {"A": ClockMap(0, 3e9, 0.0, 0.0), "B": ClockMap(0, -7.25e9, 8e-5, 0.0)}
LATE_NS = {"A": 0, "B": 1_300_000}


def angle(t_ns: np.ndarray, serial: str) -> np.ndarray:
    return np.asarray(np.sin(2.0 * np.pi * 2.0 * 1e-9 * t_ns + SERIALS.index(serial)))


def rows(serial: str, first: int, count: int) -> np.ndarray:
    session = 10_000_000_000 + np.arange(first, first + count) * 4_000_000 + LATE_NS[serial]
    made = np.zeros(count, dtype=ROW)
    made["t_ns"] = made["imu_t_ns"] = CLOCKS[serial].to_module(session)
    made["position_rad"] = angle(session, serial)
    made["motor_current_a"] = SERIALS.index(serial)
    return made


def hear(recording: Recording, serial: str, first: int, count: int) -> None:
    block = rows(serial, first, count)
    feedback = Feedback(serial=serial, boot=1, seq=first, first_row=first, count=count, rows=block.tobytes())
    recording.module(serial, 1).rows.add(feedback)


def run(alignment: Alignment, recording: Recording, feeds: list[tuple[str, int, int]]) -> list[Aligned]:
    found = []
    for serial, first, count in feeds:
        hear(recording, serial, first, count)
        found.append(alignment.advance(recording, CLOCKS))
    return found


def both(begin: int, end: int, step: int = 5) -> list[tuple[str, int, int]]:
    return [(s, k, step) for k in range(begin, end, step) for s in SERIALS]


def blocks(found: list[Aligned]) -> Block:
    return joined_blocks([one.block for one in found if one.block is not None])


def test_the_grid_has_no_gap_and_samples_are_those_of_its_times() -> None:
    found = run(Alignment(SERIALS), Recording(), both(0, 500))
    block = blocks(found)
    assert set(np.diff(block.t_ns)) == {4_000_000}
    assert len(block.t_ns) > 490
    for k, serial in enumerate(SERIALS):
        # A cubic at 250 Hz of 2 Hz: 1e-7; the first sample lies in a corner.
        np.testing.assert_allclose(block.q_rad[2:, k], angle(block.t_ns[2:], serial), atol=1e-6)
        np.testing.assert_allclose(block.current_a[:, k], k, atol=1e-12)


def test_rows_in_any_order_and_twice_are_as_good() -> None:
    feeds = both(0, 300)
    feeds[20], feeds[22] = feeds[22], feeds[20]
    feeds.insert(40, feeds[38])
    block = blocks(run(Alignment(SERIALS), Recording(), feeds))
    assert set(np.diff(block.t_ns)) == {4_000_000}


def test_a_lost_message_is_bridged() -> None:
    feeds = [f for f in both(0, 300) if f != ("B", 100, 5)]
    found = run(Alignment(SERIALS), Recording(), feeds)
    assert not any(one.gaps for one in found)
    block = blocks(found)
    # 24 ms of 2 Hz by a cubic.
    np.testing.assert_allclose(block.q_rad[2:, 1], angle(block.t_ns[2:], "B"), atol=1e-4)


def test_a_hole_is_named_and_the_grid_begins_anew_after_it() -> None:
    feeds = [f for f in both(0, 400) if not (f[0] == "B" and 100 <= f[1] < 130)]
    found = run(Alignment(SERIALS), Recording(), feeds)
    (gap,) = [gap for one in found for gap in one.gaps]
    assert gap.serial == "B"
    # 30 rows are missing: 31 steps of 4 ms.
    assert gap.to_ns - gap.from_ns == pytest.approx(124e6, rel=1e-3)
    after = next(k for k, one in enumerate(found) if one.gaps)
    first = next(one.block for one in found[after:] if one.block is not None)
    assert first.t_ns[0] >= gap.to_ns


def test_a_module_that_vanishes_holds_the_grid_and_is_named() -> None:
    feeds = both(0, 100) + [("A", k, 5) for k in range(100, 400, 5)]
    found = run(Alignment(SERIALS), Recording(), feeds)
    assert found[-1].silent == ("B",)
    assert blocks(found).t_ns[-1] < 10_000_000_000 + 100 * 4_000_000
    assert all(one.block is None for one in found[-20:])


def test_a_module_that_was_never_heard_is_named() -> None:
    found = run(Alignment(SERIALS), Recording(), [("A", k, 5) for k in range(0, 100, 5)])
    assert found[-1] == Aligned(None, (), ("B",))


BEGIN_NS = 10_000_000_000


def part(missing: range, from_ms: float, until_ms: float) -> Aligned:
    """Return what is between two times of two seconds of rows, of which B lacks some."""
    recording = Recording()
    for serial, first, count in both(0, 500):
        if serial == "A" or first not in missing:
            hear(recording, serial, first, count)
    alignment = Alignment(SERIALS, BEGIN_NS + round(1e6 * from_ms))
    return alignment.advance(recording, CLOCKS, BEGIN_NS + round(1e6 * until_ms))


@pytest.mark.parametrize(("from_ms", "first_ms"), [(400.0, 400.0), (400.1, 404.0), (-50.0, 4.0)])
@pytest.mark.parametrize(("until_ms", "last_ms"), [(1200.0, 1196.0), (1200.1, 1200.0)])
def test_a_span_begins_and_ends_where_it_is_asked_to(
    from_ms: float, first_ms: float, until_ms: float, last_ms: float
) -> None:
    block = part(range(0), from_ms, until_ms).block
    assert block is not None
    assert list(block.t_ns[[0, -1]]) == [BEGIN_NS + 1e6 * first_ms, BEGIN_NS + 1e6 * last_ms]
    np.testing.assert_allclose(block.q_rad[2:, 1], angle(block.t_ns[2:], "B"), atol=1e-6)


@pytest.mark.parametrize(
    ("missing", "first_ms", "last_ms"),
    [
        pytest.param(range(60, 150), 604.0, 1196.0, id="over the beginning"),
        pytest.param(range(250, 400), 400.0, 992.0, id="over the end"),
    ],
)
def test_a_hole_over_an_end_of_a_span_shortens_it(missing: range, first_ms: float, last_ms: float) -> None:
    """Nothing is extrapolated into it."""
    found = part(missing, 400.0, 1200.0)
    assert found.block is not None
    assert not found.gaps
    assert list(found.block.t_ns[[0, -1]]) == [BEGIN_NS + 1e6 * first_ms, BEGIN_NS + 1e6 * last_ms]
    assert np.abs(found.block.q_rad).max() < 1.001


def test_a_hole_within_a_span_is_named_and_a_span_of_no_time_is_empty() -> None:
    assert [gap.serial for gap in part(range(150, 200), 400.0, 1200.0).gaps] == ["B"]
    assert part(range(0), 400.0, 400.0) == Aligned(None, (), ())


def test_torques_of_a_segment_change_as_fast_as_they_do() -> None:
    t_ns = np.arange(400) * 4_000_000
    zero, three = np.zeros((400, 1)), np.zeros((400, 1, 3))
    turn = 2.0 * np.pi * 2.0
    tau = np.sin(turn * 1e-9 * t_ns)[:, None]
    (first, *_) = Segmenter().add(Block(t_ns, zero, zero, tau, zero, zero, three, three))
    expected = turn * np.cos(turn * 1e-9 * first.t_ns)
    np.testing.assert_allclose(first.tau_rate_nm_s[:, 0], expected, atol=2e-3 * turn)

"""Gathering rows into batches, and the rest of what happens before anything is logged."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from coordinator.viewer.layout import Palette, axis_shades, nth_colour
from coordinator.viewer.parameter import Estimate, Parameter, fitting, with_estimate
from coordinator.viewer.time_series import LIVE_BATCH_NS, Batch, RowBatcher, StateChanges
from module_agent.wire.feedback_rows import ROW

lengths = st.lists(st.tuples(st.sampled_from(["a", "b", "c"]), st.integers(0, 40)), max_size=60)


def numbered(first: int, count: int) -> np.ndarray:
    rows = np.zeros(count, ROW)
    rows["t_ns"] = np.arange(first, first + count)
    return rows


@given(lengths)
def test_no_row_is_lost_doubled_or_moved_whatever_the_pieces(pieces: list[tuple[str, int]]) -> None:
    batcher, logged, sent = RowBatcher(), dict[str, list[int]](), dict[str, list[int]]()
    for serial, count in pieces:
        first = len(sent.setdefault(serial, []))
        sent[serial] += range(first, first + count)
        t_ns = 4_000_000 * np.arange(first, first + count)
        for batch in batcher.add(Batch(serial, t_ns, numbered(first, count))):
            assert batch.t_ns.tolist() == (4_000_000 * batch.rows["t_ns"]).tolist()
            logged.setdefault(batch.serial, []).extend(batch.rows["t_ns"].tolist())
    for batch in batcher.drain():
        logged.setdefault(batch.serial, []).extend(batch.rows["t_ns"].tolist())
    assert logged == {serial: rows for serial, rows in sent.items() if rows}


def test_a_batch_spans_a_tenth_of_a_second() -> None:
    batcher = RowBatcher()
    for i in range(0, 250, 5):
        for batch in batcher.add(Batch("a", 4_000_000 * np.arange(i, i + 5), numbered(i, 5))):
            assert LIVE_BATCH_NS <= batch.t_ns[-1] - batch.t_ns[0] < LIVE_BATCH_NS + 20_000_000


def test_the_last_rows_of_a_module_that_fell_silent_are_not_held_back() -> None:
    batcher = RowBatcher()
    batcher.add(Batch("silent", np.array([0]), numbered(0, 1)))
    logged = [
        batch.serial
        for i in range(0, 150, 5)
        for batch in batcher.add(Batch("b", 4_000_000 * np.arange(i, i + 5), numbered(i, 5)))
    ]
    assert "silent" in logged


def test_states_change_across_batches_and_an_unknown_state_is_shown_by_number() -> None:
    changes = StateChanges()
    found = []
    for states in ([0, 0, 1], [1, 1], [9, 0]):
        rows = np.zeros(len(states), ROW)
        rows["state"] = states
        found.append(changes.of(Batch("a", np.arange(len(states)), rows))[1])
    assert found == [["idle", "armed"], [], ["state 9", "idle"]]


@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(1e-6, 1.0)), min_size=2, max_size=40))
def test_the_newest_estimate_and_its_band_can_always_be_seen(estimates: list[tuple[float, float]]) -> None:
    seen, previous = None, None
    for value, sigma in estimates:
        seen = fitting(seen, value, sigma, previous)
        assert seen is not None
        low, high = seen
        assert low <= value - sigma < value + sigma <= high
        if previous is not None and abs(value - previous) < sigma:
            # A band below a thirtieth of the plot cannot be told from a line.
            assert 2.0 * sigma > (high - low) / 30.001
        previous = value


def test_a_jump_of_many_sigmas_is_not_zoomed_away() -> None:
    low, high = fitting((0.2, 0.4), 0.3, 1e-5, previous=0.29) or (0.0, 0.0)
    assert low < 0.29 < 0.3 < high


def test_a_converging_estimate_changes_its_plot_seldom() -> None:
    ranges = []
    seen = None
    for k in range(1, 1001):
        seen = fitting(seen, 0.3, 0.1 / k, 0.3)
        ranges.append(seen)
    # From 0.1 down to 0.0001 by zooms of a factor of about two and more.
    assert 1 < len(dict.fromkeys(ranges)) < 12


def test_an_estimate_without_a_sigma_leaves_the_range_to_the_viewer() -> None:
    assert fitting(None, 1.0, float("inf"), None) is None
    parameters = with_estimate((), Estimate("mass", "a", 1.0, float("nan"), "kg"), None)
    assert parameters == (Parameter("mass", "kg", (("a", None),)),)


def test_a_module_keeps_its_colour_and_no_two_of_64_share_one() -> None:
    palette = Palette()
    first = palette.colour("a")
    others = [palette.colour(f"m{k}") for k in range(63)]
    assert palette.colour("a") == first
    assert len(dict.fromkeys([first, *others])) == 64
    assert len(dict.fromkeys(axis_shades(first))) == 3


def test_colours_of_modules_are_neither_the_estimates_orange_nor_the_truths_grey() -> None:
    for k in range(64):
        red, green, blue, _ = nth_colour(k)
        assert max(red, green, blue) - min(red, green, blue) > 40
        assert abs(red - 255) + abs(green - 150) + abs(blue - 40) > 90

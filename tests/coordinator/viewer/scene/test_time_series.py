"""Envelopes, states, colours and axis ranges, which are computed before anything is logged."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.viewer.scene.entity_paths import Palette, axis_shades, nth_colour
from coordinator.viewer.scene.parameter_plot import Estimate, Parameter, fitting, labelled, with_estimate
from coordinator.viewer.scene.time_series import INTERVAL_NS, Batch, StateChanges, envelope
from module_agent.wire.feedback_rows import ROW


def test_states_change_across_batches_and_an_unknown_state_is_shown_by_number() -> None:
    changes = StateChanges()
    names = []
    for states in ([0, 0, 1], [1, 1], [9, 0]):
        rows = np.zeros(len(states), ROW)
        rows["state"] = states
        names.append(changes.changes(Batch("a", np.arange(len(states)), rows))[1])
    assert names == [["idle", "armed"], [], ["state 9", "idle"]]


numbers = st.floats(-1e6, 1e6) | st.just(float("nan"))


@given(st.lists(st.tuples(st.integers(0, 10 * INTERVAL_NS), numbers, numbers), max_size=60))
def test_the_envelope_keeps_every_peak_within_its_interval(rows: list[tuple[int, float, float]]) -> None:
    t_ns = np.array([row[0] for row in rows], dtype=np.int64)
    values = np.array([row[1:] for row in rows], dtype=float).reshape(-1, 2)
    t, v = envelope(t_ns, values)
    assert set(t.tolist()) <= set(t_ns.tolist())
    for column in range(2):
        for interval in set((t_ns // INTERVAL_NS).tolist()):
            before, after = (x[k // INTERVAL_NS == interval, column] for k, x in ((t_ns, values), (t, v)))
            assert np.isnan(before).all() == np.isnan(after).all()
            if not np.isnan(before).all():
                assert np.nanmin(after) == np.nanmin(before)
                assert np.nanmax(after) == np.nanmax(before)


def test_the_envelope_has_two_rows_per_interval_in_the_order_of_their_values() -> None:
    t_ns = np.arange(0, 2 * INTERVAL_NS, INTERVAL_NS // 10)
    falling = -np.arange(20.0)
    spike = np.where(np.arange(20) == 13, 5.0, 0.0)
    t, v = envelope(t_ns, np.stack([falling, spike], axis=1))
    assert t.tolist() == t_ns[[0, 9, 10, 19]].tolist()
    assert v[:, 0].tolist() == [0.0, -9.0, -10.0, -19.0]
    assert v[:, 1].tolist() == [0.0, 0.0, 0.0, 5.0]


def test_slow_feedback_is_shown_row_by_row() -> None:
    t_ns = INTERVAL_NS * np.arange(50) + 3
    values = np.random.default_rng(1).normal(size=(50, 3))
    t, v = envelope(t_ns, values)
    np.testing.assert_array_equal(t, t_ns)
    np.testing.assert_array_equal(v, values)


@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(1e-6, 1.0)), min_size=2, max_size=40))
def test_the_newest_estimate_and_its_band_are_always_visible(estimates: list[tuple[float, float]]) -> None:
    shown, previous = None, None
    for value, sigma in estimates:
        shown = fitting(shown, value, sigma, previous)
        assert shown is not None
        low, high = shown
        assert low <= value - sigma < value + sigma <= high
        if previous is not None and abs(value - previous) < sigma:
            # A band below a thirtieth of the plot looks like a line.
            assert 2.0 * sigma > (high - low) / 30.001
        previous = value


def test_a_jump_of_many_sigmas_is_not_zoomed_away() -> None:
    low, high = fitting((0.2, 0.4), 0.3, 1e-5, previous=0.29) or (0.0, 0.0)
    assert low < 0.29 < 0.3 < high


def test_a_converging_estimate_rarely_changes_its_plot() -> None:
    ranges = []
    shown = None
    for k in range(1, 1001):
        shown = fitting(shown, 0.3, 0.1 / k, 0.3)
        ranges.append(shown)
    # From 0.1 down to 0.0001 by zooms of a factor of about two and more.
    assert 1 < len(dict.fromkeys(ranges)) < 12


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        # A multiple of ten, of one or of a tenth is labelled if a seventh of the plot lies between two.
        ((179.5, 180.5), (179.5, 181.06)),
        ((179.4, 180.3), (178.94, 180.3)),
        ((-0.9, 0.95), (-0.9, 1.06)),
        ((180.05, 180.95), (179.94, 181.06)),
        ((41.3, 47.8), (41.3, 47.8)),
        ((-0.4, 0.3), (-0.4, 0.3)),
    ],
)
def test_two_places_of_a_plot_are_labelled(shown: tuple[float, float], expected: tuple[float, float]) -> None:
    assert labelled(shown) == pytest.approx(expected)


def test_an_estimate_without_a_sigma_leaves_the_range_to_the_viewer() -> None:
    assert fitting(None, 1.0, float("inf"), None) is None
    parameters = with_estimate((), Estimate("mass", "a", 1.0, float("nan"), "kg"), None)
    assert parameters == (Parameter("mass", "kg", (("a", None),)),)


def test_a_module_keeps_its_colour_and_no_two_of_64_share_one() -> None:
    palette = Palette()
    first = palette["a"]
    others = [palette[f"m{k}"] for k in range(63)]
    assert palette["a"] == first
    assert len(dict.fromkeys([first, *others])) == 64
    assert len(dict.fromkeys(axis_shades(first))) == 3


def test_colours_of_modules_are_neither_the_estimates_orange_nor_the_truths_grey() -> None:
    for k in range(64):
        red, green, blue, _ = nth_colour(k)
        assert max(red, green, blue) - min(red, green, blue) > 40
        assert abs(red - 255) + abs(green - 150) + abs(blue - 40) > 90

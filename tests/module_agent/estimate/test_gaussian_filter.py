"""The thesis' filter must smooth without delay and without bending what is straight."""

import numpy as np
import pytest
from scipy.signal import lfilter

from module_agent.estimate.gaussian_filter import TAPS, gaussian_filter, kernel
from module_agent.model.errors import DataError


def test_it_passes_0_9924_of_two_hertz_at_250_hertz() -> None:
    gain = float(kernel() @ np.cos(2 * np.pi * 2 / 250 * (np.arange(TAPS) - TAPS // 2)))
    assert gain == pytest.approx(0.9924, abs=5e-5)
    t = np.arange(0, 4, 1 / 250)
    smooth = gaussian_filter(np.sin(2 * np.pi * 2 * t))
    # The same amplitude and no phase: the smoothed sine is the sine times its gain, away from the edges.
    np.testing.assert_allclose(smooth[20:-20], gain * np.sin(2 * np.pi * 2 * t[20:-20]), atol=1e-12)


def test_constants_and_straight_lines_stay_to_the_very_end() -> None:
    line = np.stack([np.full(40, 3.0), np.arange(40.0)], axis=1)
    np.testing.assert_allclose(gaussian_filter(line), line, atol=1e-12)


def test_inside_it_equals_a_causal_filter_shifted_back_by_five_samples() -> None:
    x = np.random.default_rng(1).normal(size=100)
    np.testing.assert_allclose(gaussian_filter(x)[5:-5], lfilter(kernel(), 1.0, x)[10:], atol=1e-12)


def test_white_noise_shrinks_as_the_sum_of_the_squared_weights() -> None:
    noise = np.random.default_rng(2).normal(size=20000)
    # 20000 samples of which about 2000 are independent: 1/sqrt(2 * 2000) = 1.6 %, four times that.
    assert gaussian_filter(noise).std() == pytest.approx(np.sqrt(np.sum(kernel() ** 2)), rel=0.065)


def test_too_short_signals_and_even_filters_are_refused() -> None:
    with pytest.raises(DataError, match="at least 6"):
        gaussian_filter(np.zeros(5))
    with pytest.raises(ValueError, match="odd"):
        gaussian_filter(np.zeros(50), taps=10)

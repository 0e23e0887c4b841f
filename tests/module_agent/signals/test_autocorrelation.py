"""Autocovariances are the plain sums; correlated samples count by their correlation."""

import numpy as np
import pytest

from module_agent.signals.autocorrelation import autocovariance, samples_per_independent


def test_autocovariances_are_the_sums_of_products_by_lag() -> None:
    signal = np.random.default_rng(1).normal(size=(40, 2))
    expected = [np.sum(signal[: 40 - lag] * signal[lag:], axis=0) for lag in range(40)]
    np.testing.assert_allclose(autocovariance(signal), expected, atol=1e-12)
    np.testing.assert_array_equal(autocovariance(signal, 7), autocovariance(signal)[:8])


def test_correlated_samples_count_for_fewer() -> None:
    rng = np.random.default_rng(0)
    white = rng.normal(size=(600, 2, 3))
    # Independent samples: none of a hundred correlations is above four sigmas.
    np.testing.assert_array_equal(samples_per_independent(white, 100), 1.0)
    # A first-order process of correlation r is worth (1 - r) / (1 + r) of its samples: a ninth for 0.8.
    slow = np.zeros((6000, 1, 3))
    for k in range(1, 6000):
        slow[k] = 0.8 * slow[k - 1] + rng.normal(size=(1, 3))
    assert samples_per_independent(slow, 100)[0] == pytest.approx(9.0, rel=0.15)
    # A residual that follows a periodic motion repeats at every period.
    swing = np.sin(0.25 * np.arange(600))[:, None, None] * np.ones((1, 1, 3))
    assert samples_per_independent(swing + 0.3 * white[:, :1], 100)[0] > 50.0


def test_residuals_of_rounding_count_as_independent() -> None:
    slow = np.sin(0.1 * np.arange(300))[:, None] * np.full(3, 1e-12)
    assert samples_per_independent(np.zeros((300, 3)), 100) == 1.0
    assert samples_per_independent(slow, 100) > 10.0
    assert samples_per_independent(slow, 100, min_rms=1e-6) == 1.0

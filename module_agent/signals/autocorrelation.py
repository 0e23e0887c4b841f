"""Correlated samples: m samples of a signal with autocorrelation rho(lag) are worth m / (1 + 2 sum rho).

1 + 2 sum rho is the variance of a mean of correlated samples over that of independent ones (Bayley and
Hammersley 1946, The effective number of independent observations in an autocorrelated time series). Estimates
of rho at long lags are noise, so that every use needs a rule for where the sum ends; the rules differ with
what is summed and stand with their uses.
"""

import numpy as np
from numpy.typing import ArrayLike

from module_agent.model.chain import Array


def autocovariance(signal: ArrayLike, max_lag: int | None = None) -> Array:
    """Return sum_t x(t) x(t + lag) of signals (m, ...) for the lags 0 to `max_lag`, (max_lag + 1, ...).

    Nothing is subtracted from the signals, and the sums are not divided by the number of their terms.
    `max_lag` is m - 1 if not given.
    """
    values = np.asarray(signal, dtype=float)
    spectrum = np.fft.rfft(values, 2 * len(values), axis=0)
    lags = len(values) if max_lag is None else max_lag + 1
    return np.asarray(np.fft.irfft(np.abs(spectrum) ** 2, 2 * len(values), axis=0)[:lags])


def samples_per_independent(residual: ArrayLike, max_lag: int, min_rms: float = 0.0) -> Array:
    """Return how many samples of residuals (m, ..., 3) count as one independent sample, (...), at least 1.

    That is 1 + 2 sum |rho(lag)|, the three axes together, over the lags up to `max_lag` whose correlation is
    significant. The magnitude is taken because what a model leaves out follows the motion, and a motion
    repeats.

    Args:
        residual: (m, ..., 3).
        max_lag: in samples; a quarter of the samples at most.
        min_rms: residuals below this are rounding.
    """
    values = np.asarray(residual, dtype=float)
    covariance = autocovariance(values - values.mean(axis=0), min(len(values) // 4, max_lag)).sum(axis=-1)
    correlation = np.abs(covariance[1:] / np.maximum(covariance[0], max(min_rms**2, np.finfo(float).tiny)))
    # Three axes share a lag. Of as many correlations of nothing the largest is below four sigmas.
    correlation[correlation < 4.0 / np.sqrt(3.0 * len(values))] = 0.0
    return np.asarray(1.0 + 2.0 * correlation.sum(axis=0))

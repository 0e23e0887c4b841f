"""Weighted and robust least squares of joint torques, with residuals that are not independent.

A joint's rows count by its residual's standard deviation, so that a large noisy joint does not drown a small
quiet one, and by how many of them are independent: a low-pass, and every effect that no column has, leave
residuals that resemble their neighbours. Weights, noise and fit are found in turn.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from coordinator.chain import Array
from coordinator.dynamics.identification import RANK_TOLERANCE

# 95 % as efficient as least squares on normal noise (Huber and Ronchetti 2009, Robust statistics, table 4.1).
HUBER_LIMIT = 1.345
# From the median of absolute deviations to the standard deviation of normal noise.
_MAD_TO_SIGMA = 1.4826
# The window of the autocorrelation's sum, in correlation times (Sokal 1997, Monte Carlo methods, eq. 3.19).
_WINDOW_TIMES = 5.0
_MOST_ROUNDS, _SETTLED = 30, 1e-4


class WeightedFit(NamedTuple):
    """Parameters of p columns, as n joints show them; arrays are read-only.

    parameters: (p,) the smallest ones that fit best, counted in the columns' scale; only their projection
        onto what the rows show is known (see `base_parameters`).
    rows, target: (k, p) and (k,) square-root information with noise of standard deviation 1: the input of
        `base_parameters`.
    rank, condition: of the scaled rows.
    sigma_nm: (n,) noise of the torques. correlation: (n,) samples that hold as much as one independent one.
    samples: (n,) that were used. downweighted: (n,) fraction of them beyond Huber's limit, zero if not
        robust.
    """

    parameters: Array
    rows: Array
    target: Array
    rank: int
    condition: float
    sigma_nm: Array
    correlation: Array
    samples: NDArray[np.int64]
    downweighted: Array

    @property
    def independent_samples(self) -> float:
        """How many independent samples the fit had."""
        return float(np.sum(self.samples / self.correlation))


def fit_weighted(
    regressor: ArrayLike,
    tau_nm: ArrayLike,
    scale: ArrayLike,
    used: ArrayLike | None = None,
    robust: bool = False,
) -> WeightedFit:
    """Fit the parameters of a regressor.

    Args:
        regressor: (m, n, p), of consecutive samples.
        tau_nm: (m, n).
        scale: (p,) by which parameters are counted (`base_parameters.Columns`).
        used: (m, n) samples to fit to, None for all. robust: Huber's weights instead of plain squares.

    Raises:
        ValueError: shapes that do not fit, values that are not finite, or a joint with too few samples.
    """
    y, tau = np.asarray(regressor, dtype=float), np.asarray(tau_nm, dtype=float)
    counted, size = np.ones(tau.shape, bool) if used is None else np.asarray(used, bool), np.asarray(scale)
    _check(y, tau, size, counted)
    weights = counted.astype(float)
    sigma, correlation = np.ones(tau.shape[1]), np.ones(tau.shape[1])
    for _ in range(_MOST_ROUNDS):
        rows, target = _reduced(y, tau, weights / (sigma * np.sqrt(correlation)))
        parameters, rank, condition = _solved(rows, target, size)
        before, residual = sigma * np.sqrt(correlation), tau - y @ parameters
        sigma = _noise(residual, counted, _taken(y, rows, size, rank, weights / before), robust)
        correlation = correlation_times(np.where(counted, residual, np.nan))
        if robust:
            off = np.abs(residual) / sigma
            weights = counted * np.sqrt(np.minimum(1.0, HUBER_LIMIT / np.maximum(off, HUBER_LIMIT)))
        if np.abs(sigma * np.sqrt(correlation) / before - 1.0).max() < _SETTLED:
            break
    samples = counted.sum(axis=0, dtype=np.int64)
    light = np.sum(counted & (weights < 1.0), axis=0) / samples
    fit = WeightedFit(
        parameters, rows, target, rank, condition, sigma, correlation, samples, light.astype(float)
    )
    for array in fit:
        if isinstance(array, np.ndarray):
            array.flags.writeable = False
    return fit


def correlation_times(residual: ArrayLike) -> Array:
    """Return of (m, n) residuals, NaN where one was not used, how many samples count as one (n,), at least 1.

    That is 1 + 2 sum rho_k over the lags k up to a window of five such times (Sokal 1997, eq. 3.19).
    """
    values = np.asarray(residual, dtype=float)
    return np.array([_correlation_time(column) for column in values.T])


def _correlation_time(residual: Array) -> float:
    there = np.isfinite(residual).astype(float)
    size = 2 * residual.size
    # By the lag: sum of products of samples that are both there, over their number.
    signal, mask = (np.fft.rfft(a, size) for a in (np.nan_to_num(residual), there))
    products, pairs = (np.fft.irfft(np.abs(a) ** 2, size)[: residual.size] for a in (signal, mask))
    if not products[0] > 0.0:
        return 1.0
    rho = np.divide(products, pairs, out=np.zeros_like(products), where=pairs > 0.5)
    times = 2.0 * np.cumsum(rho / rho[0]) - 1.0
    enough = np.arange(times.size) >= _WINDOW_TIMES * times
    return max(1.0, float(times[np.argmax(enough)] if enough.any() else times.max()))


def _reduced(y: Array, tau: Array, weights: Array) -> tuple[Array, Array]:
    """Return the triangle and the target of the weighted rows of all joints."""
    triangles = []
    for i in range(y.shape[1]):
        kept = weights[:, i] > 0.0
        block = np.column_stack([y[kept, i], tau[kept, i]]) * weights[kept, i, None]
        triangles.append(qr(block, mode="r", check_finite=False)[0][: block.shape[1]])
    whole = qr(np.vstack(triangles), mode="r", check_finite=False)[0][: y.shape[2]]
    return whole[:, :-1], whole[:, -1]


def _solved(rows: Array, target: Array, scale: Array) -> tuple[Array, int, float]:
    left, values, right = np.linalg.svd(rows * scale, full_matrices=False)
    kept = values > RANK_TOLERANCE * values[0]
    found = scale * (right[kept].T @ (left[:, kept].T @ target / values[kept]))
    return found, int(kept.sum()), float(values[0] / values[kept][-1])


def _taken(y: Array, rows: Array, scale: Array, rank: int, weights: Array) -> Array:
    """Return how many degrees of freedom the fit takes from each joint: the trace of its part of U U^T."""
    _, values, right = np.linalg.svd(rows * scale, full_matrices=False)
    inverse = scale[:, None] * right[:rank].T / values[:rank]
    taken: Array = np.sum(((y @ inverse) * weights[..., None]) ** 2, axis=(0, 2))
    return taken


def _noise(residual: Array, used: NDArray[np.bool_], taken: Array, robust: bool) -> Array:
    count = used.sum(axis=0)
    if (short := np.flatnonzero(count - taken < 1.0)).size:
        raise ValueError(
            f"joint {short[0] + 1} has {count[short[0]]} samples for {taken[short[0]]:.0f} parameters; "
            "nothing is left to tell the noise from"
        )
    if robust:
        spread = np.nanmedian(np.where(used, np.abs(residual), np.nan), axis=0) * _MAD_TO_SIGMA
    else:
        spread = np.sqrt(np.sum(np.where(used, residual, 0.0) ** 2, axis=0) / count)
    # Torques without noise leave rounding; weights must stay finite.
    found: Array = np.maximum(spread * np.sqrt(count / (count - taken)), np.finfo(float).tiny ** 0.25)
    return found


def _check(y: Array, tau: Array, scale: Array, used: NDArray[np.bool_]) -> None:
    if y.ndim != 3 or tau.shape != y.shape[:2] or used.shape != tau.shape or scale.shape != y.shape[2:]:
        raise ValueError(
            f"regressor {y.shape}, torques {tau.shape}, mask {used.shape} and scale {scale.shape} do not "
            "fit: (m, n, p), (m, n) twice and (p,) are needed"
        )
    if not (np.isfinite(y).all() and np.isfinite(tau).all()):
        raise ValueError("the regressor or a torque holds a value that is not finite")
    if (idle := np.flatnonzero(~used.any(axis=0))).size:
        raise ValueError(f"joint {idle[0] + 1} has no samples to fit to: it never moves fast enough")

"""Weighted, robust and instrumental least squares of joint torques with autocorrelated residuals.

A joint's rows are divided by the standard deviation of its residual, so that a large noisy joint does not
dominate a small quiet one; weights, noise and fit are iterated. The covariance uses the number of independent
rows: a low-pass, and every effect that the model lacks, make residuals autocorrelated.

Noise in the regressor, of an encoder differentiated twice, biases least squares towards zero. Instruments are
a second regressor of the same motion with noise of its own: Z^T (tau - Y x) = 0 has no such
bias (Young 2011, Recursive estimation and time-series analysis, section 6.2; Janot, Vandanjon and Gautier
2014, A generic instrumental variable approach for industrial robot identification).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from coordinator.parameter_fit.spectrum import (
    RANK_TOLERANCE,
    UndeterminedError,
    degrees_of_freedom,
    spectrum,
    spread,
)
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.read_only import make_read_only
from module_agent.signals.autocorrelation import autocovariance

# 95 % as efficient as least squares on normal noise (Huber and Ronchetti 2009, Robust statistics, table 4.1).
HUBER_LIMIT = 1.345
# From the median of absolute deviations to the standard deviation of normal noise.
_MAD_TO_SIGMA = 1.4826
# The window of the autocorrelation's sum in correlation times (Sokal 1997, Monte Carlo methods, eq. 3.19).
_WINDOW_TIMES = 5.0
_MAX_ROUNDS, _SETTLED = 30, 1e-4
_MIN_NM = 1e-75


class WeightedFit(NamedTuple):
    """Parameters of p columns fitted to the torques of n joints; arrays are read-only.

    parameters: (p,) the solution of least norm in the columns' scale; only its projection onto the row space
        is determined (see `base_parameters`).
    covariance: (p, p) of that projection; zero along all else, which is not certainty.
    rows, target: (k, p) and (k,) square-root information, weighted: the input of `base_parameters`.
    rank, condition: of the scaled rows.
    sigma_nm: (n,) noise of the torques. correlation: (n,) samples that count as one independent one.
    samples: (n,) that were used. downweighted: (n,) fraction of them beyond Huber's limit, zero if not
        robust.
    """

    parameters: Array
    covariance: Array
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
        """The number of independent samples of the fit."""
        return float(np.sum(self.samples / self.correlation))


class _JointRows(NamedTuple):
    """Rows that stand for all samples of a joint: regressor (k, p), torque (k,), instruments (k, p)."""

    y: Array
    tau: Array
    z: Array


class _Solution(NamedTuple):
    """The solution (p,) of weighted rows, and its inverse (p, rank): their own directions, over their size.

    hat: per joint (k, rank), orthonormal columns together. spread: per joint (k, rank) the sensitivity of the
        solution along those directions to the noise of a row: `hat`, or its equivalent by the instruments.
    rows, target: the triangle and its right-hand side. condition: of the scaled rows.
    """

    parameters: Array
    inverse: Array
    hat: list[Array]
    spread: list[Array]
    rows: Array
    target: Array
    condition: float


def fit_weighted(
    regressor: ArrayLike,
    tau_nm: ArrayLike,
    scale: ArrayLike,
    used: ArrayLike | None = None,
    robust: bool = False,
    min_correlation: float = 1.0,
    instruments: ArrayLike | None = None,
) -> WeightedFit:
    """Fit the parameters of a regressor.

    Args:
        regressor: (m, n, p), of consecutive samples.
        tau_nm: (m, n).
        scale: (p,) by which parameters are counted (`base_parameters.Columns`).
        used: (m, n) samples to fit to, None for all. robust: Huber's weights instead of plain squares.
        min_correlation: samples that count as one at least, rate / (2 cut-off) behind a low-pass; a fit to
            few samples leaves residuals that look more independent than they are.
        instruments: (m, n, p) the same regressor from measurements whose noise is independent; None for
            least squares.

    Raises:
        DataError: torques that say nothing, a joint with too few samples, or values that are not finite.
        ValueError: shapes that do not fit.
    """
    y, tau = np.asarray(regressor, dtype=float), np.asarray(tau_nm, dtype=float)
    counted, size = np.ones(tau.shape, bool) if used is None else np.asarray(used, bool), np.asarray(scale)
    _check(y, tau, size, counted)
    other = None if instruments is None else np.asarray(instruments, dtype=float)
    if other is not None and (other.shape != y.shape or not np.isfinite(other).all()):
        raise DataError(f"instruments {other.shape} must be finite and of the regressor's shape {y.shape}")
    weights, sigma = counted.astype(float), np.ones(tau.shape[1])
    joints = _joint_rows(y, tau, other, weights)
    for _ in range(_MAX_ROUNDS):
        solution = _solution(joints, sigma, size, other is not None)
        before = sigma
        if robust:
            residual = tau - y @ solution.parameters
            sigma = _robust_noise(residual, counted) * _freedom(solution, counted)
            weights = counted * _huber(residual / sigma)
            joints = _joint_rows(y, tau, other, weights)
        else:
            sigma = _noise(joints, solution, counted) * _freedom(solution, counted)
        if np.abs(sigma / before - 1.0).max() < _SETTLED:
            break
    residual = np.where(counted, tau - y @ solution.parameters, np.nan)
    correlation = np.maximum(correlation_times(residual), min_correlation)
    # The noise of the rows is 1, but several of them count as one.
    along = spread(solution.spread, correlation)
    samples = counted.sum(axis=0, dtype=np.int64)
    fit = WeightedFit(
        parameters=solution.parameters,
        covariance=solution.inverse @ along @ solution.inverse.T,
        rows=solution.rows,
        target=solution.target,
        rank=solution.inverse.shape[1],
        condition=solution.condition,
        sigma_nm=sigma,
        correlation=correlation,
        samples=samples,
        downweighted=np.sum(counted & (weights < 1.0), axis=0) / samples,
    )
    make_read_only(fit)
    return fit


def correlation_times(residual: ArrayLike) -> Array:
    """Return how many samples of residuals (m, n) count as one (n,), at least 1; unused ones are NaN.

    That is 1 + 2 sum rho_k over the lags k up to a window of five such times (Sokal 1997, eq. 3.19).
    """
    values = np.asarray(residual, dtype=float)
    return np.array([_correlation_time(column) for column in values.T])


def _correlation_time(residual: Array) -> float:
    # By the lag: sum of products of samples that were both used, over their number.
    products, pairs = autocovariance(np.nan_to_num(residual)), autocovariance(np.isfinite(residual))
    if not products[0] > 0.0:
        return 1.0
    rho = np.divide(products, pairs, out=np.zeros_like(products), where=pairs > 0.5)
    times = 2.0 * np.cumsum(rho / rho[0]) - 1.0
    enough = np.arange(times.size) >= _WINDOW_TIMES * times
    return max(1.0, float(times[np.argmax(enough)] if enough.any() else times.max()))


def _joint_rows(y: Array, tau: Array, other: Array | None, weights: Array) -> list[_JointRows]:
    """Compress each joint's samples into the triangle of their QR, which has the same products of columns."""
    size = y.shape[2]
    joints = []
    for i in range(y.shape[1]):
        used = weights[:, i] > 0.0
        blocks = [y[used, i], tau[used, i, None], *([] if other is None else [other[used, i]])]
        rows = qr(np.hstack(blocks) * weights[used, i, None], mode="r", check_finite=False)[0]
        rows = rows[: rows.shape[1]]
        joints.append(_JointRows(rows[:, :size], rows[:, size], rows[:, size + 1 :]))
    return joints


def _solution(joints: list[_JointRows], sigma: Array, scale: Array, with_instruments: bool) -> _Solution:
    stacked = [np.column_stack([joint.y, joint.tau]) / own for joint, own in zip(joints, sigma, strict=True)]
    whole = qr(np.vstack(stacked), mode="r", check_finite=False)[0][: len(scale)]
    rows, target = whole[:, :-1], whole[:, -1]
    within = spectrum(rows * scale)
    kept = within.determined(RANK_TOLERANCE)
    inverse = scale[:, None] * within.inverse(kept)
    hat = [joint.y @ inverse / own for joint, own in zip(joints, sigma, strict=True)]
    if with_instruments:
        # Along the regressor's own directions, so that undetermined ones stay zero: Z^T U c = Z^T tau.
        tools = np.vstack([joint.z @ inverse / own for joint, own in zip(joints, sigma, strict=True)])
        torques = np.concatenate([joint.tau / own for joint, own in zip(joints, sigma, strict=True)])
        answer = np.linalg.solve(tools.T @ np.vstack(hat), tools.T).T
        parameters = inverse @ (answer.T @ torques)
        spread = np.split(answer, np.cumsum([len(joint.tau) for joint in joints])[:-1])
        target = rows @ parameters
    else:
        parameters, spread = inverse @ ((rows @ inverse).T @ target), hat
    return _Solution(
        parameters=parameters,
        inverse=inverse,
        hat=hat,
        spread=spread,
        rows=rows,
        target=target,
        condition=within.condition(kept),
    )


def _huber(off: Array) -> Array:
    """Return the square roots of Huber's weights of residuals in standard deviations."""
    return np.asarray(np.sqrt(HUBER_LIMIT / np.maximum(np.abs(off), HUBER_LIMIT)))


def _noise(joints: list[_JointRows], solution: _Solution, used: NDArray[np.bool_]) -> Array:
    """Return the rms of each joint's residual (n,)."""
    left = [float(np.sum((joint.tau - joint.y @ solution.parameters) ** 2)) for joint in joints]
    # Without noise the residual is rounding; weights must stay finite.
    return np.asarray(np.maximum(np.sqrt(np.array(left) / used.sum(axis=0)), _MIN_NM))


def _robust_noise(residual: Array, used: NDArray[np.bool_]) -> Array:
    """Return each joint's noise (n,) by the median of its residuals."""
    middle = np.nanmedian(np.where(used, np.abs(residual), np.nan), axis=0)
    return np.asarray(np.maximum(_MAD_TO_SIGMA * middle, _MIN_NM))


def _freedom(solution: _Solution, used: NDArray[np.bool_]) -> Array:
    """Return per joint the factor from the rms to the standard deviation, by the degrees of freedom."""
    count = used.sum(axis=0)
    left = [degrees_of_freedom(i, int(count[i]), hat) for i, hat in enumerate(solution.hat)]
    return np.asarray(np.sqrt(count / np.array(left)))


def _check(y: Array, tau: Array, scale: Array, used: NDArray[np.bool_]) -> None:
    if y.ndim != 3 or tau.shape != y.shape[:2] or used.shape != tau.shape or scale.shape != y.shape[2:]:
        raise ValueError(
            f"regressor {y.shape}, torques {tau.shape}, mask {used.shape} and scale {scale.shape} do not "
            "fit: (m, n, p), (m, n) twice and (p,) are needed"
        )
    if not (np.isfinite(y).all() and np.isfinite(tau).all()):
        raise DataError("the regressor or a torque holds a value that is not finite")
    if (idle := np.flatnonzero(~used.any(axis=0))).size:
        raise UndeterminedError(f"joint {idle[0] + 1} has no samples to fit: it never moves fast enough")

"""Errors of IMUs: scale, misalignment, bias and delay, nuisance parameters of the batch estimator.

A sensor of three axes reads y = (I + E) x + b, late by a delay (Titterton & Weston, Strapdown Inertial
Navigation Technology, 8.3): the diagonal of E holds the scale errors, the rest the axes' misalignments.
Gravity and the joints' own rates make them observable as far as the joints turn the IMU; the others keep
their prior.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.model.chain import Array
from module_agent.model.imu_prior import ImuPrior

Index = NDArray[np.int64]

# One IMU's errors as one vector: E of the gyro and of the accelerometer row by row, their biases, the delay,
# and the gyro's sensitivity to specific force row by row.
SIZE = 34
_GYRO, _ACCEL, DELAY, FORCE = slice(0, 9), slice(9, 18), 24, slice(25, 34)
GYRO_BIAS, ACCEL_BIAS = slice(18, 21), slice(21, 24)
_NAMES = (
    (_GYRO, "an error of its gyro's scale or axes", ""),
    (_ACCEL, "an error of its accelerometer's scale or axes", ""),
    (GYRO_BIAS, "the bias of its gyro", "rad/s"),
    (ACCEL_BIAS, "the bias of its accelerometer", "m/s^2"),
    (slice(DELAY, DELAY + 1), "the delay of its IMU", "s"),
    (FORCE, "the answer of its gyro to a specific force", "s/m"),
)


class ImuIntrinsics(NamedTuple):
    """The errors of n IMUs, (n, 34); see the module's text for the order."""

    errors: Array

    @property
    def gyro_bias_rad_s(self) -> Array:
        """Biases of the gyros, (n, 3)."""
        return self.errors[:, GYRO_BIAS]

    @property
    def accel_bias_m_s2(self) -> Array:
        """Biases of the accelerometers, (n, 3)."""
        return self.errors[:, ACCEL_BIAS]

    @property
    def gyro_matrix(self) -> Array:
        """I + E of the gyros, (n, 3, 3)."""
        return np.asarray(np.eye(3) + self.errors[:, _GYRO].reshape(-1, 3, 3))

    @property
    def accel_matrix(self) -> Array:
        """I + E of the accelerometers, (n, 3, 3)."""
        return np.asarray(np.eye(3) + self.errors[:, _ACCEL].reshape(-1, 3, 3))

    @property
    def g_sensitivity_s_m(self) -> Array:
        """What a specific force adds to the gyros' rates, (n, 3, 3) [rad/s per m/s^2]."""
        return self.errors[:, FORCE].reshape(-1, 3, 3)


def beyond(intrinsics: ImuIntrinsics, prior: ImuPrior) -> Array:
    """Return the largest error of every IMU (n,) in standard deviations of the prior."""
    free = prior.sigmas > 0.0
    return np.asarray(np.abs(intrinsics.errors[:, free] / prior.sigmas[free]).max(axis=1))


def error_name(index: int) -> tuple[str, str]:
    """Return what an element of an IMU's errors belongs to, as a phrase, and its unit."""
    return next((name, unit) for part, name, unit in _NAMES if part.start <= index < part.stop)


def perfect(count: int) -> ImuIntrinsics:
    """Return zero errors for ideal IMUs."""
    return ImuIntrinsics(np.zeros((count, SIZE)))


def read(intrinsics: ImuIntrinsics, gyro: Array, accel: Array, rates: Array | None) -> tuple[Array, Array]:
    """Return the readings of IMUs with these errors for true rates and specific forces, (m, n, 3) each.

    rates: (m, n, 6) how fast gyro and accelerometer readings change [rad/s^2, m/s^3]; None without delays.
    """
    turned = np.einsum("nij,mnj->mni", intrinsics.gyro_matrix, gyro) + intrinsics.gyro_bias_rad_s
    turned += np.einsum("nij,mnj->mni", intrinsics.g_sensitivity_s_m, accel)
    forced = np.einsum("nij,mnj->mni", intrinsics.accel_matrix, accel) + intrinsics.accel_bias_m_s2
    if rates is None:
        return turned, forced
    late = intrinsics.errors[:, DELAY, None]
    return turned - late * rates[..., :3], forced - late * rates[..., 3:]


def undone(matrices: Array, readings: Array) -> Array:
    """Return the vectors (m, n, 3) that the matrices (n, 3, 3) of n sensors turn into their readings."""
    return np.asarray(np.einsum("nij,mnj->mni", np.linalg.inv(matrices), readings))


def mixing(intrinsics: ImuIntrinsics, module: int) -> Array:
    """Return the matrix (6, 6) from one IMU's true rates and forces to its readings."""
    matrix = np.zeros((6, 6))
    matrix[:3, :3], matrix[3:, 3:] = intrinsics.gyro_matrix[module], intrinsics.accel_matrix[module]
    matrix[:3, 3:] = intrinsics.g_sensitivity_s_m[module]
    return matrix


def slopes(gyro: Array, accel: Array, rates: Array | None, free: NDArray[np.bool_]) -> Array:
    """Return the derivatives of IMUs' readings by those of their own errors that are free, (k, 6, ..., m).

    gyro, accel: (m, ..., 3) true values. rates: (m, ..., 6) or None. free: (34,).
    """
    signals, (errors, rows) = error_signals(gyro, accel, rates), axis_errors(free)
    derivatives = np.zeros((SIZE, 6, *gyro.T.shape[1:]))
    for axis in range(6):
        its = errors[axis] >= 0
        derivatives[errors[axis, its], axis] = signals[rows[axis, its]]
    return derivatives[free]


def error_signals(gyro: Array, accel: Array, rates: Array | None) -> Array:
    """Return the signals by which IMUs' errors are multiplied in their readings, (14, ..., m).

    These are the true rates (3) and forces (3), one, minus their rates (6), and zero.
    gyro, accel: (m, ..., 3) true values. rates: (m, ..., 6) of the readings, or None without delays.
    """
    signals = np.zeros((14, *gyro.T.shape[1:]))
    signals[:3], signals[3:6], signals[6] = gyro.T, accel.T, 1.0
    if rates is not None:
        signals[7:13] = -rates.T
    return signals


def axis_errors(free: NDArray[np.bool_]) -> tuple[Index, Index]:
    """Return on which free errors each axis of an IMU depends, (6, p), and on which of `error_signals`.

    An axis that depends on fewer errors than others has -1 for an error, and the signal that is zero. The
    first three axes are the gyro's.
    """
    errors, rows = np.full((6, 8), -1), np.full((6, 8), 13)
    for axis in range(6):
        matrix = 3 * axis + np.arange(3)
        true, force = (range(3), FORCE.start + matrix) if axis < 3 else (range(3, 6), 3 * [-1])
        errors[axis] = [*matrix, GYRO_BIAS.start + axis, DELAY, *force]
        rows[axis] = [*true, 6, 7 + axis, *range(3, 6)]
    errors[(errors >= 0) & ~free[errors]] = -1
    rows[errors < 0] = 13
    kept = (errors >= 0).any(axis=0)
    return errors[:, kept], rows[:, kept]

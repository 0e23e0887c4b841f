"""Motions and their time derivatives through one Gaussian low-pass, the same for all compared signals.

(d/dt)^m (h * x) is x convolved with the m-th derivative of the kernel h: nothing is differentiated by
differences. What is not linear in the encoder's angle (its cosine, its squared rate) is formed first and
filtered afterwards, as the IMU's chip and this filter do to the truth.
"""

from math import factorial
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from module_agent.estimate.windows import EVEN_WITHIN, STEP_NS, Array, ImuWindow, JointWindow, Times, even
from module_agent.model.errors import DataError

# Passes 2 Hz with 0.969 and 4 Hz with 0.88. Encoder counts of 2 pi / 2^16 at 250 Hz become 0.014 rad/s^2 of
# noise in the acceleration, which shortens d by 5e-5 where the joint's is 2 rad/s^2 rms.
SMOOTH_S = 0.028
# The low-pass of the rate that is then squared.
BRIEF_S = 0.008
REACH = 5.0  # half the kernel's length, in its own deviations

# The columns of `SmoothMotion.values`: the angle's derivatives from the first to the sixth, and the angle's
# cosine and sine, and its rate squared.
DERIVATIVES = 6
COSINE, SINE, SQUARED = 6, 7, 8


class SmoothImu(NamedTuple):
    """IMU samples through the low-pass of `smooth_s`: `t_ns` (n,), gyro and accelerometer (n, 3)."""

    t_ns: Times
    gyro_rad_s: Array
    accel_m_s2: Array
    smooth_s: float


class SmoothMotion:
    """A joint's motion through the low-pass, at any time within it.

    Raises:
        DataError: too few samples for the filter, or unevenly spaced ones.
    """

    def __init__(self, joint: JointWindow, smooth_s: float = SMOOTH_S):
        step_s = _step_s(joint.t_ns, "joint", smooth_s)
        if step_s > 1e-9 * STEP_NS * (1.0 + EVEN_WITHIN):
            # The brief low-pass needs as many samples.
            joint, step_s = even(joint), 1e-9 * STEP_NS
        q = joint.position_rad
        # The brief low-pass attenuates a rate by s^2 / 2 q''' to second order, which would bias its square.
        rate = _filtered(q, step_s, BRIEF_S, 1) - 0.5 * BRIEF_S**2 * _filtered(q, step_s, BRIEF_S, 3)
        squared = _filtered(rate**2, step_s, smooth_s, 0)
        # Two filters reach farther than one: all columns end where the shortest does.
        first = (q.size - squared.size) // 2
        spare = first - _reach(step_s, smooth_s)
        columns = [_filtered(q, step_s, smooth_s, order) for order in range(1, DERIVATIVES + 1)]
        columns += [_filtered(np.cos(q), step_s, smooth_s, 0), _filtered(np.sin(q), step_s, smooth_s, 0)]
        trimmed = [column[spare : column.size - spare] for column in columns]
        self.origin_ns = int(joint.t_ns[0])
        knots = 1e-9 * (joint.t_ns[first : first + squared.size] - self.origin_ns)
        self._spline = CubicSpline(knots, np.stack([*trimmed, squared], axis=1))
        self._slope = self._spline.derivative()
        self.start_s, self.end_s = float(knots[0]), float(knots[-1])

    def values(self, t_s: Array) -> Array:
        """Return (n, 9): the columns named above at times since the joint's first sample."""
        return np.asarray(self._spline(t_s))

    def slopes(self, t_s: Array) -> Array:
        """Return (n, 9): the time derivatives of `values`."""
        return np.asarray(self._slope(t_s))


def smooth_imu(imu: ImuWindow, smooth_s: float = SMOOTH_S) -> SmoothImu:
    """Filter an IMU's samples; those whose kernel would reach beyond the window are dropped.

    Raises:
        DataError: as `SmoothMotion`.
    """
    t_ns, gyro = low_passed(imu.t_ns, imu.gyro_rad_s, smooth_s)
    _, accel = low_passed(imu.t_ns, imu.accel_m_s2, smooth_s)
    return SmoothImu(t_ns, gyro, accel, smooth_s)


def white_ratio(t_ns: Times, smooth_s: float) -> float:
    """Return the variance of white noise in one of evenly spaced samples over that behind the filter."""
    step_s = 1e-9 * float(t_ns[-1] - t_ns[0]) / (t_ns.size - 1)
    weights = derivative_kernel(step_s, smooth_s, 0)
    return 1.0 / float(weights @ weights)


def low_passed(t_ns: Times, signal: Array, smooth_s: float, order: int = 0) -> tuple[Times, Array]:
    """Return the times whose filter lies within the window, and the `order`-th derivative there.

    Raises:
        DataError: as `SmoothMotion`.
    """
    step_s = _step_s(t_ns, "IMU", smooth_s)
    reach = _reach(step_s, smooth_s)
    return t_ns[reach : t_ns.size - reach], _filtered(signal, step_s, smooth_s, order)


def derivative_kernel(step_s: float, smooth_s: float, order: int) -> Array:
    """Return the weights (taps,) of the `order`-th derivative of a Gaussian low-pass, latest sample last.

    Corrected for sampling and truncation: t^order / order! comes out as one, lower powers as zero.
    """
    reach = _reach(step_s, smooth_s)
    t = step_s / smooth_s * np.arange(-reach, reach + 1)
    window = np.exp(-0.5 * t**2)
    # The window times the polynomial (Hermite's) that passes t^order and, on these samples, no lower power.
    powers = t[:, None] ** np.arange(order % 2, order + 1, 2)
    wanted = np.zeros(powers.shape[1])
    wanted[-1] = factorial(order) / smooth_s**order
    return np.asarray(window * (powers @ np.linalg.solve((window[:, None] * powers).T @ powers, wanted)))


def _filtered(signal: Array, step_s: float, smooth_s: float, order: int) -> Array:
    """Return the filtered signal (n - 2 reach, ...), without the ends that the kernel does not cover."""
    weights = derivative_kernel(step_s, smooth_s, order)[::-1]
    if signal.ndim == 1:
        return np.convolve(signal, weights, mode="valid")
    return np.stack([np.convolve(column, weights, mode="valid") for column in signal.T], axis=1)


def _reach(step_s: float, smooth_s: float) -> int:
    return int(np.ceil(REACH * smooth_s / step_s))


def _step_s(t_ns: Times, whose: str, smooth_s: float) -> float:
    if t_ns.size < 2:
        raise DataError(f"{t_ns.size} {whose} samples: too few for the low-pass of {1e3 * smooth_s:.0f} ms")
    steps = 1e-9 * np.diff(t_ns)
    step_s = float(steps.mean())
    if np.abs(steps - step_s).max() > EVEN_WITHIN * step_s:
        raise DataError(
            f"the {whose} samples are {1e3 * steps.min():.2f} to {1e3 * steps.max():.2f} ms apart; the local "
            "estimate needs evenly spaced ones"
        )
    if step_s > smooth_s:
        raise DataError(
            f"the {whose} has {1.0 / step_s:.1f} samples per second; the low-pass of {1e3 * smooth_s:.0f} ms "
            f"needs at least {1.0 / smooth_s:.1f}"
        )
    least = 2 * (_reach(step_s, smooth_s) + _reach(step_s, BRIEF_S)) + 8
    if t_ns.size < least:
        raise DataError(f"{t_ns.size} {whose} samples: the low-pass needs at least {least}")
    return step_s

"""The shake of a joint's base, measured by the IMU of the joint's own module, and whether it is significant.

Both its IMU and the child's measure the motion of what carries the joint. It samples on the encoder's clock,
so its readings are first turned into axes that turn with the child, and then low-passed. They hold the
vibration of the gears too, and so are used only if they correlate with the joint's rate and acceleration.
"""

from copy import copy

import numpy as np
from scipy.interpolate import CubicSpline

from module_agent.estimate.smoothing import SMOOTH_S, low_passed, white_ratio
from module_agent.estimate.windows import Array, ImuWindow, JointWindow, Times

# The columns of `BaseMotion.values`: specific force, angular rate and its derivative along axes that turn
# with the child; the third is the joint's axis.
FORCE, RATE, ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
# The first and the second time derivative of the force across the axis, and of the acceleration about it.
SLOPE, CURVE = slice(9, 12), slice(12, 15)
_LOADING = [0, 1, 8]
# Chi^2 of 12 coefficients, all of them noise, is above this once in 10,000.
SHAKE_CHI2 = 39.0
# An IMU that reads this much of the joint's rate about the axis is on the moving side: its module is mounted
# reversed and does not measure the joint's base.
CARRIED_ABOVE = 0.5


class BaseMotion:
    """The shake under a joint during one motion, at any time since the joint's first sample.

    gravity: (2,) the specific force across the axis in the joint's housing, from `still`.
    shakes: whether the readings exceed the IMU's own noise.
    push_m: force across the axis per angular acceleration of the joint, a distance.

    Args:
        joint, imu: what the joint's module sampled, on one clock.
        still: (6,) its IMU's readings at rest, gyro first; a constant error counts as gravity.

    Raises:
        ValueError: too few samples for the low-pass, or unevenly spaced ones.
    """

    def __init__(self, joint: JointWindow, imu: ImuWindow, still: Array, smooth_s: float = SMOOTH_S):
        since_s = 1e-9 * (joint.t_ns - joint.t_ns[0])
        angle = np.asarray(CubicSpline(since_s, joint.position_rad)(1e-9 * (imu.t_ns - joint.t_ns[0])))
        readings = np.hstack([imu.accel_m_s2, imu.gyro_rad_s]) - np.concatenate([still[3:], still[:3]])
        turned = np.hstack([_turned_back(readings[:, :3], angle), _turned_back(readings[:, 3:], angle)])
        t_ns, smooth = low_passed(imu.t_ns, turned, smooth_s)
        _, slopes = low_passed(imu.t_ns, turned[:, 3:], smooth_s, 1)
        _, rate = low_passed(imu.t_ns, angle, smooth_s, 1)
        # These axes turn with the joint: of the slope, - rate x (rate's direction) is not the housing's.
        slopes += rate[:, None] * np.stack([-smooth[:, 4], smooth[:, 3], 0.0 * rate], axis=1)
        knots = 1e-9 * (t_ns - int(joint.t_ns[0]))
        values = np.hstack([smooth, slopes])
        loading = CubicSpline(knots, values[:, _LOADING])
        self._spline = CubicSpline(knots, np.hstack([values, loading(knots, 1), loading(knots, 2)]))
        self.start_s, self.end_s = float(knots[0]), float(knots[-1])
        self.gravity: Array = np.array(still[3:5])
        self.shakes, self.push_m = _shakes(imu.t_ns, readings, angle, smooth_s)
        self._known = np.ones(15)

    def values(self, t_s: Array) -> Array:
        """Return (n, 15), the columns named above; beyond the ends they stay as they are there."""
        return np.asarray(self._spline(np.clip(t_s, self.start_s, self.end_s)) * self._known)

    def about_the_axis(self) -> "BaseMotion":
        """Return the parts without a direction across the axis: the swing about it and the push along it."""
        reduced = copy(self)
        reduced._known = np.tile([0.0, 0.0, 1.0], 5)
        return reduced


def _turned_back(vectors: Array, angle: Array) -> Array:
    """Return vectors (n, 3) of the housing in axes that turn by angles (n,) about its third axis."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=1)


def _shakes(t_ns: Times, readings: Array, angle: Array, smooth_s: float) -> tuple[bool, float]:
    """Return whether an IMU's readings (n, 6), force first, correlate with the joint's rate and acceleration.

    Also the size of the acceleration's coefficient in the force across the axis.
    """
    _, smooth = low_passed(t_ns, readings, smooth_s)
    _, rate = low_passed(t_ns, angle, smooth_s, 1)
    _, acceleration = low_passed(t_ns, angle, smooth_s, 2)
    columns = np.stack([rate, acceleration], axis=1)
    columns = columns - columns.mean(axis=0)
    normal = columns.T @ columns
    coefficients = np.linalg.solve(normal, columns.T @ smooth)
    if abs(coefficients[0, 5]) > CARRIED_ABOVE:
        return False, 0.0
    # The low-pass removes the noise, as shake is slow and the gears' noise is white. The noise grows with the
    # speed, and so weighs most where the columns are largest.
    reach = (len(readings) - len(smooth)) // 2
    fast = readings[reach : len(readings) - reach] - smooth
    if not np.any(fast, axis=0).all():
        return False, 0.0  # constant readings: the IMU does not work
    white = fast**2 / (1.0 - 1.0 / white_ratio(t_ns, smooth_s))
    scatter = np.einsum("ni,nj,nk->kij", columns, columns, white)
    inverse = np.linalg.inv(normal)
    covariance = inverse @ scatter @ inverse
    chi2 = np.einsum("ik,kij,jk->k", coefficients, np.linalg.inv(covariance), coefficients)
    noise = float(covariance[0, 1, 1] + covariance[1, 1, 1])
    push2 = float(coefficients[1, 0] ** 2 + coefficients[1, 1] ** 2) - noise
    return bool(chi2.sum() > SHAKE_CHI2), float(np.sqrt(max(push2, 0.0)))

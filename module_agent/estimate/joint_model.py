"""What an IMU reads when one joint turns it: the model of the joint regression, and its derivatives.

The joint's angle q turns the IMU's body about the unit axis j, r points from the axis to the IMU (r . j = 0),
g is the specific force of rest at q = 0; all in the IMU's frame u. Then, with everything behind the same
zero-phase low-pass (`smooth_motion`),

    gyro  = k w + G f + b_g
    accel = (1 + E) f + b_a,     f = g(phi) + a (j x r) - w^2 r
    g(phi) = (g . j) j + (g - (g . j) j) cos phi - (j x g) sin phi

The tangential term a (j x r) and the gravity's sin phi are all but collinear in a sine of one frequency; slow
motion, where the tangential term vanishes, tells them apart, so that gravity is estimated and not believed.

A link bends quasi-statically under the load L = q'' + (pull of gravity along the tangent) / d of what it
carries: phi = q - c L, w = q' - c L', a = q'' - c L'', with c its inertia over its stiffness. The gyro tells
c, as it reads a fast motion too large by c (2 pi f)^2 and a slow one right. A bend whose hinge is away from
the joint's axis by the share h of the distance d gives the tangential term a + h c L'' instead.

The readings are late by a delay of their own in each motion: the clocks', and that of the IMU's low-pass. k
is the axis as the gyro reads it, G what the gyro feels of specific force, E (3 x 3, its columns across j) the
accelerometer's scale and misalignment, all near their perfect values as far as the `ImuKnowledge` says.
Gravity's known strength calibrates E in the plane in which the joint turns it; where it does not, the
covariance of r keeps the uncertainty of before.
"""

import numpy as np

from module_agent.estimate.smooth_motion import COSINE, SINE, SQUARED, SmoothMotion
from module_agent.estimate.windows import Array

# Where the parameters are in their vector; directions are (e1, e2, j), across and along the axis. The delays
# of the motions come last.
TURN, RADIAL, GRAVITY = slice(0, 2), slice(2, 4), slice(4, 7)
ACCEL_BIAS, GYRO_BIAS, KAPPA = slice(7, 10), slice(10, 13), slice(13, 16)
ACCEL_MATRIX, FELT = slice(16, 22), slice(22, 28)
COMPLIANCE, HINGE, DELAY = 28, 29, 30
ALONG = 6  # gravity along the axis

_LEAST_DISTANCE_M = 0.05  # where gravity's pull over the distance would grow beyond all bounds
# Readings are polynomials of what these are steps of, so differences are as good as derivatives.
_STEPS = {COMPLIANCE: 1e-7, HINGE: 1e-2}
_STEP_S = 1e-4


def predict(joint: SmoothMotion, t_s: Array, p: Array, delay: int) -> tuple[Array, Array]:
    """Return readings (n, 6), gyro first, along (e1, e2, j), and their derivatives by parameters (n, 6, k).

    The derivatives leave out how radial vector and gravity change the load that bends the link: 1e-5 of them.

    Args:
        joint: the motion; t_s (n,): times of the readings since its first sample, but for the delay.
        p: the parameters; `delay` is the place of this motion's delay among them.
    """
    values, slopes = joint.values(t_s - p[delay]), joint.slopes(t_s - p[delay])
    predicted = readings(values, p)
    jacobian = _linear(values, p)
    later, sooner = values + _STEP_S * slopes, values - _STEP_S * slopes
    jacobian[:, :, delay] = (readings(sooner, p) - readings(later, p)) / (2.0 * _STEP_S)
    for column, step in _STEPS.items():
        up, down = p.copy(), p.copy()
        up[column] += step
        down[column] -= step
        jacobian[:, :, column] = (readings(values, up) - readings(values, down)) / (2.0 * step)
    for sensor in (slice(0, 3), slice(3, 6)):
        # Turning the frame about e1 and e2 turns what is in it: u x reading.
        x, y, z = predicted[:, sensor].T
        jacobian[:, sensor, 0] = np.stack([0.0 * x, -z, y], axis=1)
        jacobian[:, sensor, 1] = np.stack([z, 0.0 * x, -x], axis=1)
    return predicted, jacobian


def readings(values: Array, p: Array) -> Array:
    """Return gyro and accelerometer (n, 6) along (e1, e2, j) for the columns of `SmoothMotion.values`."""
    rate, *carried = _carried(values, p)
    found = _force_across(carried, p) @ _mix(p).T
    found[:, :3] += rate[:, None] * (p[KAPPA] + _AXIS) + p[GYRO_BIAS]
    found[:, 3:] += p[ACCEL_BIAS]
    found[:, 5] += p[ALONG]
    return np.asarray(found)


def felt_columns(force: Array) -> Array:
    """Return (n, 3, 6): what the elements of G make of specific forces (n, 2) across the axis."""
    columns = np.zeros((len(force), 3, 6))
    for row in range(3):
        columns[:, row, 2 * row : 2 * row + 2] = force
    return columns


_AXIS = np.array([0.0, 0.0, 1.0])


def _carried(values: Array, p: Array) -> list[Array]:
    """Return how the body turns: rate, tangential acceleration, squared rate, cosine and sine; (n,) each.

    The tangential acceleration is that at the IMU over its distance, which is not the angular acceleration
    where the link's hinge is not on the axis.
    """
    c, rate = p[COMPLIANCE], values[:, 0]
    load, slope, curve = _load(values, p)
    cosine, sine, bent = values[:, COSINE], values[:, SINE], c * load
    return [
        rate - c * slope,
        values[:, 1] - (1.0 - p[HINGE]) * c * curve,
        values[:, SQUARED] - 2.0 * c * rate * slope,
        cosine + bent * sine,
        sine - bent * cosine,
    ]


def _load(values: Array, p: Array) -> tuple[Array, Array, Array]:
    """Return what bends the link, as an acceleration of what it carries [rad/s^2], and its two derivatives.

    That is q'' and gravity's pull, and to first order in c the acceleration of the bending itself: - c q''''.
    """
    rate, acceleration, jerk, snap, fifth, sixth, cosine, sine, squared = values.T
    (g1, g2, _), (r1, r2), c = p[GRAVITY], p[RADIAL], p[COMPLIANCE]
    square = max(r1**2 + r2**2, _LEAST_DISTANCE_M**2)
    even, odd = (r1 * g2 - r2 * g1) / square, -(r1 * g1 + r2 * g2) / square
    pull, slope = even * cosine + odd * sine, odd * cosine - even * sine
    return (
        acceleration + pull - c * snap,
        jerk + slope * rate - c * fifth,
        snap + slope * acceleration - pull * squared - c * sixth,
    )


def _force_across(carried: list[Array], p: Array) -> Array:
    """Return the specific force across the axis, (n, 2) along e1 and e2."""
    tangential, squared, cosine, sine = carried
    (g1, g2, _), (r1, r2) = p[GRAVITY], p[RADIAL]
    first = g1 * cosine + g2 * sine - tangential * r2 - squared * r1
    second = g2 * cosine - g1 * sine + tangential * r1 - squared * r2
    return np.stack([first, second], axis=1)


def _mix(p: Array) -> Array:
    """Return (6, 2): what gyro and accelerometer make of specific force across the axis."""
    return np.vstack([p[FELT].reshape(3, 2), np.eye(3, 2) + p[ACCEL_MATRIX].reshape(3, 2)])


def _linear(values: Array, p: Array) -> Array:
    """Return the derivatives (n, 6, k) by all that the readings are linear in; the others are zero."""
    rate, *carried = _carried(values, p)
    tangential, squared, cosine, sine = carried
    jacobian, mix = np.zeros((len(values), 6, p.size)), _mix(p)
    across = (
        (RADIAL.start, -squared, tangential),
        (RADIAL.start + 1, -tangential, -squared),
        (GRAVITY.start, cosine, -sine),
        (GRAVITY.start + 1, sine, cosine),
    )
    for column, first, second in across:
        jacobian[:, :, column] = first[:, None] * mix[:, 0] + second[:, None] * mix[:, 1]
    jacobian[:, 5, ALONG] = 1.0
    jacobian[:, 3:, ACCEL_BIAS] = np.eye(3)
    jacobian[:, :3, GYRO_BIAS] = np.eye(3)
    jacobian[:, :3, KAPPA] = np.eye(3) * rate[:, None, None]
    columns = felt_columns(_force_across(carried, p))
    jacobian[:, :3, FELT] = columns
    jacobian[:, 3:, ACCEL_MATRIX] = columns
    return jacobian

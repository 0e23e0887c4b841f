"""What an IMU reads when one joint turns it: the model of the joint regression, and its derivatives.

The joint's angle q turns the IMU's body about the unit axis j, r points from the axis to the IMU (r . j = 0),
g is the specific force of rest at q = 0; all in the IMU's frame u. Then, with everything behind the same
zero-phase low-pass (`smooth_motion`),

    gyro  = k w + G f + b_g
    accel = (1 + E) f + b_a,     f = g(phi) + a (j x r) - w^2 r
    g(phi) = (g . j) j + (g - (g . j) j) cos phi - (j x g) sin phi

In a sine of one frequency the tangential term a (j x r) is nearly collinear with gravity's sin phi; slow
motion separates them.

A link bends quasi-statically under the load L = q'' + (pull of gravity along the tangent) / d of what it
carries: phi = q - c L, w = q' - c L', a = q'' - c L'', with c its inertia over its stiffness. The gyro
determines c: it reads a fast motion too large by c (2 pi f)^2 and a slow one correctly. If the hinge of the
bend is away from the joint's axis by the share h of the distance d, the tangential term is a + h c L''.

The readings are late by a delay of their own in each motion, that of the clocks and of the IMU's low-pass. k
is the axis as the gyro reads it, G the gyro's sensitivity to specific force, E (3 x 3, its columns across j)
the accelerometer's scale and misalignment; their priors are in `ImuPrior`. If the joint's base shakes, its
motion is that of the joint's own IMU, whose axes and scale differ from those of this IMU by as much.
"""

from typing import NamedTuple

import numpy as np

from module_agent.estimate.base_shake import ACCELERATION, CURVE, FORCE, RATE, SLOPE, BaseMotion
from module_agent.estimate.smoothing import COSINE, SINE, SQUARED, SmoothMotion
from module_agent.estimate.windows import Array
from module_agent.model.catalogue import GRAVITY_M_S2
from module_agent.model.imu_prior import DELAY_S, DELAY_SIGMA_S, HINGE_SHARE, HINGE_SHARE_SIGMA, ImuPrior

# The places of the parameters in their vector; directions are (e1, e2, j), across and along the axis. The
# delays of the motions come last.
TURN, RADIAL, GRAVITY = slice(0, 2), slice(2, 4), slice(4, 7)
ACCEL_BIAS, GYRO_BIAS, GYRO_AXIS = slice(7, 10), slice(10, 13), slice(13, 16)
ACCEL_MATRIX, G_SENSITIVITY = slice(16, 22), slice(22, 28)
COMPLIANCE, HINGE = 28, 29
# Of the joint's base: the angle from e1 to the housing's x at q = 0, the delay of its IMU, the joint's axis
# from that IMU across the axis, and the child's IMU from it along the axis. What its IMU reads of the shake,
# accelerometer and gyro each, is turned about two axes across the joint's, and scaled.
BASE_HEADING, BASE_DELAY, PIVOT, HEIGHT = 30, 31, slice(32, 34), 34
BASE_FORCE, BASE_RATE = slice(35, 38), slice(38, 41)
DELAY = 41
GRAVITY_ALONG = 6

MIN_DISTANCE_M = 0.05  # bounds gravity's pull over the distance
# Readings are polynomials in these parameters, so differences with these steps are exact enough.
_STEPS = {COMPLIANCE: 1e-7, HINGE: 1e-2}
_BASE_STEPS = {BASE_HEADING: 1e-4, PIVOT.start: 1e-2, PIVOT.start + 1: 1e-2, HEIGHT: 1e-2}
_BASE_STEPS |= dict.fromkeys(range(BASE_FORCE.start, BASE_RATE.stop), 1e-3)
_STEP_S = 1e-4


class Motion(NamedTuple):
    """A joint's motion, and that of its base if the base shakes."""

    joint: SmoothMotion
    base: BaseMotion | None


def predict(motion: Motion, t_s: Array, p: Array, delay: int) -> tuple[Array, Array]:
    """Return readings (n, 6), gyro first, along (e1, e2, j), and their derivatives by parameters (n, 6, k).

    The derivatives neglect how radial vector and gravity change the load that bends the link, 2e-3 of them.

    Args:
        motion: of the joint; t_s (n,): times of the readings since its first sample, but for the delay.
        p: the parameters; `delay` is the place of this motion's delay among them.
    """
    at = t_s - p[delay]
    values, read = motion.joint.values(at), _base_reading(motion, at, p)
    shake = _shake(read, p)
    predicted = readings(values, shake, p)
    jacobian = _linear(values, shake, p)
    slopes = motion.joint.slopes(at)
    later, sooner = values + _STEP_S * slopes, values - _STEP_S * slopes
    before, after = (_shake(_base_reading(motion, at + step, p), p) for step in (-_STEP_S, _STEP_S))
    jacobian[:, :, delay] = (readings(sooner, before, p) - readings(later, after, p)) / (2.0 * _STEP_S)
    steps = _STEPS
    if shake is not None:
        steps = _STEPS | _BASE_STEPS
        change = readings(values, after, p) - readings(values, before, p)
        jacobian[:, :, BASE_DELAY] = change / (2.0 * _STEP_S)
    for column, step in steps.items():
        up, down = p.copy(), p.copy()
        up[column] += step
        down[column] -= step
        change = readings(values, _shake(read, up), up) - readings(values, _shake(read, down), down)
        jacobian[:, :, column] = change / (2.0 * step)
    for sensor in (slice(0, 3), slice(3, 6)):
        # Turning the frame about e1 and e2 turns what is in it: u x reading.
        x, y, z = predicted[:, sensor].T
        jacobian[:, sensor, 0] = np.stack([0.0 * x, -z, y], axis=1)
        jacobian[:, sensor, 1] = np.stack([z, 0.0 * x, -x], axis=1)
    return predicted, jacobian


def readings(values: Array, shake: Array | None, p: Array) -> Array:
    """Return gyro and accelerometer (n, 6) along (e1, e2, j).

    Args:
        values: the columns of `SmoothMotion.values`.
        shake: those of `BaseMotion.values`, or None for a base that stands still.
    """
    rate, *carried = _carried(values, shake, p)
    force = _force_across(carried, p)
    turning = rate[:, None] * (p[GYRO_AXIS] + (0.0, 0.0, 1.0))
    along = np.full(len(values), p[GRAVITY_ALONG])
    if shake is not None:
        across, turn, twist, push = _base_across(values, shake, p)
        force = force + across
        turning[:, :2] += turn
        along += push + twist @ (p[3], -p[2]) + 2.0 * rate * (turn @ p[RADIAL])
    predicted = force @ _mix(p).T
    predicted[:, :3] += turning + p[GYRO_BIAS]
    predicted[:, 3:] += p[ACCEL_BIAS]
    predicted[:, 5] += along
    return np.asarray(predicted)


def _base_reading(motion: Motion, at: Array, p: Array) -> Array | None:
    return None if motion.base is None else motion.base.values(at + p[BASE_DELAY])


def _shake(read: Array | None, p: Array) -> Array | None:
    """Return the columns of `BaseMotion.values` without the errors of the base's IMU.

    Those by which a link is loaded (SLOPE, CURVE) keep them: a share of a share of the load.
    """
    if read is None:
        return None
    shake = read.copy()
    for part, errors in ((FORCE, BASE_FORCE), (RATE, BASE_RATE), (ACCELERATION, BASE_RATE)):
        (u1, u2, scale), (x, y, z) = p[errors], read[:, part].T
        shake[:, part] += scale * read[:, part] + np.stack([u2 * z, -u1 * z, u1 * y - u2 * x], axis=1)
    return shake


def _base_across(values: Array, shake: Array, p: Array) -> tuple[Array, Array, Array, Array]:
    """Return the base's shake at the joint's axis, in the child's axes.

    Specific force, rate and angular acceleration across the axis (n, 2), and specific force along it (n,).
    """
    height, turn = p[HEIGHT], _base_rotation(p)
    cosine, sine = values[:, COSINE], values[:, SINE]
    (s1, s2), (w1, w2, _), (a1, a2, a3) = p[PIVOT], shake[:, RATE].T, shake[:, ACCELERATION].T
    # The pivot stands in the housing, and so turns backwards in axes that turn with the child.
    back = np.stack([cosine * s1 + sine * s2, cosine * s2 - sine * s1], axis=1)
    force = shake[:, FORCE][:, :2] + a3[:, None] * np.stack([-back[:, 1], back[:, 0]], axis=1)
    force = force + height * np.stack([a2, -a1], axis=1)
    push = shake[:, 2] + a1 * back[:, 1] - a2 * back[:, 0]
    rate, twist = np.stack([w1, w2], axis=1), np.stack([a1, a2], axis=1)
    return force @ turn, rate @ turn, twist @ turn, push


def g_sensitivity_columns(force: Array) -> Array:
    """Return (n, 3, 6): the derivatives by the elements of G for specific forces (n, 2) across the axis."""
    columns = np.zeros((len(force), 3, 6))
    for row in range(3):
        columns[:, row, 2 * row : 2 * row + 2] = force
    return columns


def _carried(values: Array, shake: Array | None, p: Array) -> list[Array]:
    """Return the motion of the body: rate, tangential acceleration, squared rate, cosine and sine; (n,) each.

    The tangential acceleration is that at the IMU over its distance, which is not the angular acceleration
    where the link's hinge is not on the axis.
    """
    c, rate = p[COMPLIANCE], values[:, 0]
    load, slope, curve = _load(values, shake, p)
    cosine, sine, bent = values[:, COSINE], values[:, SINE], c * load
    swing, twist = (shake[:, 5], shake[:, 8]) if shake is not None else (0.0, 0.0)
    return [
        rate - c * slope + swing,
        values[:, 1] - (1.0 - p[HINGE]) * c * curve + twist,
        values[:, SQUARED] - 2.0 * c * rate * slope + 2.0 * rate * swing,
        cosine + bent * sine,
        sine - bent * cosine,
    ]


def _load(values: Array, shake: Array | None, p: Array) -> list[Array]:
    """Return the load that bends the link, as an acceleration of its load [rad/s^2], and its two derivatives.

    That is q'' and gravity's pull; the base's swing and the part of its push along the tangent; and to first
    order in c the acceleration of the bending itself: - c q''''.
    """
    rate, acceleration, jerk, snap, fifth, sixth, cosine, sine, squared = values.T
    (g1, g2, _), (r1, r2), c = p[GRAVITY], p[RADIAL], p[COMPLIANCE]
    square = max(r1**2 + r2**2, MIN_DISTANCE_M**2)
    even, odd = (r1 * g2 - r2 * g1) / square, -(r1 * g1 + r2 * g2) / square
    pull, slope = even * cosine + odd * sine, odd * cosine - even * sine
    loads = [
        acceleration + pull - c * snap,
        jerk + slope * rate - c * fifth,
        snap + slope * acceleration - pull * squared - c * sixth,
    ]
    if shake is None:
        return loads
    tangent = _base_rotation(p) @ (-r2, r1) / square
    pushes = (shake[:, [0, 1, 8]], shake[:, SLOPE], shake[:, CURVE])
    return [load + push[:, :2] @ tangent + push[:, 2] for load, push in zip(loads, pushes, strict=True)]


def _base_rotation(p: Array) -> Array:
    """Return (2, 2): vectors of the housing (n, 2), in rows, times this are along e1 and e2."""
    cosine, sine = np.cos(p[BASE_HEADING]), np.sin(p[BASE_HEADING])
    return np.array([[cosine, sine], [-sine, cosine]])


def _force_across(carried: list[Array], p: Array) -> Array:
    """Return the specific force across the axis, (n, 2) along e1 and e2."""
    tangential, squared, cosine, sine = carried
    (g1, g2, _), (r1, r2) = p[GRAVITY], p[RADIAL]
    first = g1 * cosine + g2 * sine - tangential * r2 - squared * r1
    second = g2 * cosine - g1 * sine + tangential * r1 - squared * r2
    return np.stack([first, second], axis=1)


def _mix(p: Array) -> Array:
    """Return (6, 2): the response of gyro and accelerometer to specific force across the axis."""
    return np.vstack([p[G_SENSITIVITY].reshape(3, 2), np.eye(3, 2) + p[ACCEL_MATRIX].reshape(3, 2)])


def _linear(values: Array, shake: Array | None, p: Array) -> Array:
    """Return the derivatives (n, 6, k) by the linear parameters; those by the others are zero."""
    rate, *carried = _carried(values, shake, p)
    tangential, squared, cosine, sine = carried
    jacobian, mix = np.zeros((len(values), 6, p.size)), _mix(p)
    columns = (
        (RADIAL.start, -squared, tangential),
        (RADIAL.start + 1, -tangential, -squared),
        (GRAVITY.start, cosine, -sine),
        (GRAVITY.start + 1, sine, cosine),
    )
    for column, first, second in columns:
        jacobian[:, :, column] = first[:, None] * mix[:, 0] + second[:, None] * mix[:, 1]
    jacobian[:, 5, GRAVITY_ALONG] = 1.0
    jacobian[:, 3:, ACCEL_BIAS] = np.eye(3)
    jacobian[:, :3, GYRO_BIAS] = np.eye(3)
    jacobian[:, :3, GYRO_AXIS] = np.eye(3) * rate[:, None, None]
    force = _force_across(carried, p)
    if shake is not None:
        across, turn, twist, _ = _base_across(values, shake, p)
        force = force + across
        jacobian[:, 5, RADIAL] += np.stack([-twist[:, 1], twist[:, 0]], axis=1) + 2.0 * rate[:, None] * turn
    g_sensitivity = g_sensitivity_columns(force)
    jacobian[:, :3, G_SENSITIVITY] = g_sensitivity
    jacobian[:, 3:, ACCEL_MATRIX] = g_sensitivity
    return jacobian


# A link bends so that it rings at 12 Hz or above: c = 1 / (2 pi f)^2.
_COMPLIANCE_SIGMA_S2 = 2e-4
# Error of the rough clock mapping, and the delay of the IMU's low-pass.
_DELAY_S = 0.02
# Housings are about 60 mm wide, and a link offsets the child's IMU along the axis by about as much.
_PIVOT_SIGMA_M, _HEIGHT_M, _HEIGHT_SIGMA_M = 0.03, 0.05, 0.1


def parameter_priors(knowledge: ImuPrior, motions: int) -> tuple[Array, Array]:
    """Return the prior means of all parameters and their weights 1 / sigma^2, zero without a prior.

    Each of the motions has a delay of its own.
    """
    sigma = np.full(DELAY + motions, np.inf)
    scale, turn = knowledge.scale, knowledge.misalignment_rad
    # The scale error times gravity along the axis is indistinguishable from a bias.
    sigma[ACCEL_BIAS] = np.hypot(knowledge.accel_bias_m_s2, GRAVITY_M_S2 * max(scale, turn))
    sigma[GYRO_AXIS] = turn, turn, scale
    sigma[ACCEL_MATRIX] = scale, turn, turn, scale, turn, turn
    sigma[G_SENSITIVITY] = knowledge.g_sensitivity_s_m
    sigma[COMPLIANCE], sigma[HINGE] = _COMPLIANCE_SIGMA_S2, HINGE_SHARE_SIGMA
    sigma[GYRO_BIAS] = knowledge.gyro_bias_rad_s
    sigma[BASE_DELAY], sigma[PIVOT], sigma[HEIGHT] = DELAY_SIGMA_S, _PIVOT_SIGMA_M, _HEIGHT_SIGMA_M
    # Two IMUs are compared, each with errors of its own.
    turned = np.sqrt(2.0) * np.hypot(turn, knowledge.mounting_rad)
    sigma[BASE_FORCE] = sigma[BASE_RATE] = turned, turned, np.sqrt(2.0) * scale
    # Without shake the direction is irrelevant.
    sigma[BASE_HEADING] = np.pi
    sigma[DELAY:] = _DELAY_S
    mean = np.zeros_like(sigma)
    mean[HINGE], mean[BASE_DELAY], mean[HEIGHT] = HINGE_SHARE, DELAY_S, _HEIGHT_M
    return mean, 1.0 / sigma**2

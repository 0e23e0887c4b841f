"""The thesis' circle point analysis of one joint in one IMU's frame (chapters 4.3.2 to 4.3.5 and 6.2.1).

The estimator is that of the thesis, with its known biases (docs/theory.md), but with one sign convention:

    j   direction about which the IMU's body turns when the joint's position grows
    r   points from the joint's axis to the IMU (the thesis' points back to the joint)
    n   j x r / |r|, so that the tangential acceleration is + alpha d, with d >= 0

For these, eq. 24 reads r = d (n x j) as in the thesis. Eq. 16 does not: as seen from a body that turns by
+phi about j, gravity turns by -phi, where the thesis prints +phi.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from module_agent.estimate.gaussian_filter import TAPS, gaussian_filter
from module_agent.estimate.windows import AlignedMotion, Array, ImuWindow
from module_agent.model.errors import DataError
from module_agent.model.read_only import frozen
from module_agent.signals.autocorrelation import autocovariance
from module_agent.wire.messages import CircleEstimate

MIN_SAMPLES = 3 * TAPS
MIN_RATE_RAD_S = 0.02  # 15 times the gyro's noise; slower motions say nothing about an axis
MIN_ACCELERATION_RAD_S2 = 0.1  # 100 mm give 0.01 m/s^2, below the noise of one sample
# The window of 5.6 s leaves 2 % of the amplitude in its first 0.1 s, 0.4 mrad of angle at 0.2 rad.
REST_S = 0.1


class RestReading(NamedTuple):
    """An IMU's readings at rest: means (3,) in frame u, and the scatter of one sample (rms over the axes)."""

    gyro_offset_rad_s: Array
    specific_force_m_s2: Array
    gyro_scatter_rad_s: float
    accel_scatter_m_s2: float
    samples: int


class JointAxis(NamedTuple):
    """The unit axis j (3,) in frame u, one sigma of its direction, and how many samples gave it."""

    axis: Array
    sigma_rad: float
    samples: int


class CircleFit(NamedTuple):
    """A circle point analysis; vectors (3,) in the IMU frame u, conventions as in the module's docstring.

    sigma_distance_m: from the residual of eq. 23, widened for its autocorrelation, and from what the initial
        gravity and the axis leave uncertain in eq. 16. Scale errors of the sensors are not included.
    residual_rms_m_s2: of the tangential acceleration about alpha d.
    singular_values: of eq. 20 divided by sqrt(samples): rms accelerations [m/s^2], largest first.
    """

    axis: Array
    tangent: Array
    radial_m: Array
    distance_m: float
    sigma_axis_rad: float
    sigma_distance_m: float
    residual_rms_m_s2: float
    singular_values: Array
    samples: int


def rest_reading(rest: ImuWindow) -> RestReading:
    """Average an IMU at rest: the gyro offset of eq. 30, and gravity.

    Raises:
        DataError: too few samples.
    """
    _enough(rest.t_ns.size, "rest")
    gyro, accel = rest.gyro_rad_s.mean(axis=0), rest.accel_m_s2.mean(axis=0)
    return RestReading(
        frozen(gyro),
        frozen(accel),
        float(np.sqrt(np.mean((rest.gyro_rad_s - gyro) ** 2))),
        float(np.sqrt(np.mean((rest.accel_m_s2 - accel) ** 2))),
        int(rest.t_ns.size),
    )


def joint_axis(constant: AlignedMotion, rest: RestReading) -> JointAxis:
    """Find the joint's axis in frame u from the constant motion: eq. 15 on the gyro less its offset (eq. 30).

    Samples of less than half the top speed are dropped. Every sample counts with the sign of the encoder's
    rate: a motion forth and back cancels the gyro offset.

    Raises:
        DataError: too few samples, no motion of the joint, or none of the IMU.
    """
    _enough(constant.t_s.size, "constant motion")
    speed = np.abs(constant.velocity_rad_s)
    if speed.max() < MIN_RATE_RAD_S:
        raise DataError(
            f"the joint turned at {speed.max():.2g} rad/s at most in the constant motion, "
            f"at least {MIN_RATE_RAD_S} is needed for its axis"
        )
    steady = speed >= 0.5 * speed.max()
    sign = np.sign(constant.velocity_rad_s[steady])
    gyro = sign[:, None] * (constant.gyro_rad_s[steady] - rest.gyro_offset_rad_s)
    mean = gyro.mean(axis=0)
    rate = float(np.linalg.norm(mean))
    if rate < 0.25 * MIN_RATE_RAD_S:
        raise DataError(
            f"the gyro saw {rate:.2g} rad/s while the joint turned: this IMU does not move with it"
        )
    axis = mean / rate
    across = gyro - np.outer(gyro @ axis, axis)
    # Both directions across the axis count, and so does the offset's own error where the motion goes one way.
    variance = 0.5 * sum(_variance_of_mean(across[:, i]) for i in range(3))
    variance += (float(sign.mean()) * rest.gyro_scatter_rad_s) ** 2 / rest.samples
    return JointAxis(frozen(axis), float(np.sqrt(variance)) / rate, int(np.count_nonzero(steady)))


def circle_point_analysis(
    rest: ImuWindow, constant: AlignedMotion, sine: AlignedMotion, taps: int = TAPS
) -> CircleFit:
    """Run eqs. 12 to 24 and 30: axis from the constant motion, radial vector from the windowed sine motion.

    The initial gravity of eq. 16 is a mean: one sample's noise (0.03 m/s^2, 3 mrad) would move d by 0.2 mm.

    Args:
        rest: about 2 s of the IMU at rest.
        constant: the CM, on one time axis (`windows.align`).
        sine: the WSM, likewise, beginning with at least `REST_S` of near rest.
        taps: of the filter of alpha; 1 is none, as in the thesis' comparison (6.2.1.2); d is then too short.

    Returns:
        The fit. An IMU on the axis has a distance near zero and a sigma no smaller than its noise
        warrants; its radial direction is then undefined.

    Raises:
        DataError: too few samples or too little motion; the message says how much is needed.
    """
    _enough(sine.t_s.size, "windowed sine motion")
    at_rest = rest_reading(rest)
    joint = joint_axis(constant, at_rest)
    alpha = angular_acceleration(sine, taps)
    quiet = sine.t_s <= REST_S
    # Eq. 16: the body turns by +phi about j, so the world turns by -phi as seen from it.
    phi = sine.position_rad - sine.position_rad[quiet].mean()
    turns = np.asarray(Rotation.from_rotvec(np.outer(-phi, joint.axis)).as_matrix())
    # Eqs. 16 to 18: the specific force less the turned initial gravity, less its mean.
    dynamic = sine.accel_m_s2 - turns @ sine.accel_m_s2[quiet].mean(axis=0)
    dynamic = np.asarray(dynamic - dynamic.mean(axis=0))
    _, spread, basis = np.linalg.svd(dynamic, full_matrices=False)  # eq. 20
    tangent = basis[0]  # eq. 21; its sign follows from d >= 0
    power = float(alpha @ alpha)
    distance = float(alpha @ dynamic @ tangent) / power  # eq. 23
    if distance < 0.0:
        tangent, distance = -tangent, -distance
    residual = dynamic @ tangent - alpha * distance
    blocks = (
        float(residual @ residual) / residual.size / power * _widening(residual, alpha),
        _gravity_variance(alpha, turns, tangent, at_rest, int(np.count_nonzero(quiet))),
        _tilt_variance(alpha, sine.position_rad, at_rest, joint.sigma_rad),
    )
    return CircleFit(
        axis=joint.axis,
        tangent=frozen(tangent),
        radial_m=frozen(distance * np.cross(tangent, joint.axis)),  # eq. 24
        distance_m=distance,
        sigma_axis_rad=joint.sigma_rad,
        sigma_distance_m=float(np.sqrt(sum(blocks))),
        residual_rms_m_s2=float(np.sqrt(np.mean(residual**2))),
        singular_values=frozen(spread / np.sqrt(sine.t_s.size)),
        samples=int(sine.t_s.size),
    )


def angular_acceleration(motion: AlignedMotion, taps: int = TAPS) -> Array:
    """Differentiate the joint's rate and smooth it by the Gaussian of 11 taps (thesis 6.2.1.2): (n,) rad/s^2.

    Raises:
        DataError: the joint hardly accelerated, or `taps` is not odd and positive.
    """
    alpha = gaussian_filter(np.gradient(motion.velocity_rad_s, motion.t_s), taps)
    rms = float(np.sqrt(np.mean(alpha**2)))
    if rms < MIN_ACCELERATION_RAD_S2:
        raise DataError(
            f"the joint accelerated by {rms:.2g} rad/s^2 rms in the windowed sine motion, "
            f"at least {MIN_ACCELERATION_RAD_S2} is needed for its radial distance"
        )
    return alpha


def circle_estimate(fit: CircleFit, delay_s: float) -> CircleEstimate:
    """Return the fit as the part of a message that carries it."""
    return CircleEstimate(**message_fields(fit), delay_s=delay_s)


def message_fields(estimate: Any) -> dict[str, Any]:
    """Return the fields of an estimate as in its message: vectors as tuples, sigmas within its limits."""
    fields = estimate._asdict()
    fields |= {name: tuple(v.tolist()) for name, v in fields.items() if isinstance(v, np.ndarray)}
    fields["sigma_axis_rad"] = min(estimate.sigma_axis_rad, 10.0)
    fields["sigma_distance_m"] = min(estimate.sigma_distance_m, 1e3)
    return dict(fields)


def _gravity_variance(alpha: Array, turns: Array, tangent: Array, rest: RestReading, quiet: int) -> float:
    """Return the variance of d that the noise of the initial gravity causes through eqs. 16 and 23 [m^2]."""
    turned = np.einsum("nij,i->nj", turns, tangent)  # n . (R_n g0) = seen_n . g0
    gain = alpha @ (turned - turned.mean(axis=0)) / float(alpha @ alpha)
    return float(gain @ gain) * rest.accel_scatter_m_s2**2 / max(quiet, 1)


def _tilt_variance(alpha: Array, position: Array, rest: RestReading, sigma_axis_rad: float) -> float:
    """Return the variance of d from the axis' error, which turns gravity wrongly by phi g sigma [m^2]."""
    gain = float(alpha @ (position - position.mean())) / float(alpha @ alpha)
    return (gain * float(np.linalg.norm(rest.specific_force_m_s2)) * sigma_axis_rad) ** 2


def _widening(residual: Array, regressor: Array) -> float:
    """Return by how much correlated residuals widen a coefficient's variance: 1 + 2 sum rho kappa >= 1.

    rho and kappa are the autocorrelations of residual and regressor. The sum ends where rho first has a pair
    that is not positive (Geyer 1992, initial positive sequence).
    """
    rho, kappa = _autocorrelation(residual), _autocorrelation(regressor)
    even = 2 * ((rho.size - 1) // 2) + 1
    ends = np.flatnonzero(rho[1:even].reshape(-1, 2).sum(axis=1) <= 0.0)
    last = 1 + 2 * int(ends[0]) if ends.size else even
    return max(1.0, 1.0 + 2.0 * float(rho[1:last] @ kappa[1:last]))


def _autocorrelation(series: Array) -> Array:
    """Return the biased autocorrelation at lags 0 to n - 1; all zero for a series that is zero."""
    power = float(series @ series)
    return autocovariance(series) / power if power > 0.0 else np.zeros_like(series)


def _variance_of_mean(series: Array) -> float:
    """Return the variance of the mean of a correlated series."""
    x = series - series.mean()
    return float(x @ x / x.size**2) * _widening(x, np.ones_like(x))


def _enough(samples: int, what: str) -> None:
    if samples < MIN_SAMPLES:
        raise DataError(f"{samples} samples of the {what}: at least {MIN_SAMPLES} are needed")

"""The estimate of one joint in one IMU's frame: least squares over rest, slow and fast motion together.

The model is that of `joint_model`. What cannot be told from one another in a sine of one frequency - the
tangential acceleration and gravity's sine, the gyro's scale and a bending link - slow motion tells apart;
what no motion of this joint tells keeps the uncertainty that it had before (`ImuKnowledge`), and with it the
covariance of the result.
"""

from collections.abc import Sequence
from math import radians
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from module_agent.estimate.circle_point_analysis import RestReading
from module_agent.estimate.joint_model import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    ALONG,
    COMPLIANCE,
    DELAY,
    FELT,
    GRAVITY,
    GYRO_BIAS,
    HINGE,
    KAPPA,
    RADIAL,
    TURN,
    felt_columns,
    predict,
)
from module_agent.estimate.smooth_motion import (
    COSINE,
    SINE,
    SMOOTH_S,
    SQUARED,
    SmoothImu,
    SmoothMotion,
    smooth_imu,
)
from module_agent.estimate.windows import Array, ImuWindow, JointWindow

GRAVITY_M_S2 = 9.81
GRAVITY_SIGMA_M_S2 = 0.015  # from the equator to 60 degrees of latitude it is 9.78 to 9.82
# Samples beyond the noise of one: the low-pass correlates neighbours, so every one says little more.
STRIDE = 7
ITERATIONS = 12
SETTLED = 1e-3  # of every parameter's deviation
# A link bends so that it rings at 12 Hz or above: c = 1 / (2 pi f)^2.
COMPLIANCE_SIGMA_S2 = 2e-4
# A bent link's hinge as a share of the distance: at the axis where its clamp gives, at 0.15 by beam theory.
HINGE_SHARE, HINGE_SHARE_SIGMA = 0.0, 0.05
GYRO_FEELS_S_M = 2e-4  # rad/s per m/s^2: 0.1 deg/s/g in data sheets
BIAS_DRIFT_RAD_S = 1e-4  # of a gyro, within the minute between rest and motion


class ImuKnowledge(NamedTuple):
    """How well an IMU is known beforehand, one standard deviation each."""

    scale: float
    misalignment_rad: float
    accel_bias_m_s2: float


# Calibrated on a rate table and by gravity, and what data sheets of this class of IMU allow.
CALIBRATED = ImuKnowledge(1e-4, 1e-4, 0.2)
AS_DELIVERED = ImuKnowledge(0.01, radians(1.0), 0.2)


class SeenMotion(NamedTuple):
    """A joint's motion and what an IMU saw of it: t_imu = t_joint + `offset_ns` and a delay to be found."""

    imu: SmoothImu
    joint: SmoothMotion
    offset_ns: int


def seen_motion(imu: ImuWindow, joint: JointWindow, offset_ns: int, smooth_s: float = SMOOTH_S) -> SeenMotion:
    """Put both windows of one motion behind the low-pass.

    Raises:
        ValueError: too few samples for the low-pass, or unevenly spaced ones.
    """
    return SeenMotion(smooth_imu(imu, smooth_s), SmoothMotion(joint, smooth_s), offset_ns)


class JointRegression(NamedTuple):
    """What one IMU says of one joint; vectors (3,) in frame u, arrays read-only.

    gravity_m_s2: the specific force of rest at q = 0.
    compliance_s2: c of the module's text; a motion of f Hz is larger by c (2 pi f)^2 than the encoder says.
    delays_s: per motion, beyond its offset.
    covariance: (6, 6) of axis [rad] and radial vector [m], both in frame u; singular along the axis.
    accel_noise_m_s2, gyro_noise_rad_s: white noise of one sample, from the residuals.
    """

    axis: Array
    radial_m: Array
    distance_m: float
    sigma_axis_rad: float
    sigma_distance_m: float
    covariance: Array
    gravity_m_s2: Array
    accel_bias_m_s2: Array
    gyro_bias_rad_s: Array
    compliance_s2: float
    delays_s: tuple[float, ...]
    accel_noise_m_s2: float
    gyro_noise_rad_s: float
    samples: int


class _State(NamedTuple):
    """frame: (3, 3), columns e1, e2, j in u. values: all parameters but the turn, which `frame` holds."""

    frame: Array
    values: Array


class _Rows(NamedTuple):
    """Readings of one motion (n, 6), gyro first, and the times of them since the joint's first sample."""

    readings: Array
    t_s: Array
    white: float


def regress_joint(
    motions: Sequence[SeenMotion], rest: RestReading | None, knowledge: ImuKnowledge = CALIBRATED
) -> JointRegression:
    """Fit the model of the module's text to all motions of one joint.

    Raises:
        ValueError: no motion, too few samples of one, or a joint or an IMU that did not move.
    """
    rows, prior, state, noise = _fit(motions, rest, knowledge)
    normal, _, noise = _normal_equations(motions, rows, state, prior, noise)
    return _result(
        state, np.asarray(np.linalg.inv(normal), dtype=np.float64), noise, sum(len(r.t_s) for r in rows)
    )


def distance_bound_m(
    motions: Sequence[SeenMotion],
    rest: RestReading | None,
    knowledge: ImuKnowledge,
    noise: tuple[float, float],
) -> float:
    """Return the Cramer-Rao bound of the radial distance for white noise of gyro and accelerometer [SI].

    All else that `regress_joint` does not know is unknown here too, but for the place of a bent link's hinge.
    It is taken where the fit has its optimum, and holds for the motions as they are handed over: whoever asks
    for the bound of a recording smooths them as little as the encoder's noise allows.

    Raises:
        ValueError: as `regress_joint`.
    """
    rows, prior, state, _ = _fit(motions, rest, knowledge)
    normal, _, _ = _normal_equations(motions, rows, state, prior, np.array(noise))
    known = np.arange(len(normal)) != HINGE
    covariance = np.zeros_like(normal)
    covariance[np.ix_(known, known)] = np.linalg.inv(normal[np.ix_(known, known)])
    return _result(state, covariance, np.array(noise), 0).sigma_distance_m


def _fit(
    motions: Sequence[SeenMotion], rest: RestReading | None, knowledge: ImuKnowledge
) -> "tuple[list[_Rows], _Prior, _State, Array]":
    if not motions:
        raise ValueError("no motion of the joint: at least one is needed")
    rows = [_rows(motion) for motion in motions]
    prior, state = _prior(knowledge, rest, len(motions)), _first_guess(motions, rows)
    noise = np.array([1e-3, 2e-2])
    for _ in range(ITERATIONS):
        normal, gradient, noise = _normal_equations(motions, rows, state, prior, noise)
        step: Array = np.asarray(np.linalg.solve(normal, gradient), dtype=np.float64)
        state = _moved(state, step)
        if np.all(np.abs(step) <= SETTLED / np.sqrt(np.diag(normal))):
            break
    return rows, prior, state, noise


# ---------------------------------------------------------------------- the data


def _rows(motion: SeenMotion) -> _Rows:
    since_ns = motion.imu.t_ns - motion.offset_ns - motion.joint.origin_ns
    t_s = since_ns.astype(np.float64) * 1e-9
    # A little is kept for the delay to move in.
    inside = np.flatnonzero((t_s > motion.joint.start_s + 0.01) & (t_s < motion.joint.end_s - 0.01))[::STRIDE]
    if inside.size < 20:
        raise ValueError(f"{inside.size} IMU samples fall into the joint's motion: at least 20 are needed")
    readings: Array = np.hstack([motion.imu.gyro_rad_s[inside], motion.imu.accel_m_s2[inside]])
    return _Rows(readings, t_s[inside], motion.imu.white)


def _first_guess(motions: Sequence[SeenMotion], rows: Sequence[_Rows]) -> _State:
    """Solve the model without compliance, delay and sensor errors, where it is linear."""
    values = np.concatenate([m.joint.values(r.t_s) for m, r in zip(motions, rows, strict=True)])
    readings = np.concatenate([r.readings for r in rows])
    rate, acceleration = values[:, 0], values[:, 1]
    cosine, sine, squared = values[:, COSINE], values[:, SINE], values[:, SQUARED]
    one = np.ones_like(rate)
    gyro = np.linalg.lstsq(np.stack([rate, one], axis=1), readings[:, :3], rcond=None)[0]
    size = float(np.linalg.norm(gyro[0]))
    if size < 0.25:
        raise ValueError(
            f"the gyro turned by {size:.2g} of what the joint did: this IMU does not move with it"
        )
    axis = gyro[0] / size
    columns = np.stack([one, cosine, sine, acceleration, squared], axis=1)
    force = np.linalg.lstsq(columns, readings[:, 3:], rcond=None)[0]
    radial = np.cross(force[3], axis)
    # Across the axis, from the cosine's and the sine's coefficients alike.
    gravity = 0.5 * (force[1] + np.cross(axis, force[2]))
    frame = _frame(axis)
    found = np.zeros(DELAY + len(motions))
    found[RADIAL], found[GRAVITY] = (frame.T @ radial)[:2], frame.T @ gravity
    found[ALONG] = axis @ force[0]
    found[GYRO_BIAS] = frame.T @ gyro[1]
    return _State(frame, found)


def _frame(axis: Array) -> Array:
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(axis, across), axis], axis=1)


# ---------------------------------------------------------------------- the model


class _Prior(NamedTuple):
    """Beliefs about the parameters, means and weights 1 / sigma^2, and the IMU's reading at rest."""

    mean: Array
    weight: Array
    rest: RestReading | None


def _prior(knowledge: ImuKnowledge, rest: RestReading | None, motions: int) -> _Prior:
    sigma = np.full(DELAY + motions, np.inf)
    scale, turn = knowledge.scale, knowledge.misalignment_rad
    # What the scale makes of gravity along the axis cannot be told from a bias.
    sigma[ACCEL_BIAS] = np.hypot(knowledge.accel_bias_m_s2, GRAVITY_M_S2 * max(scale, turn))
    sigma[KAPPA] = turn, turn, scale
    sigma[ACCEL_MATRIX] = scale, turn, turn, scale, turn, turn
    sigma[FELT] = GYRO_FEELS_S_M
    sigma[COMPLIANCE], sigma[HINGE] = COMPLIANCE_SIGMA_S2, HINGE_SHARE_SIGMA
    sigma[GYRO_BIAS] = 0.1
    sigma[DELAY:] = 0.02
    mean = np.zeros_like(sigma)
    mean[HINGE] = HINGE_SHARE
    return _Prior(mean, 1.0 / sigma**2, rest)


def _normal_equations(
    motions: Sequence[SeenMotion], rows: Sequence[_Rows], state: _State, prior: _Prior, noise: Array
) -> tuple[Array, Array, Array]:
    """Return J^T W J, J^T W e, and the noise of one sample (gyro, accel) that the residuals show."""
    normal = np.diag(prior.weight)
    gradient = prior.weight * (prior.mean - state.values)
    if prior.rest is not None:
        _add_rest(normal, gradient, prior.rest, state)
    size = float(np.linalg.norm(state.values[GRAVITY]))
    along = state.values[GRAVITY] / size
    normal[GRAVITY, GRAVITY] += np.outer(along, along) / GRAVITY_SIGMA_M_S2**2
    gradient[GRAVITY] += along * (GRAVITY_M_S2 - size) / GRAVITY_SIGMA_M_S2**2
    power, count = np.zeros(2), 0
    for i, (motion, row) in enumerate(zip(motions, rows, strict=True)):
        predicted, slopes = predict(motion.joint, row.t_s, state.values, DELAY + i)
        residual = _in_frame(row.readings, state.frame) - predicted
        for sensor in range(2):
            part = slice(3 * sensor, 3 * sensor + 3)
            weight = STRIDE / (noise[sensor] ** 2)
            jacobian, error = slopes[:, part].reshape(-1, slopes.shape[2]), residual[:, part].ravel()
            normal += weight * jacobian.T @ jacobian
            gradient += weight * jacobian.T @ error
            power[sensor] += row.white * float(error @ error)
        count += residual.size // 2
    return normal, gradient, np.sqrt(power / count)


def _add_rest(normal: Array, gradient: Array, rest: RestReading, state: _State) -> None:
    """Add the gyro's reading at rest, which is its bias and what it makes of gravity there."""
    felt = state.frame.T @ rest.specific_force_m_s2
    slopes = np.zeros((3, len(gradient)))
    slopes[:, GYRO_BIAS] = np.eye(3)
    slopes[:, FELT] = felt_columns(felt[None, :2])[0]
    error = state.frame.T @ rest.gyro_offset_rad_s - slopes @ state.values
    variance = rest.gyro_scatter_rad_s**2 / rest.samples + BIAS_DRIFT_RAD_S**2
    normal += slopes.T @ slopes / variance
    gradient += slopes.T @ error / variance


def _in_frame(readings: Array, frame: Array) -> Array:
    return np.hstack([readings[:, :3] @ frame, readings[:, 3:] @ frame])


def _moved(state: _State, step: Array) -> _State:
    """Turn the frame by the step's turn, and all that is in it with it."""
    values = state.values + step
    turn = np.array([step[0], step[1], 0.0])
    values[TURN] = 0.0
    return _State(state.frame @ Rotation.from_rotvec(turn).as_matrix(), values)


def _result(state: _State, covariance: Array, noise: Array, samples: int) -> JointRegression:
    p, frame = state.values, state.frame
    r1, r2 = p[RADIAL]
    distance = float(np.hypot(r1, r2))
    # The axis turns by u x j and carries the radial vector along by u x r.
    gain = np.zeros((6, p.size))
    gain[:3, :2] = np.stack([-frame[:, 1], frame[:, 0]], axis=1)
    gain[3:, :2] = np.outer(frame[:, 2], [r2, -r1])
    gain[3:, RADIAL] = frame[:, :2]
    six = gain @ covariance @ gain.T
    radial = frame[:, :2] @ p[RADIAL]
    along = radial / max(distance, 1e-6)
    return JointRegression(
        axis=_frozen(frame[:, 2]),
        radial_m=_frozen(radial),
        distance_m=distance,
        sigma_axis_rad=float(np.sqrt(0.5 * np.trace(six[:3, :3]))),
        sigma_distance_m=float(np.sqrt(along @ six[3:, 3:] @ along)),
        covariance=_frozen(six),
        gravity_m_s2=_frozen(frame @ p[GRAVITY]),
        accel_bias_m_s2=_frozen(frame @ p[ACCEL_BIAS]),
        gyro_bias_rad_s=_frozen(frame @ p[GYRO_BIAS]),
        compliance_s2=float(p[COMPLIANCE]),
        delays_s=tuple(float(x) for x in p[DELAY:]),
        accel_noise_m_s2=float(noise[1]),
        gyro_noise_rad_s=float(noise[0]),
        samples=samples,
    )


def _frozen(values: Array) -> Array:
    found = np.array(values, dtype=float)
    found.flags.writeable = False
    return found

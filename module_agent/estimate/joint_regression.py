"""The estimate of one joint in one IMU's frame: least squares over rest, slow and fast motion together.

The model is that of `joint_model`. What no motion of this joint determines keeps its prior uncertainty
(`ImuPrior`), which enters the covariance of the result.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from module_agent.estimate.circle_point_analysis import RestReading, message_fields
from module_agent.estimate.joint_model import (
    ACCEL_BIAS,
    BASE_HEADING,
    COMPLIANCE,
    DELAY,
    G_SENSITIVITY,
    GRAVITY,
    GRAVITY_ALONG,
    GYRO_BIAS,
    HINGE,
    MIN_DISTANCE_M,
    RADIAL,
    TURN,
    Motion,
    g_sensitivity_columns,
    parameter_priors,
    predict,
)
from module_agent.estimate.observed_motion import ObservedMotion
from module_agent.estimate.smoothing import COSINE, SINE, SMOOTH_S, SQUARED, SmoothMotion, white_ratio
from module_agent.estimate.windows import Array
from module_agent.model.catalogue import GRAVITY_M_S2, GRAVITY_SIGMA_M_S2
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import CALIBRATED, GYRO_BIAS_DRIFT_RAD_S, ImuPrior
from module_agent.model.read_only import frozen
from module_agent.signals.autocorrelation import samples_per_independent
from module_agent.wire.messages import RegressionEstimate

ITERATIONS = 12
SETTLED = 0.03  # of every parameter's deviation, were it the only one
MIN_RATE_SHARE = 0.25
# With less of gravity across the axis, two IMUs cannot agree on a direction across it.
MIN_ACROSS_M_S2 = 1.0
MAX_LAG = 50  # samples, a second and a half
PINNED = 1e6  # the weight that fixes a parameter at its prior mean


class JointRegression(NamedTuple):
    """The estimate of one joint by one IMU; vectors (3,) in frame u, arrays read-only.

    gravity_m_s2: the specific force of rest at q = 0.
    compliance_s2: c of `joint_model`.
    delays_s: per motion, beyond its offset.
    covariance: (6, 6) of axis [rad] and radial vector [m], both in frame u; singular along the axis.
    base_shakes: whether the shake of the joint's base was measured and subtracted.
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
    samples: int
    base_shakes: bool


def regression_estimate(regression: JointRegression, delay_s: float) -> RegressionEstimate:
    """Return the result as the part of a message that carries it; `delay_s` is that of its last motion."""
    upper = np.clip(regression.covariance[np.triu_indices(6)], -1e6, 1e6)
    return RegressionEstimate(
        **message_fields(regression) | {"covariance": tuple(upper.tolist())}, delay_s=delay_s
    )


class _State(NamedTuple):
    """frame: (3, 3), columns e1, e2, j in u. values: all parameters but the turn, which `frame` holds."""

    frame: Array
    values: Array


class _Rows(NamedTuple):
    """One motion and the readings of it (n, 6), gyro first, at times since the joint's first sample.

    white: the variance of white noise in a sample of the IMU over that of `_slow` residuals. stride: the
    samples of the IMU for each of these: the low-pass makes neighbours alike, so that nothing is lost.
    repeats: how many of these count as one independent sample if the noise is white. rate2_s2: the mean
    square of the joint's acceleration over that of its rate, (2 pi f)^2 of a sine.
    """

    motion: Motion
    readings: Array
    t_s: Array
    white: float
    stride: int
    repeats: float
    rate2_s2: float
    instrument: SmoothMotion | None


class _Problem(NamedTuple):
    """The data of the fit; `unresolved_m` is how much shake of unknown direction may change d.

    mean, weight: of the `parameter_priors`.
    """

    rows: tuple[_Rows, ...]
    mean: Array
    weight: Array
    rest: RestReading | None
    unresolved_m: float


class _Equations(NamedTuple):
    """Normal equations J^T W J and J^T W e, and what the residuals show; with an instrument Z it is Z^T W J.

    scatter: J^T W V W J with V the residuals' own squares: J^T W J where the noise is what W takes it for.
    noise: (2,) of one sample, gyro's first.
    """

    normal: Array
    gradient: Array
    scatter: Array
    noise: Array


# Of a covariance's largest eigenvalue; and of a distance the standard deviation that messages hold.
_ROUNDING, _MAX_SIGMA_M = 1e-9, 1e3
_DIVERGES = "the fit diverges: no motion of the joint explains what the IMU read, is it sick?"


def regress_joint(
    motions: Sequence[ObservedMotion],
    rest: RestReading | None,
    knowledge: ImuPrior = CALIBRATED,
    symmetric_load: bool = False,
) -> JointRegression:
    """Fit the model of `joint_model` to all motions of one joint, and what the IMU read at rest.

    Args:
        motions, rest: what the IMU and the joint's module sampled.
        knowledge: of the IMU.
        symmetric_load: what the link carries lies in the plane of the motion, as in a trial of a single
            joint. Else the covariance holds how much a load off that plane may bend and twist the link.

    Raises:
        DataError: no motion, too few samples of one, an IMU that did not move with the joint, or one whose
            readings no motion of the joint explains.
    """
    problem, guess = _problem(motions, rest, knowledge)
    state, covariance = _minimise(problem, guess)
    with _diverging():
        found = _result(state, covariance, problem, _systematic(state, covariance, problem, symmetric_load))
        # What is singular along the axis has an eigenvalue of zero, give or take its rounding.
        least, *_, largest = np.linalg.eigvalsh(found.covariance)
    if not (least >= -_ROUNDING * largest and found.sigma_distance_m < _MAX_SIGMA_M):
        raise DataError(_DIVERGES)
    return found


def distance_bound_m(
    motions: Sequence[ObservedMotion],
    rest: RestReading | None,
    knowledge: ImuPrior,
    noise: tuple[float, float],
) -> float:
    """Return the Cramer-Rao bound of the radial distance for white noise of gyro and accelerometer [SI].

    Every other parameter of `regress_joint` is unknown here too, except the place of a bent link's hinge. The
    motions are taken as given: smooth them as little as the encoder's noise allows.

    Raises:
        DataError: as `regress_joint`.
    """
    problem, guess = _problem(motions, rest, knowledge)
    state, _ = _minimise(problem, guess)
    normal = _equations(problem, state, np.array(noise)).normal
    known = np.arange(len(normal)) != HINGE
    covariance = np.zeros_like(normal)
    with _diverging():
        covariance[np.ix_(known, known)] = np.linalg.inv(normal[np.ix_(known, known)])
    return _result(state, covariance, problem, np.zeros((6, 6))).sigma_distance_m


def _minimise(problem: _Problem, state: _State) -> tuple[_State, Array]:
    """Return the optimum of the fit, and the covariance of the parameters.

    Raises:
        DataError: there is none, or its variances are not positive.
    """
    noise = np.array([1e-3, 2e-2])
    with _diverging():
        for _ in range(ITERATIONS):
            at = _equations(problem, state, noise)
            step = np.asarray(np.linalg.solve(at.normal, at.gradient), dtype=np.float64)
            state, noise = _moved(state, step), at.noise
            if np.all(np.abs(step) * np.sqrt(np.diag(at.normal)) <= SETTLED):
                break
        end = _equations(problem, state, noise)
        inverse = np.linalg.inv(end.normal)
        covariance = inverse @ end.scatter @ inverse.T
    if not (np.isfinite(covariance).all() and (np.diag(covariance) >= 0.0).all()):
        raise DataError(_DIVERGES)
    return state, covariance


@contextmanager
def _diverging() -> Iterator[None]:
    """Say so where a fit diverges: a sensor at the end of its range can take it anywhere."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except np.linalg.LinAlgError as error:
        raise DataError(_DIVERGES) from error


def _problem(
    motions: Sequence[ObservedMotion], rest: RestReading | None, knowledge: ImuPrior
) -> tuple[_Problem, _State]:
    """Return the problem, and a first guess of its solution."""
    if not motions:
        raise DataError("no motion of the joint: at least one is needed")
    rows = [_rows(motion) for motion in motions]
    mean, weight = parameter_priors(knowledge, len(motions))
    guess = _first_guess(rows, mean)
    bases = [motion.base for motion in motions if motion.base is not None]
    unresolved_m = 0.0
    if len(bases) == len(motions) and any(base.shakes for base in bases):
        across, housing = guess.values[GRAVITY][:2], bases[-1].gravity
        if min(np.hypot(*across), np.hypot(*housing)) < MIN_ACROSS_M_S2:
            # The longest motion is the most accurate; half a push of unknown direction is along the radius.
            unresolved_m = max(bases, key=lambda base: base.end_s - base.start_s).push_m / np.sqrt(2.0)
            bases = [base.about_the_axis() for base in bases]
            # The base's heading then turns only the pivot, whose prior is the same in all directions. Left
            # free it makes the steps oscillate about the optimum.
            weight[BASE_HEADING] = PINNED
        else:
            guess.values[BASE_HEADING] = np.arctan2(across[1], across[0]) - np.arctan2(housing[1], housing[0])
            mean[BASE_HEADING] = guess.values[BASE_HEADING]
        rows = [r._replace(motion=Motion(r.motion.joint, b)) for r, b in zip(rows, bases, strict=True)]
    return _Problem(tuple(rows), mean, weight, rest, float(unresolved_m)), guess


def _rows(observed: ObservedMotion) -> _Rows:
    since_ns = observed.imu.t_ns - observed.offset_ns - observed.joint.origin_ns
    t_s = since_ns.astype(np.float64) * 1e-9
    # 10 ms at either end leave room for the delay to change.
    begin, end = observed.joint.start_s + 0.01, observed.joint.end_s - 0.01
    step_s = 1e-9 * float(observed.imu.t_ns[-1] - observed.imu.t_ns[0]) / (observed.imu.t_ns.size - 1)
    # Every seventh of 250 Hz.
    stride = max(1, round(SMOOTH_S / step_s))
    inside = np.flatnonzero((t_s > begin) & (t_s < end))[::stride]
    if inside.size < 20:
        raise DataError(f"{inside.size} IMU samples fall into the joint's motion: at least 20 are needed")
    readings = np.hstack([observed.imu.gyro_rad_s[inside], observed.imu.accel_m_s2[inside]])
    white = white_ratio(observed.imu.t_ns, float(np.hypot(observed.imu.smooth_s, stride * step_s)))
    # The sum of the correlations exp(-(lag / 2 s)^2) of white noise behind a Gaussian of deviation s.
    repeats = 2.0 * np.sqrt(np.pi) * observed.imu.smooth_s / (stride * step_s)
    moved = observed.joint.values(t_s[inside])
    rate2_s2 = float(np.mean(moved[:, 1] ** 2) / max(np.mean(moved[:, 0] ** 2), np.finfo(float).tiny))
    return _Rows(
        Motion(observed.joint, None),
        readings,
        t_s[inside],
        white,
        stride,
        repeats,
        rate2_s2,
        observed.instrument,
    )


def _first_guess(rows: Sequence[_Rows], mean: Array) -> _State:
    """Solve the model without compliance, delay and sensor errors, where it is linear."""
    values = np.concatenate([row.motion.joint.values(row.t_s) for row in rows])
    readings = np.concatenate([row.readings for row in rows])
    rate, acceleration = values[:, 0], values[:, 1]
    cosine, sine, squared = values[:, COSINE], values[:, SINE], values[:, SQUARED]
    one = np.ones_like(rate)
    gyro = np.linalg.lstsq(np.stack([rate, one], axis=1), readings[:, :3], rcond=None)[0]
    size = float(np.linalg.norm(gyro[0]))
    if size < MIN_RATE_SHARE:
        raise DataError(
            f"the gyro turned by {size:.2g} of what the joint did: this IMU does not move with it"
        )
    axis = gyro[0] / size
    columns = np.stack([one, cosine, sine, acceleration, squared], axis=1)
    force = np.linalg.lstsq(columns, readings[:, 3:], rcond=None)[0]
    radial = np.cross(force[3], axis)
    # Across the axis, from the cosine's and the sine's coefficients alike.
    gravity = 0.5 * (force[1] + np.cross(axis, force[2]))
    frame = _frame(axis)
    guess = mean.copy()
    guess[RADIAL], guess[GRAVITY] = (frame.T @ radial)[:2], frame.T @ gravity
    guess[GRAVITY_ALONG] = axis @ force[0]
    guess[GYRO_BIAS] = frame.T @ gyro[1]
    return _State(frame, guess)


def _frame(axis: Array) -> Array:
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(axis, across), axis], axis=1)


def _equations(problem: _Problem, state: _State, noise: Array) -> _Equations:
    """Set up the normal equations at a state, for noise of one sample (gyro, accel)."""
    normal = np.diag(problem.weight)
    gradient = problem.weight * (problem.mean - state.values)
    _add_gravity(normal, gradient, state)
    if problem.rest is not None:
        _add_rest(normal, gradient, problem.rest, state)
    scatter = normal.copy()
    power, count = np.zeros(2), 0
    for i, row in enumerate(problem.rows):
        predicted, slopes = predict(row.motion, row.t_s, state.values, DELAY + i)
        residual = _in_frame(row.readings, state.frame) - predicted
        weighing = slopes
        if row.instrument is not None:
            clean = row.motion._replace(joint=row.instrument)
            _, weighing = predict(clean, row.t_s, state.values, DELAY + i)
        for sensor in range(2):
            part = slice(3 * sensor, 3 * sensor + 3)
            weight = row.stride / noise[sensor] ** 2
            squares = row.white * _slow(residual[:, part]) ** 2
            square = squares.mean(axis=1)
            alike = samples_per_independent(residual[:, part, None], MAX_LAG) / row.repeats
            by_weight, by_slope = _flat(weighing[:, part]), _flat(slopes[:, part])
            normal += weight * by_weight.T @ by_slope
            gradient += weight * by_weight.T @ residual[:, part].ravel()
            uneven = by_weight * (squares * np.maximum(alike, 1.0) / noise[sensor] ** 2).reshape(-1, 1)
            scatter += weight * uneven.T @ by_weight
            power[sensor] += float(square.sum())
        count += len(residual)
    return _Equations(normal, gradient, scatter, np.asarray(np.sqrt(power / count)))


def _flat(slopes: Array) -> Array:
    return slopes.reshape(-1, slopes.shape[2])


def _slow(residual: Array) -> Array:
    """Return residuals (n, k) through a binomial low-pass, nearly a Gaussian, that takes no motion away.

    Beyond the motion's frequencies are rounded encoder counts and links that ring.
    """
    padded = np.pad(residual, ((2, 2), (0, 0)), mode="reflect")
    return np.asarray(
        (padded[:-4] + 4.0 * padded[1:-3] + 6.0 * padded[2:-2] + 4.0 * padded[3:-1] + padded[4:]) / 16.0
    )


def _add_gravity(normal: Array, gradient: Array, state: _State) -> None:
    """Add the prior of gravity's magnitude."""
    size = float(np.linalg.norm(state.values[GRAVITY]))
    along = state.values[GRAVITY] / size
    normal[GRAVITY, GRAVITY] += np.outer(along, along) / GRAVITY_SIGMA_M_S2**2
    gradient[GRAVITY] += along * (GRAVITY_M_S2 - size) / GRAVITY_SIGMA_M_S2**2


def _add_rest(normal: Array, gradient: Array, rest: RestReading, state: _State) -> None:
    """Add the gyro's reading at rest: its bias and its response to gravity."""
    force = state.frame.T @ rest.specific_force_m_s2
    slopes = np.zeros((3, len(gradient)))
    slopes[:, GYRO_BIAS] = np.eye(3)
    slopes[:, G_SENSITIVITY] = g_sensitivity_columns(force[None, :2])[0]
    predicted = slopes @ state.values
    slopes[:, TURN] = np.cross(np.eye(3)[:2], predicted).T
    error = state.frame.T @ rest.gyro_offset_rad_s - predicted
    variance = rest.gyro_scatter_rad_s**2 / rest.samples + GYRO_BIAS_DRIFT_RAD_S**2
    normal += slopes.T @ slopes / variance
    gradient += slopes.T @ error / variance


def _in_frame(readings: Array, frame: Array) -> Array:
    return np.hstack([readings[:, :3] @ frame, readings[:, 3:] @ frame])


def _moved(state: _State, step: Array) -> _State:
    """Apply a step: change the values, and turn the frame by the step's turn."""
    values = state.values + step
    turn = np.array([step[0], step[1], 0.0])
    values[TURN] = 0.0
    return _State(state.frame @ Rotation.from_rotvec(turn).as_matrix(), values)


def _systematic(state: _State, covariance: Array, problem: _Problem, symmetric_load: bool) -> Array:
    """Return the covariance (6, 6) of axis and radial vector by what the model leaves out."""
    p, frame = state.values, state.frame
    across, radial = frame[:, :2] @ frame[:, :2].T, frame[:, :2] @ p[RADIAL]
    compliance_s2 = abs(p[COMPLIANCE]) + float(np.sqrt(covariance[COMPLIANCE, COMPLIANCE]))
    # A load off the plane of the motion bends and twists the link across it, which no motion tells: as
    # much as gravity bends it within the plane. What bends moves the IMU by an unknown part of it: slope and
    # place of a beam's end answer differently to forces and to moments.
    bent_rad = compliance_s2 * GRAVITY_M_S2 / max(float(np.hypot(*p[RADIAL])), MIN_DISTANCE_M)
    swung = 0.5 * compliance_s2 * max(row.rate2_s2 for row in problem.rows)
    systematic = np.zeros((6, 6))
    systematic[3:, 3:] = problem.unresolved_m**2 * across
    if not symmetric_load:
        systematic[:3, :3] = bent_rad**2 * across
        systematic[3:, 3:] += swung**2 * np.outer(radial, radial)
    return systematic


def _result(state: _State, covariance: Array, problem: _Problem, systematic: Array) -> JointRegression:
    p, frame = state.values, state.frame
    r1, r2 = p[RADIAL]
    distance = float(np.hypot(r1, r2))
    # The axis turns by u x j and carries the radial vector along by u x r.
    gain = np.zeros((6, p.size))
    gain[:3, :2] = np.stack([-frame[:, 1], frame[:, 0]], axis=1)
    gain[3:, :2] = np.outer(frame[:, 2], [r2, -r1])
    gain[3:, RADIAL] = frame[:, :2]
    six = gain @ covariance @ gain.T
    six += systematic
    radial = frame[:, :2] @ p[RADIAL]
    along = radial / max(distance, 1e-6)
    return JointRegression(
        axis=frozen(frame[:, 2]),
        radial_m=frozen(radial),
        distance_m=distance,
        sigma_axis_rad=float(np.sqrt(0.5 * np.trace(six[:3, :3]))),
        sigma_distance_m=float(np.sqrt(along @ six[3:, 3:] @ along)),
        covariance=frozen(six),
        gravity_m_s2=frozen(frame @ p[GRAVITY]),
        accel_bias_m_s2=frozen(frame @ p[ACCEL_BIAS]),
        gyro_bias_rad_s=frozen(frame @ p[GYRO_BIAS]),
        compliance_s2=float(p[COMPLIANCE]),
        delays_s=tuple(float(x) for x in p[DELAY:]),
        samples=sum(len(row.t_s) for row in problem.rows),
        base_shakes=any(row.motion.base is not None for row in problem.rows),
    )

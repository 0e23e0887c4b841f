"""The axis of a joint and the lever arms of the IMUs on both sides of it, without an encoder.

Two IMUs ride on the two sides of a revolute joint. In the frame of IMU i let j_i be the unit axis, r_i the
lever arm from a point on the axis to the IMU, w_i the rate and f_i the specific force. The joint turns side
2 against side 1 about +j with the angle q. Then

    w_2 = R w_1 + dq/dt j_2,                    dq/dt = w_2 . j_2 - w_1 . j_1                       (gyros)
    h_2 = R h_1,      h_i = f_i - dw_i/dt x r_i - w_i x (w_i x r_i)                        (accelerometers)

with R = F_2 Rz(-q) F_1^T, F_i = (x_i, y_i, j_i) an orthonormal frame. h_i is the specific force of the point
on the axis, which belongs to both sides. The norms of both equations are the constraints of Seel, Schauer
and Raisch, Joint axis and position estimation from inertial measurement data by exploiting kinematic
constraints, 2012 (also Seel, Raisch and Schauer, IMU-based joint angle measurement for gait analysis,
Sensors 14, 2014):

    |w_1 x j_1| = |w_2 x j_2|,                  |h_1| = |h_2|.

They hold for any signs of j_1 and j_2. The directions, which are used here too, decide the sign of j_2
against j_1; the sign of both together is a convention of what counts as positive.

The first constraint, from several starts, gives the axes but for signs. For both signs and a grid of angles
the lever arms follow linearly; the best of these are refined together with the biases of gyros and
accelerometers, which have priors. Signals are low-passed, and thinned to about independent samples.
Directions that the motion does not resolve are found from the information matrix with the biases eliminated,
and named: the point on the axis is always arbitrary along it; with side 1 at rest its lever arm and its
heading about gravity are, too.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import ACCEL_BIAS_SIGMA_M_S2, GYRO_BIAS_SIGMA_RAD_S
from module_agent.model.read_only import frozen
from module_agent.signals.autocorrelation import samples_per_independent
from module_agent.signals.filtering import differentiate, settling_samples, zero_phase_low_pass

# The unknowns in the order of `ImuLink.covariance`: turns of the axes about x and y of their frames [rad],
# the angle at the first sample [rad], the lever arms along x, y and the axis of their frames [m].
PARAMETERS = (
    *("axis_1 about x", "axis_1 about y", "axis_2 about x", "axis_2 about y", "angle"),
    *("arm_1 along x", "arm_1 along y", "arm_1 along the axis"),
    *("arm_2 along x", "arm_2 along y", "arm_2 along the axis"),
)
CUTOFF_HZ = 12.0
# A direction with a larger sigma (rad or m) is not resolved: a turn of 6 deg, a tenth of a metre.
UNRESOLVED_ABOVE = 0.1
# Share of a parameter within the null space above which its own sigma says nothing.
_HIDDEN_ABOVE = 0.05
# The cosine between a named direction and the null space above which they are the same.
_SAME_ABOVE = 0.995
_MIN_SAMPLES = 50
# Less than this (rms) and the joint has not turned.
_MIN_RATE_RAD_S = 0.05
_STARTS, _ANGLES, _REFINED = 12, 24, 3
_GEOMETRY, _ANGLE = len(PARAMETERS), PARAMETERS.index("angle")
_FIRST_SIGMAS = 0.01, 0.1
_MAX_LAG_S = 2.0
# So many times the information that noise feigns is not counted as information.
_NOISE_MARGIN = 2.0


class ImuLink(NamedTuple):
    """A revolute joint as two IMUs show it; arrays read-only, indices 1 and 2 are the IMUs.

    axis_1, axis_2: (3,) unit axis in each IMU's frame, about which side 2 turns against side 1 when the angle
        grows; the largest component of axis_1 is positive.
    arm_1_m, arm_2_m: (3,) from one point on the axis to the IMU, in its frame. distances_m: (2,) of the IMUs
        from the axis.
    rotation: (3, 3) of vectors from the frame of IMU 1 to that of IMU 2 at the first of `t_s`.
    t_s, angle_rad: (m,) the joint's angle since then.
    frame_1, frame_2: (3, 3) with the columns x, y, axis, to which the covariance refers.
    covariance: (11, 11) of `PARAMETERS`, zero along what is not resolved. null_basis: (11, k) orthonormal
        directions that the motion does not resolve; `unresolved` names them.
    sigma_axis_rad, sigma_distance_m: (2,); sigma_arm_m: (2, 3) along x, y and axis of the frames;
        sigma_angle_rad: of the angle at the first sample. inf where unresolved.
    residual_gyro_rad_s, residual_accel_m_s2: rms per component.
    opposite_sign_misfit: rms residual with axis_2 reversed over that of the result; near 1 the relative sign
        of the axes is not determined.
    """

    axis_1: Array
    axis_2: Array
    arm_1_m: Array
    arm_2_m: Array
    distances_m: Array
    rotation: Array
    t_s: Array
    angle_rad: Array
    frame_1: Array
    frame_2: Array
    covariance: Array
    null_basis: Array
    unresolved: tuple[str, ...]
    sigma_axis_rad: Array
    sigma_arm_m: Array
    sigma_distance_m: Array
    sigma_angle_rad: float
    residual_gyro_rad_s: float
    residual_accel_m_s2: float
    opposite_sign_misfit: float


class _Signals(NamedTuple):
    """Low-passed samples of both IMUs, (2, m, 3), about independent; `turned`: the rates' integral."""

    t_s: Array
    rate: Array
    acceleration: Array
    turned: Array
    force: Array


class _State(NamedTuple):
    """frames (2, 3, 3), and all parameters: geometry (11, turns zero), gyro and accelerometer biases (12)."""

    frames: Array
    values: Array


def link_from_imus(
    t_s: ArrayLike,
    gyro_1_rad_s: ArrayLike,
    accel_1_m_s2: ArrayLike,
    gyro_2_rad_s: ArrayLike,
    accel_2_m_s2: ArrayLike,
    cutoff_hz: float = CUTOFF_HZ,
    gyro_bias_rad_s: float = GYRO_BIAS_SIGMA_RAD_S,
    accel_bias_m_s2: float = ACCEL_BIAS_SIGMA_M_S2,
) -> ImuLink:
    """Estimate axis, lever arms and relative rotation of a joint from one IMU on either side of it.

    Either side may move in any way; the more side 1 turns as well, the more is resolved.

    Args:
        t_s: (m,) uniform times [s], common to both IMUs.
        gyro_1_rad_s, accel_1_m_s2: (m, 3) rates and specific forces of the IMU on side 1, in its frame.
        gyro_2_rad_s, accel_2_m_s2: (m, 3) of the IMU on side 2, in its frame.
        cutoff_hz: of the low-pass; three times the fastest motion or more.
        gyro_bias_rad_s, accel_bias_m_s2: prior standard deviations of the biases, which are zero on average.

    Raises:
        DataError: too few samples, or the joint hardly turned.
        ValueError: shapes that do not fit, values that are not finite, times that are not uniform.
    """
    signals = _signals(t_s, (gyro_1_rad_s, gyro_2_rad_s), (accel_1_m_s2, accel_2_m_s2), cutoff_hz)
    priors = np.repeat([gyro_bias_rad_s, accel_bias_m_s2], 6)
    return _described(signals, _best(signals, priors), priors)


def _signals(
    t_s: ArrayLike, gyros: tuple[ArrayLike, ...], accels: tuple[ArrayLike, ...], cutoff_hz: float
) -> _Signals:
    t = np.asarray(t_s, dtype=float)
    rates, forces = (np.stack([np.asarray(a, dtype=float) for a in two]) for two in (gyros, accels))
    if t.ndim != 1 or rates.shape != (2, t.size, 3) or forces.shape != rates.shape:
        raise ValueError(f"t_s has shape {t.shape}; gyros and accelerometers must have ({t.size}, 3) each")
    if not (np.isfinite(t).all() and np.isfinite(rates).all() and np.isfinite(forces).all()):
        raise ValueError("t_s, gyros or accelerometers hold a value that is not finite")
    if t.size < _MIN_SAMPLES:
        raise DataError(f"{t.size} samples of two IMUs: at least {_MIN_SAMPLES} are needed")
    step_s = float(t[-1] - t[0]) / (t.size - 1)
    if not np.abs(np.diff(t) - step_s).max() < 0.1 * step_s:
        raise ValueError("t_s is not uniform and increasing: resample to a common time base first")
    rate_hz = 1.0 / step_s
    edge, step = settling_samples(rate_hz, cutoff_hz), max(1, int(0.5 * rate_hz / cutoff_hz))
    if t.size < 2 * edge + _MIN_SAMPLES * step:
        raise DataError(
            f"{t.size} samples at {rate_hz:.0f} Hz: behind a low-pass of {cutoff_hz:.0f} Hz at least "
            f"{2 * edge + _MIN_SAMPLES * step} are needed"
        )
    smooth, force = (
        np.stack([zero_phase_low_pass(a, rate_hz, cutoff_hz) for a in two]) for two in (rates, forces)
    )
    acceleration = np.stack([differentiate(w, rate_hz) for w in smooth])
    kept = slice(edge, t.size - edge)
    turned = cumulative_trapezoid(smooth[:, kept], dx=step_s, axis=1, initial=0.0)
    part = slice(edge, t.size - edge, step)
    moved = float(np.sqrt(smooth[:, kept].var(axis=1).sum(axis=1).mean()))
    if moved < _MIN_RATE_RAD_S:
        raise DataError(f"the IMUs turned at {moved:.2g} rad/s rms; {_MIN_RATE_RAD_S} are needed")
    return _Signals(t[part], smooth[:, part], acceleration[:, part], turned[:, ::step], force[:, part])


def _predicted(signals: _Signals, state: _State) -> tuple[Array, Array, Array]:
    """Return the residuals of gyros (m, 2) and accelerometers (m, 3) in the joint's frame, and q (m,)."""
    values = state.values
    frames = [
        frame @ Rotation.from_rotvec([*values[2 * i : 2 * i + 2], 0.0]).as_matrix()
        for i, frame in enumerate(state.frames)
    ]
    biases = values[_GEOMETRY:].reshape(2, 2, 3)  # gyros, accelerometers
    since = signals.t_s - signals.t_s[0]
    rates, points, axial = [], [], []
    for i, frame in enumerate(frames):
        rate = (signals.rate[i] - biases[0, i]) @ frame
        alpha, arm = signals.acceleration[i] @ frame, values[5 + 3 * i : 8 + 3 * i]
        force = (signals.force[i] - biases[1, i]) @ frame
        points.append(force - np.cross(alpha, arm) - np.cross(rate, np.cross(rate, arm)))
        rates.append(rate)
        axial.append((signals.turned[i] - since[:, None] * biases[0, i]) @ frame[:, 2])
    angle = values[4] + axial[1] - axial[0]
    gyro = (rates[1] - _turned_back(rates[0], angle))[:, :2]
    return gyro, points[1] - _turned_back(points[0], angle), angle


def _turned_back(vectors: Array, angle: Array) -> Array:
    """Return Rz(-angle) v, (m, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([c * x + s * y, c * y - s * x, z], axis=1)


def _weighted(signals: _Signals, state: _State, sigmas: tuple[float, float], priors: Array) -> Array:
    gyro, accel, _ = _predicted(signals, state)
    known = state.values[_GEOMETRY:] / priors
    return np.concatenate([gyro.ravel() / sigmas[0], accel.ravel() / sigmas[1], known])


def _rms(signals: _Signals, state: _State) -> tuple[float, float]:
    gyro, accel, _ = _predicted(signals, state)
    return max(float(np.sqrt(np.mean(gyro**2))), 1e-9), max(float(np.sqrt(np.mean(accel**2))), 1e-9)


def _misfit(signals: _Signals, state: _State) -> float:
    gyro, accel = _rms(signals, state)
    return float(np.hypot(gyro / _FIRST_SIGMAS[0], accel / _FIRST_SIGMAS[1]))


def _best(signals: _Signals, priors: Array) -> _State:
    """Return the best fit from all starts, with both signs of axis_2 against axis_1."""
    guesses = [
        _arms(signals, _frame(first), _frame(sign * second))
        for first, second in _axes(signals)
        for sign in (1.0, -1.0)
    ]
    guesses.sort(key=lambda guess: guess[0])
    fits = [_refined(signals, state, _FIRST_SIGMAS, priors) for _, state in guesses[:_REFINED]]
    best = min(fits, key=lambda state: _misfit(signals, state))
    return _refined(signals, best, _rms(signals, best), priors)


def _axes(signals: _Signals) -> list[tuple[Array, Array]]:
    """Return pairs of axes that satisfy |w_1 x j_1| = |w_2 x j_2|, from several starts, with any signs."""
    first, second = signals.rate - signals.rate.mean(axis=1, keepdims=True)

    def axes(x: Array) -> Array:
        two = x.reshape(2, 3)
        return np.asarray(two / np.linalg.norm(two, axis=1, keepdims=True))

    def residual(x: Array) -> Array:
        j = axes(x)
        across = np.linalg.norm(np.cross([first, second], j[:, None]), axis=2)
        # The length of x is not an unknown: it is held at one.
        return np.concatenate([across[0] - across[1], np.linalg.norm(x.reshape(2, 3), axis=1) - 1.0])

    starts = np.random.default_rng(0).normal(size=(_STARTS, 6))
    fits = [least_squares(residual, axes(start).ravel(), max_nfev=50) for start in starts]
    fits.sort(key=lambda fit: float(fit.cost))
    pairs: list[tuple[Array, Array]] = []
    for fit in fits:
        j = axes(fit.x)
        if not any(abs(j[0] @ a) > 0.99 and abs(j[1] @ b) > 0.99 for a, b in pairs):
            pairs.append((j[0], j[1]))
    return pairs


def _frame(axis: Array) -> Array:
    """Return an orthonormal frame (3, 3) whose third column is the axis."""
    x = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _arms(signals: _Signals, frame_1: Array, frame_2: Array) -> tuple[float, _State]:
    """Return the best state on a grid of angles, with lever arms by linear least squares, and its misfit."""
    frames = np.stack([frame_1, frame_2])
    trials = []
    for angle in np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False):
        values = np.zeros(_GEOMETRY + 12)
        values[4] = angle
        at_zero = _predicted(signals, _State(frames, values))[1].ravel()
        ones = [_State(frames, values + one) for one in np.eye(len(values))[5:_GEOMETRY]]
        columns = [_predicted(signals, one)[1].ravel() - at_zero for one in ones]
        values[5:_GEOMETRY] = np.linalg.lstsq(np.stack(columns, axis=1), -at_zero, rcond=1e-6)[0]
        state = _State(frames, values)
        trials.append((_misfit(signals, state), state))
    return min(trials, key=lambda trial: trial[0])


def _refined(signals: _Signals, state: _State, sigmas: tuple[float, float], priors: Array) -> _State:
    fit = least_squares(
        lambda x: _weighted(signals, _State(state.frames, x), sigmas, priors),
        state.values,
        x_scale=np.r_[np.full(_GEOMETRY, 0.1), priors],
        xtol=1e-10,
        max_nfev=40,
    )
    # Turns of the axes go into the frames, which then are the new reference.
    values = np.asarray(fit.x).copy()
    turns = Rotation.from_rotvec(np.c_[values[:4].reshape(2, 2), np.zeros(2)]).as_matrix()
    values[:4] = 0.0
    return _State(state.frames @ turns, values)


def _described(signals: _Signals, state: _State, priors: Array) -> ImuLink:
    state = _conventional(state)
    opposite, _ = _arms(signals, state.frames[0], state.frames[1] * np.array([1.0, -1.0, -1.0]))
    covariance, null_basis = _covariance(signals, state, priors)
    angle = _predicted(signals, state)[2]
    arms = state.values[5:_GEOMETRY].reshape(2, 3)
    distance = np.linalg.norm(arms[:, :2], axis=1)
    slopes = np.zeros((2, _GEOMETRY))
    for i in range(2):
        slopes[i, 5 + 3 * i : 7 + 3 * i] = arms[i, :2] / max(distance[i], 1e-12)
    single = np.array([_sigma(row, covariance, null_basis) for row in np.eye(_GEOMETRY)])
    first, second = state.frames
    gyro, accel = _rms(signals, state)
    return ImuLink(
        axis_1=frozen(first[:, 2]),
        axis_2=frozen(second[:, 2]),
        arm_1_m=frozen(first @ arms[0]),
        arm_2_m=frozen(second @ arms[1]),
        distances_m=frozen(distance),
        rotation=frozen(second @ Rotation.from_rotvec([0.0, 0.0, -angle[0]]).as_matrix() @ first.T),
        t_s=frozen(signals.t_s),
        angle_rad=frozen(angle - angle[0]),
        frame_1=frozen(first),
        frame_2=frozen(second),
        covariance=frozen(covariance),
        null_basis=frozen(null_basis),
        unresolved=_named(null_basis),
        sigma_axis_rad=frozen(np.hypot(single[[0, 2]], single[[1, 3]])),
        sigma_arm_m=frozen(single[5:].reshape(2, 3)),
        sigma_distance_m=frozen([_sigma(row, covariance, null_basis) for row in slopes]),
        sigma_angle_rad=float(single[4]),
        residual_gyro_rad_s=gyro,
        residual_accel_m_s2=accel,
        opposite_sign_misfit=opposite / _misfit(signals, state),
    )


def _conventional(state: _State) -> _State:
    """Return the state with the largest component of axis_1 positive: both axes and the angle change sign."""
    axis = state.frames[0, :, 2]
    if axis[int(np.argmax(np.abs(axis)))] > 0.0:
        return state
    # Half a turn about x, of frames and of what is expressed in them.
    values = state.values.copy()
    values[4] = -values[4]
    values[[6, 7, 9, 10]] *= -1.0
    return _State(state.frames * np.array([1.0, -1.0, -1.0]), values)


def _covariance(signals: _Signals, state: _State, priors: Array) -> tuple[Array, Array]:
    """Return the covariance (11, 11) of what is resolved, and a basis (11, k) of what is not."""
    gyro, accel, _ = _predicted(signals, state)
    lag = int(_MAX_LAG_S / float(signals.t_s[1] - signals.t_s[0]))
    repeats = [float(samples_per_independent(r, lag)) for r in (np.c_[gyro, np.zeros(len(gyro))], accel)]
    rms = _rms(signals, state)
    sigmas = rms[0] * float(np.sqrt(repeats[0])), rms[1] * float(np.sqrt(repeats[1]))
    steps = np.r_[np.full(_GEOMETRY, 1e-5), 1e-3 * priors]

    def residual(values: Array) -> Array:
        return _weighted(signals, _State(state.frames, values), sigmas, priors)

    ends = [(residual(state.values + step), residual(state.values - step)) for step in np.diag(steps)]
    jacobian = np.stack(
        [(ahead - behind) / (2.0 * s) for (ahead, behind), s in zip(ends, steps, strict=True)], 1
    )
    information = jacobian.T @ jacobian
    geometry, cross = information[:_GEOMETRY, :_GEOMETRY], information[:_GEOMETRY, _GEOMETRY:]
    through = np.linalg.solve(information[_GEOMETRY:, _GEOMETRY:], cross.T)
    reduced = geometry - cross @ through
    reduced -= np.diag(_NOISE_MARGIN * _noise_information(signals, rms, sigmas))
    values, vectors = np.linalg.eigh(0.5 * (reduced + reduced.T))
    resolved = values > UNRESOLVED_ABOVE**-2
    covariance = (vectors[:, resolved] / values[resolved]) @ vectors[:, resolved].T
    rows = jacobian[:, :_GEOMETRY] - jacobian[:, _GEOMETRY:] @ through
    drift = covariance @ _drift(signals, rows, jacobian[:, _ANGLE], rms[0])
    return covariance + drift @ drift.T, vectors[:, ~resolved]


def _drift(signals: _Signals, rows: Array, by_angle: Array, gyro_rad_s: float) -> Array:
    """Return J^T W e (11, m) of the random walk that the gyros' noise makes of the integrated angle.

    One column for each step of the walk, one standard deviation of it: a step shifts all later angles. It is
    counted in the covariance, but not estimated (Schmidt's consider parameters).
    """
    m, step_s = signals.t_s.size, float(signals.t_s[1] - signals.t_s[0])
    gyro, accel = np.split((rows * by_angle[:, None])[: 5 * m], [2 * m])
    each = gyro.reshape(m, 2, -1).sum(axis=1) + accel.reshape(m, 3, -1).sum(axis=1)
    return np.asarray(gyro_rad_s * step_s * np.cumsum(each[::-1], axis=0)[::-1].T)


def _noise_information(signals: _Signals, rms: tuple[float, float], sigmas: tuple[float, float]) -> Array:
    """Return the information (11,) that noise feigns about the parameters, as if it were motion.

    A turn of a noisy vector, or a lever arm across a noisy angular acceleration, shows in two components of a
    residual, which has the noise of two sensors. White noise s up to a frequency f differentiates to
    2 pi f s / sqrt(3).
    """
    gyro, accel = (value / np.sqrt(2.0) for value in rms)
    band_hz = 0.5 / float(signals.t_s[1] - signals.t_s[0])
    acceleration = 2.0 * np.pi * band_hz * gyro / np.sqrt(3.0)
    turned = (gyro / sigmas[0]) ** 2 + (accel / sigmas[1]) ** 2
    arms = (acceleration / sigmas[1]) ** 2
    return np.asarray(2.0 * signals.t_s.size * np.r_[np.full(5, turned), np.full(6, arms)])


def _sigma(slope: Array, covariance: Array, null_basis: Array) -> float:
    """Return one standard deviation of a linear function of the parameters; inf if it is not resolved."""
    hidden = float(np.linalg.norm(null_basis.T @ slope)) > _HIDDEN_ABOVE * float(np.linalg.norm(slope))
    return float("inf") if hidden else float(np.sqrt(slope @ covariance @ slope))


def _named(null_basis: Array) -> tuple[str, ...]:
    """Name the null space: single parameters, the point on the axis, and combinations of what is left."""
    along = (PARAMETERS.index("arm_1 along the axis"), PARAMETERS.index("arm_2 along the axis"))
    candidates = dict(zip(PARAMETERS, np.eye(_GEOMETRY), strict=True))
    candidates["the point on the axis, along it"] = np.eye(_GEOMETRY)[list(along)].sum(axis=0) / np.sqrt(2.0)
    names, left = [], null_basis
    for name, direction in candidates.items():
        if float(np.linalg.norm(left.T @ direction)) > _SAME_ABOVE:
            names.append(name)
            rest = left - np.outer(direction, direction @ left)
            u, s, _ = np.linalg.svd(rest, full_matrices=False)
            left = u[:, s > 0.5]
    for column in left.T:
        parts = [name for name, share in zip(PARAMETERS, column, strict=True) if abs(share) > 0.2]
        names.append("a combination of " + ", ".join(parts))
    return tuple(names)

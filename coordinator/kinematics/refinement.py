"""One batch refinement of a chain over all motions at once, from all IMUs and all encoders.

The circle point analysis takes it that only one joint moves. In a real arm the springs of the held joints
give, so that distal IMUs turn by more than the moving joint does (up to 50 % more near a resonance), and
the circles come out wrong. Here every IMU sample is predicted from the measured motion of all joints
(`inertial_prediction`), so what the held joints do is part of the model. Solved by Gauss-Newton on the
normal equations; gravity and the biases are estimated along.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.chain import Array, Chain
from coordinator.kinematics.increments import apply_increment, frozen
from coordinator.kinematics.inertial_prediction import body_motions, imu_readings
from coordinator.kinematics.inertial_slopes import imu_slopes

ITERATIONS = 12
CONVERGED = 1e-7
# What the data knows worse than this (in rad, or in m) it does not know: a turn of 6 deg, a tenth of a metre.
UNKNOWN_ABOVE = 0.1
# What the data sheets of this class of IMU allow as a bias, one standard deviation; it keeps apart what the
# motions cannot: an accelerometer's bias and gravity where the IMU never turns.
GYRO_BIAS_RAD_S = 0.05
ACCEL_BIAS_M_S2 = 0.2
# Finer than any sensor resolves (rad/s, m/s^2). Smaller weights would drown the biases' prior in rounding.
FINEST = 1e-6

Index = NDArray[np.int64]


class SensorData(NamedTuple):
    """Samples of all joints and IMUs on one time base and through one low-pass, m samples of n modules.

    q_rad, qd_rad_s, qdd_rad_s2: (m, n). gyro_rad_s, accel_m_s2: (m, n, 3) in the IMU frames. The samples are
    far enough apart for their errors to be independent.
    """

    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    gyro_rad_s: Array
    accel_m_s2: Array


class Refinement(NamedTuple):
    """A refined chain; increments are as in `increments`, of all n modules (the first one's are zero).

    covariance: (6 n, 6 n), zero along what is unknown. null_basis: (6 n, k) orthonormal directions that the
    data does not know. residual_gyro_rad_s, residual_accel_m_s2: (n,) rms per axis. Biases: (n, 3).
    """

    chain: Chain
    covariance: Array
    null_basis: Array
    rank: int
    condition: float
    residual_gyro_rad_s: Array
    residual_accel_m_s2: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array
    iterations: int


class _State(NamedTuple):
    chain: Chain
    gyro_bias: Array
    accel_bias: Array


class _Normal(NamedTuple):
    """Normal equations: pose block, nuisance block (gravity, biases), their coupling, right-hand sides."""

    pose: Array
    cross: Array
    nuisance: Array
    pose_rhs: Array
    nuisance_rhs: Array


def refine_chain(chain: Chain, data: SensorData) -> Refinement:
    """Refine a chain that is roughly right (within about 0.2 rad and 0.1 m).

    Raises:
        ValueError: fewer samples than parameters.
    """
    count = len(chain.serials)
    if 6 * data.q_rad.shape[0] < 12 * count:
        raise ValueError(f"{data.q_rad.shape[0]} samples are too few to refine a chain of {count} modules")
    bias = np.zeros((count, 3))
    state = _State(chain, bias, bias)
    sigma_gyro, sigma_accel = np.full(count, 0.01), np.full(count, 0.1)
    used = 0
    for used in range(1, ITERATIONS + 1):
        gyro, accel = _residuals(state, data)
        if used > 1:
            sigma_gyro, sigma_accel = _spread(gyro), _spread(accel)
        normal = _normal_equations(state, data, gyro, accel, sigma_gyro, sigma_accel)
        step, nuisance, _ = _solve(normal, count)
        state = _moved(state, step, nuisance)
        if used > 2 and float(np.abs(step).max()) < CONVERGED:
            break
    gyro, accel = _residuals(state, data)
    sigma_gyro, sigma_accel = _spread(gyro), _spread(accel)
    normal = _normal_equations(state, data, gyro, accel, sigma_gyro, sigma_accel)
    _, _, spectrum = _solve(normal, count)
    return _report(state, spectrum, sigma_gyro, sigma_accel, used)


def _residuals(state: _State, data: SensorData) -> tuple[Array, Array]:
    found = imu_readings(state.chain, data.q_rad, data.qd_rad_s, data.qdd_rad_s2)
    return (
        data.gyro_rad_s - found.gyro_rad_s - state.gyro_bias,
        data.accel_m_s2 - found.accel_m_s2 - state.accel_bias,
    )


def _spread(residual: Array) -> Array:
    """Return the rms (n,) per axis of residuals (m, n, 3), no smaller than any sensor's resolution."""
    return np.asarray(np.maximum(np.sqrt(np.mean(residual**2, axis=(0, 2))), FINEST))


def _normal_equations(
    state: _State, data: SensorData, gyro: Array, accel: Array, sigma_gyro: Array, sigma_accel: Array
) -> _Normal:
    """Build the weighted normal equations, IMU by IMU; the root stays."""
    count = len(state.chain.serials)
    poses = 6 * count
    information, rhs = _prior(state)
    bodies = body_motions(state.chain, data.q_rad, data.qd_rad_s, data.qdd_rad_s2)
    for k in range(count):
        slopes = imu_slopes(state.chain, bodies, data.q_rad, data.qd_rad_s, k)
        weight = 1.0 / np.repeat([sigma_gyro[k], sigma_accel[k]], 3)[:, None]
        rows = (np.concatenate([slopes.poses, slopes.gravity, _biases(len(gyro))]) * weight).reshape(
            -1, weight.size * len(gyro)
        )
        target = (np.concatenate([gyro[:, k], accel[:, k]], axis=1).T * weight).ravel()
        at = _places(slopes.modules, k, count)
        information[np.ix_(at, at)] += rows @ rows.T
        rhs[at] += rows @ target
    return _Normal(
        information[6:poses, 6:poses],
        information[6:poses, poses:],
        information[poses:, poses:],
        rhs[6:poses],
        rhs[poses:],
    )


def _prior(state: _State) -> tuple[Array, Array]:
    """Return the information on [increments (6 n), gravity (3), gyro and accelerometer biases (6 n)].

    Before any sample only the biases are known: they are small. With it the right-hand side that this makes.
    """
    count = len(state.chain.serials)
    known = np.zeros(12 * count + 3)
    known[6 * count + 3 :] = np.repeat([GYRO_BIAS_RAD_S**-2.0, ACCEL_BIAS_M_S2**-2.0], 3 * count)
    held = np.zeros_like(known)
    held[6 * count + 3 :] = np.concatenate([state.gyro_bias.ravel(), state.accel_bias.ravel()])
    return np.diag(known), -known * held


def _biases(samples: int) -> Array:
    """Return the slopes (6, 6, m) of an IMU's readings by its own biases."""
    return np.broadcast_to(np.eye(6)[:, :, None], (6, 6, samples))


def _places(modules: Sequence[int], imu: int, count: int) -> Index:
    """Return where the parameters that one IMU feels stand among all of them, in the order of its slopes."""
    increments = [6 * module + np.arange(6) for module in modules]
    gravity, biases = 6 * count + np.arange(3), 6 * count + 3 + 3 * imu + np.arange(3)
    return np.concatenate([*increments, gravity, biases, biases + 3 * count])


class _Spectrum(NamedTuple):
    """Eigenvectors (columns) of the pose information with the nuisance taken out; the sigmas along them."""

    vectors: Array
    sigmas: Array

    @property
    def known(self) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
        return self.sigmas <= UNKNOWN_ABOVE


def _solve(normal: _Normal, count: int) -> tuple[Array, Array, _Spectrum]:
    """Return the step of all modules (6 n,), that of the nuisance, the spectrum; unknown directions stay."""
    through = np.linalg.solve(normal.nuisance, np.column_stack([normal.cross.T, normal.nuisance_rhs]))
    information = normal.pose - normal.cross @ through[:, :-1]
    rhs = normal.pose_rhs - normal.cross @ through[:, -1]
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    with np.errstate(divide="ignore"):
        sigmas = 1.0 / np.sqrt(np.maximum(values, 0.0))
    spectrum = _Spectrum(vectors[:, ::-1], sigmas[::-1])
    kept = spectrum.vectors[:, spectrum.known]
    step = kept @ (spectrum.sigmas[spectrum.known] ** 2 * (kept.T @ rhs))
    nuisance = through[:, -1] - through[:, :-1] @ step
    return np.concatenate([np.zeros(6), step]), nuisance, spectrum


def _moved(state: _State, step: Array, nuisance: Array) -> _State:
    count = len(state.chain.serials)
    chain = apply_increment(state.chain, step)
    biases = nuisance[3:].reshape(2, count, 3)
    return _State(
        chain._replace(gravity=frozen(chain.gravity + nuisance[:3])),
        state.gyro_bias + biases[0],
        state.accel_bias + biases[1],
    )


def _report(
    state: _State, spectrum: _Spectrum, sigma_gyro: Array, sigma_accel: Array, iterations: int
) -> Refinement:
    known = spectrum.known
    kept = spectrum.vectors[:, known] * spectrum.sigmas[known]
    size = 6 * len(state.chain.serials)
    covariance = np.zeros((size, size))
    covariance[6:, 6:] = kept @ kept.T
    unknown = np.zeros((size, int(np.count_nonzero(~known))))
    unknown[6:] = spectrum.vectors[:, ~known]
    sigmas = spectrum.sigmas[known]
    return Refinement(
        chain=state.chain,
        covariance=frozen(covariance),
        null_basis=frozen(unknown),
        rank=int(np.count_nonzero(known)),
        condition=float(sigmas.max() / sigmas.min()) if sigmas.size else float("inf"),
        residual_gyro_rad_s=frozen(sigma_gyro),
        residual_accel_m_s2=frozen(sigma_accel),
        gyro_bias_rad_s=frozen(state.gyro_bias),
        accel_bias_m_s2=frozen(state.accel_bias),
        iterations=iterations,
    )

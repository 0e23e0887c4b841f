"""The physical limit of a chain's estimate: the Cramer-Rao bound of all that a robot's sensors recorded.

It shares neither model nor data with our estimator: readings and slopes are pinocchio's, of the true chain on
its true motion, and the noise is the profile's. Known: how links and base give. Unknown: the modules' poses,
gravity, the errors of every IMU and its placement in its housing, and the joints' true motion, which encoders
and IMUs measure together. That motion is eliminated exactly: of the readings' slopes by position, speed and
acceleration, differences in time make a banded system. Biases count as constant.

Pinocchio is a development dependency; without it there is no bound.
"""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solveh_banded

from coordinator.batch_estimation.estimator import UNKNOWN_ABOVE
from module_agent.model.catalogue import GRAVITY_SIGMA_M_S2, module_type
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.imu_prior import ImuPrior
from module_agent.model.perturbation import skew
from module_agent.model.read_only import frozen
from sim.imperfections.module_errors import per_axis
from sim.imperfections.noise_profile import NoiseProfile
from sim.world.truth import Motion

# Every fourth row of 250 Hz: joints and their springs move below 20 Hz.
EVERY = 4
# Rows of one banded system; the motion's knots at its ends are free of those next to it.
_CHUNK = 1000
# A prior so many times wider than the estimator's says nothing, and keeps the numbers finite.
_WIDE = 100.0
# The same for an IMU's turn [rad] and place [m]: far beyond what counts as unresolved.
_ANYWHERE = 10.0


class ChainBound(NamedTuple):
    """Least covariance (6 n, 6 n) of a chain's perturbations, and the directions (6 n, k) left unresolved."""

    covariance: Array
    null_basis: Array


class Bounds(NamedTuple):
    """The bounds with the estimator's priors (van Trees), and without any: strict.

    Without priors the errors of IMUs that the profile does not have are known to be zero. If IMUs are off
    their places in it, readings alone tell where IMUs are, but of a leaf that does not turn its own IMU not
    where its housing is: more directions are unresolved then than with priors, and tips have no strict bound.
    """

    bayesian: ChainBound
    strict: ChainBound


def available() -> bool:
    """Whether the second model is installed."""
    return find_spec("pinocchio") is not None


def chain_bounds(
    truth: Chain, types: Sequence[str], motion: Motion, profile: NoiseProfile, prior: ImuPrior
) -> Bounds | None:
    """Return the bounds for one recording, None without pinocchio.

    Args:
        truth: the true chain of n joints, with the IMUs where they sit (`sensing_chain`).
        types: (n,) module types.
        motion: the true motion, at the rate of the sensors.
        profile: the sensors' noise.
        prior: what the estimator knows of the IMUs.
    """
    if not available():
        return None
    information = chain_information(truth, types, motion, profile)
    own = np.concatenate([prior.sigmas, prior.placement_sigmas])
    up = truth.gravity / np.linalg.norm(truth.gravity)
    size = np.outer(up, up) / GRAVITY_SIGMA_M_S2**2
    wide = np.concatenate([_WIDE * prior.sigmas, np.full(6, _ANYWHERE)]) * _drawn(profile)
    return Bounds(_bound(truth, information, own, size), _bound(truth, information, wide, np.zeros((3, 3))))


def _drawn(profile: NoiseProfile) -> NDArray[np.bool_]:
    """Return which errors of an IMU the profile has (40,): those of `ImuPrior.sigmas`, then placement."""
    cross = profile.imu_misalignment_rad + profile.imu_skew_rad
    scales = [np.where(np.eye(3), scale, cross) for scale in (profile.gyro_scale, profile.accel_scale)]
    biases = per_axis(profile.gyro_bias_rad_s, profile.accel_bias_m_s2)
    rest = [profile.imu_bandwidth_hz], np.full(9, profile.gyro_g_sensitivity_s_m)
    # A housing whose axis is tilted and displaced carries its IMU along.
    placed = np.repeat(
        [
            profile.imu_mounting_rad + profile.housing_axis_rad,
            profile.imu_place_m + profile.housing_axis_m,
        ],
        3,
    )
    return np.asarray(np.concatenate([*(scale.ravel() for scale in scales), biases, *rest, placed]) > 0.0)


def _bound(chain: Chain, information: Array, imu_sigmas: Array, gravity: Array) -> ChainBound:
    """Add priors to the information on [perturbations (6 n), gravity (3), IMUs' own (n, k)] and invert."""
    poses, count = 6 * len(chain.serials), len(chain.serials)
    scale = np.concatenate([np.full(3, _WIDE), np.tile(imu_sigmas, count)])
    nuisance = information[poses:, poses:].copy()
    nuisance[:3, :3] += gravity
    nuisance = nuisance * np.outer(scale, scale) + np.eye(len(scale))
    cross = information[6:poses, poses:] * scale
    reduced = information[6:poses, 6:poses] - cross @ cho_solve(cho_factor(nuisance), cross.T)
    values, vectors = np.linalg.eigh(0.5 * (reduced + reduced.T))
    known = values > UNKNOWN_ABOVE**-2.0
    covariance = np.zeros((poses, poses))
    covariance[6:, 6:] = vectors[:, known] / values[known] @ vectors[:, known].T
    unknown = np.zeros((poses, int(np.count_nonzero(~known))))
    unknown[6:] = vectors[:, ~known]
    return ChainBound(frozen(covariance), frozen(unknown))


def chain_information(truth: Chain, types: Sequence[str], motion: Motion, profile: NoiseProfile) -> Array:
    """Return the information on [perturbations (6 n), gravity (3), IMUs' own (n, k)] without any prior."""
    model = ChainModel(truth)
    step_s = 1e-9 * float(np.median(np.diff(motion.t_ns)))
    q, qd = motion.q_rad, motion.qd_rad_s
    signals = [signal[::EVERY] for signal in (q, qd, np.gradient(qd, step_s, axis=0))]
    kinds = [module_type(name) for name in types]
    speed = np.array([kind.vibration / kind.max_speed_rad_s for kind in kinds]) * np.abs(signals[1])
    white = np.hypot(
        per_axis(profile.gyro_white_rad_s, profile.accel_white_m_s2),
        per_axis(profile.gyro_step_rad_s, profile.accel_step_m_s2) / np.sqrt(12.0),
    )
    gears = per_axis(profile.vibration_rad_s, profile.vibration_m_s2)
    imu = np.hypot(white, speed[..., None] * gears) / np.sqrt(EVERY)
    late = profile.sampling_jitter_s * np.abs(signals[1])
    encoder = np.hypot(profile.position_step_rad / np.sqrt(12.0), late) / np.sqrt(EVERY)
    total: Array | float = 0.0
    for begin in range(0, len(q[::EVERY]) - 2, _CHUNK):
        part = slice(begin, begin + _CHUNK + 2)
        slopes = model.slopes([signal[part] for signal in signals], EVERY * step_s)
        total = total + _without_motion(slopes, imu[part], encoder[part], EVERY * step_s)
    return np.asarray(total)


class Slopes(NamedTuple):
    """Derivatives of m samples of n IMUs' readings, (m, n, 6, ...).

    unknown: by [perturbations (6 n), gravity (3), IMUs' own (n, k)]. q, qd, qdd: by the joints' motion (n).

    An IMU's own are its errors in the order of `ImuPrior`, and its turn and displacement in its own axes.
    """

    unknown: Array
    q: Array
    qd: Array
    qdd: Array


def _without_motion(slopes: Slopes, imu: Array, encoder: Array, step_s: float) -> Array:
    """Return the information on the unknowns with the joints' motion eliminated.

    Args:
        slopes: of m samples.
        imu, encoder: standard deviations (m, n, 6) and (m, n).
        step_s: between samples; qd and qdd are central differences of q.
    """
    samples, joints = encoder.shape
    inner = slice(1, -1)
    by_q, by_qd, by_qdd, known = (
        (slope / imu[..., None])[inner].reshape(samples - 2, 6 * joints, -1)
        for slope in (slopes.q, slopes.qd / (2.0 * step_s), slopes.qdd / step_s**2, slopes.unknown)
    )
    at = (by_qdd - by_qd, by_q - 2.0 * by_qdd, by_qdd + by_qd)
    # Lower bands: [k, column] holds the entry k rows below the diagonal.
    bands = np.zeros((3 * joints, samples, joints))
    cross = np.zeros((samples, joints, known.shape[2]))
    row, column = np.indices((joints, joints))
    bands[0] = encoder**-2.0
    for first in range(3):
        cross[first : samples - 2 + first] += at[first].transpose(0, 2, 1) @ known
        for second in range(first, 3):
            block = at[second].transpose(0, 2, 1) @ at[first]
            below = joints * (second - first) + row - column
            kept = below >= 0
            bands[below[kept], first : samples - 2 + first, column[kept]] += block[
                :, row[kept], column[kept]
            ].T
    coupling = cross.reshape(samples * joints, -1)
    through = solveh_banded(bands.reshape(3 * joints, -1), coupling, lower=True)
    flat = known.reshape(-1, known.shape[2])
    return np.asarray(flat.T @ flat - coupling.T @ through)


class ChainModel:
    """Pinocchio's model of a chain, with a free joint before every module in place of its perturbation.

    At q = 0 all joint frames are parallel to the root frame; those of free joints coincide with it.
    """

    def __init__(self, chain: Chain):
        import pinocchio as pin

        self._pin: Any = pin
        self._chain = chain
        self._model = model = pin.Model()
        frames = []
        for k, parent in enumerate(chain.parent):
            below = np.zeros(3) if parent == BASE else chain.point[parent]
            own = pin.SE3(np.eye(3), -below)
            free = model.addJoint(2 * (parent + 1), pin.JointModelFreeFlyer(), own, f"free {k}")
            axis = pin.JointModelRevoluteUnaligned(chain.axis[k])
            turning = model.addJoint(free, axis, pin.SE3(np.eye(3), chain.point[k]), f"joint {k}")
            home = np.array(chain.imu_home[k])
            home[:3, 3] -= chain.point[k] if chain.reversed[k] else 0.0
            carrier = turning if chain.reversed[k] else free
            frames.append(model.addFrame(pin.Frame(f"imu {k}", carrier, pin.SE3(home), pin.FrameType.SENSOR)))
        self._frames, self._data = frames, model.createData()
        # From the columns of all joints to those of perturbations: what moves a module leaves those beyond.
        joints = len(chain.serials)
        self._joints = 7 * np.arange(joints) + 6
        self._absolute = np.zeros((7 * joints, 6 * joints))
        order = [3, 4, 5, 0, 1, 2]
        for k in range(joints):
            twist = 6 * k + np.arange(6)
            self._absolute[7 * k + np.array(order), twist] = 1.0
            for child in chain.children(k):
                self._absolute[7 * child + np.array(order), twist] = -1.0

    def readings(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return ideal readings (m, n, 6): rates [rad/s], specific forces [m/s^2], for (m, n) of motion."""
        return self._kinematics(q, qd, qdd)[0]

    def slopes(self, motion: Sequence[Array], step_s: float) -> Slopes:
        """Return the derivatives of the readings of IMUs without errors; samples are `step_s` apart."""
        q, qd, qdd = motion
        readings, slopes, turns, alpha = self._kinematics(q, qd, qdd)
        joints = len(self._chain.serials)
        gravity = np.concatenate([np.zeros_like(turns), turns.swapaxes(2, 3)], axis=2)
        # An IMU's own errors and its place change its own readings only.
        by_error = _error_slopes(readings, np.gradient(readings, step_s, axis=0))
        errors = np.concatenate([by_error, _placement_slopes(readings, alpha)], axis=3)
        own = np.zeros((*readings.shape, joints, errors.shape[3]))
        own[:, np.arange(joints), :, np.arange(joints)] = errors.swapaxes(0, 1)
        by_place = slopes[0] @ self._absolute
        unknown = np.concatenate([by_place, gravity, own.reshape(*readings.shape, -1)], axis=3)
        return Slopes(unknown, *(slope[..., self._joints] for slope in slopes))

    def _kinematics(self, q: Array, qd: Array, qdd: Array) -> tuple[Array, tuple[Array, ...], Array, Array]:
        """Return readings (m, n, 6), their slopes by all joints, turns (m, n, 3, 3), alpha (m, n, 3)."""
        pin, model, data = self._pin, self._model, self._data
        samples, joints = q.shape
        spatial = np.zeros((2, samples, joints, 6))
        slopes = np.zeros((4, samples, joints, 6, 7 * joints))
        turns = np.zeros((samples, joints, 3, 3))
        pose, speed, change = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        hinge = 8 * np.arange(joints) + 7
        for t in range(samples):
            pose[hinge], speed[self._joints], change[self._joints] = q[t], qd[t], qdd[t]
            pin.computeForwardKinematicsDerivatives(model, data, pose, speed, change)
            for k, frame in enumerate(self._frames):
                turns[t, k] = pin.updateFramePlacement(model, data, frame).rotation
                spatial[0, t, k] = pin.getFrameVelocity(model, data, frame, pin.LOCAL).vector
                spatial[1, t, k] = pin.getFrameAcceleration(model, data, frame, pin.LOCAL).vector
                found = pin.getFrameAccelerationDerivatives(model, data, frame, pin.LOCAL)
                slopes[0, t, k], slopes[1:, t, k] = found[0], found[1:]
        return *self._readings(spatial, slopes, turns), spatial[1, ..., 3:]

    def _readings(
        self, spatial: Array, slopes: Array, turns: Array
    ) -> tuple[Array, tuple[Array, ...], Array]:
        """Turn spatial motion [linear, angular] into readings: f = a + omega x v + R^T g."""
        (v, a), (v_q, a_q, a_qd, v_qd) = spatial, slopes
        omega, gravity = v[..., 3:], np.einsum("...ji,j->...i", turns, self._chain.gravity)
        force = a[..., :3] + np.cross(omega, v[..., :3]) + gravity
        across, past = skew(omega), -skew(v[..., :3])

        def centripetal(by: Array) -> Array:
            return np.asarray(across @ by[..., :3, :] + past @ by[..., 3:, :])

        by_q = a_q[..., :3, :] + centripetal(v_q) + skew(gravity) @ v_qd[..., 3:, :]
        by_qd = a_qd[..., :3, :] + centripetal(v_qd)
        still = np.zeros_like(by_q)
        found = (
            np.concatenate([v_q[..., 3:, :], by_q], axis=2),
            np.concatenate([v_qd[..., 3:, :], by_qd], axis=2),
            np.concatenate([still, v_qd[..., :3, :]], axis=2),
        )
        return np.concatenate([omega, force], axis=2), found, turns


def _error_slopes(readings: Array, rates: Array) -> Array:
    """Return the derivatives (m, n, 6, k) of readings by their IMU's errors, in the order of `ImuPrior`."""
    shape = readings.shape[:2]
    omega, force = readings[..., None, :3], readings[..., None, 3:]
    found = np.zeros((*shape, 6, 34))
    for row in range(3):
        found[..., row, 3 * row : 3 * row + 3] = omega[..., 0, :]
        found[..., 3 + row, 9 + 3 * row : 12 + 3 * row] = force[..., 0, :]
        found[..., row, 25 + 3 * row : 28 + 3 * row] = force[..., 0, :]
    found[..., 18:24] = np.eye(6)
    found[..., 24] = -rates
    return found


def _placement_slopes(readings: Array, alpha: Array) -> Array:
    """Return the derivatives (m, n, 6, 6) of readings by their IMU's turn and displacement in its own axes.

    f = f_0 + (alpha x + omega x omega x) r (Craig, Introduction to Robotics, eq. 6.48), and a sensor that is
    turned by d reads v - d x v; alpha (m, n, 3) is the angular acceleration in the IMU's axes.
    """
    omega, force = skew(readings[..., :3]), skew(readings[..., 3:])
    by_turn = np.concatenate([omega, force], axis=-2)
    by_place = np.concatenate([np.zeros_like(omega), skew(alpha) + omega @ omega], axis=-2)
    return np.concatenate([by_turn, by_place], axis=-1)

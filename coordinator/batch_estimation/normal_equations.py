"""The normal equations of the batch estimator, formed and reduced by each IMU's own path.

An IMU's readings depend on the modules from the root to its own, on gravity, on the links and joints between
them, and on its own errors and place. So every IMU adds one dense block at the rows and columns of its path.
Its own parameters appear nowhere else, and are eliminated at once (block angular form; Bjoerck, Numerical
Methods for Least Squares Problems, 1996, 6.3). Only where former recordings have correlated the IMUs of
several modules are those of all eliminated together. What is left is a system of poses, gravity and links.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dsyrk

from coordinator.batch_estimation.imu_calibration import ImuCalibration
from coordinator.batch_estimation.imu_intrinsics import SIZE as ERRORS
from coordinator.batch_estimation.imu_intrinsics import ImuIntrinsics, axis_errors, error_signals, mixing
from coordinator.batch_estimation.imu_jacobian import (
    Motion,
    SeenDisplacements,
    imu_path,
    seen_by,
    weighted_slopes,
)
from coordinator.batch_estimation.imu_kernel import KernelDisplacements, Path, add_upper
from coordinator.batch_estimation.imu_prediction import ImuReadings
from coordinator.batch_estimation.link_compliance import ComplianceJacobian
from coordinator.batch_estimation.sensor_data import SensorData
from module_agent.model.catalogue import GRAVITY_M_S2, GRAVITY_SIGMA_M_S2
from module_agent.model.chain import Array, Chain

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


# Of an information matrix of some dozens of parameters whose diagonal is one.
ROUNDING = 1e-12


class Problem(NamedTuple):
    """The samples, and what is known before of the IMUs and of the links' compliances.

    displaced: what the links carry, as the kernels take it.
    known: information of the IMUs' prior, over what is free of them.
    """

    data: SensorData
    flex: ComplianceJacobian
    displaced: KernelDisplacements
    calibration: ImuCalibration
    known: Array

    @property
    def free(self) -> Mask:
        """Which of an IMU's are estimated, (40,)."""
        return self.calibration.free


class State(NamedTuple):
    """Chain, every IMU's errors and placement (n, 40), and the links' compliances."""

    chain: Chain
    own: Array
    compliance: Array

    @property
    def imus(self) -> ImuIntrinsics:
        """The IMUs' errors."""
        return ImuIntrinsics(self.own[:, :ERRORS])

    @property
    def placement(self) -> Array:
        """The IMUs' turns and displacements, (n, 6)."""
        return self.own[:, ERRORS:]


class Expected(NamedTuple):
    """What a state predicts: the chain as the IMUs are placed, motions, ideal IMUs, residuals.

    still, shaken: the motion of the joints, on a base at rest and on one that moves as measured, for the
    derivatives; the latter None at rest. residuals: (m, n, 3) of gyros and accelerometers.
    """

    placed: Chain
    still: Motion
    shaken: Motion | None
    ideal: ImuReadings
    residuals: tuple[Array, Array]


class Eliminated(NamedTuple):
    """Parameters of IMUs as functions of the others: own = through[:, -1] - through[:, :-1] x[at].

    own: which they are, of all that is free of all IMUs in turn. at: columns of the reduced system.
    information: their own.
    """

    own: Index
    at: Index
    through: Array
    information: Array


class NormalEquations(NamedTuple):
    """Of poses, gravity and links, the IMUs' own parameters eliminated: blocks and right-hand sides.

    pose: of the perturbations of all modules but the root. nuisance: of gravity and the links. cross: between
    them. eliminated: how the IMUs' own follow.
    """

    pose: Array
    cross: Array
    nuisance: Array
    pose_rhs: Array
    nuisance_rhs: Array
    eliminated: tuple[Eliminated, ...]

    def own_step(self, step: Array) -> Array:
        """Return the step of all that is free of the IMUs, for one of poses (6 n) and nuisance."""
        own = np.zeros(sum(len(one.own) for one in self.eliminated))
        for one in self.eliminated:
            own[one.own] = one.through[:, -1] - one.through[:, :-1] @ step[one.at]
        return own

    def own_covariance(self, covariance: Array) -> Array:
        """Return the covariance of all that is free of the IMUs, for that of poses (6 n) and nuisance."""
        size = sum(len(one.own) for one in self.eliminated)
        through, own = np.zeros((size, len(covariance))), np.zeros((size, size))
        for one in self.eliminated:
            through[np.ix_(one.own, one.at)] = one.through[:, :-1]
            own[np.ix_(one.own, one.own)] = np.linalg.inv(one.information)
        return own + through @ covariance @ through.T


class _Layout(NamedTuple):
    """The reduced system: poses, gravity (3), links, right-hand side."""

    modules: int
    links: int

    @property
    def poses(self) -> int:
        """The number of columns of poses."""
        return 6 * self.modules

    @property
    def width(self) -> int:
        """The number of all columns."""
        return self.poses + 3 + self.links + 1

    def at(self, path: Path, seen: SeenDisplacements) -> Index:
        """Return the columns that an IMU's readings depend on, in the order of `weighted_slopes`."""
        poses = (6 * path.modules[:, None] + np.arange(6)).ravel()
        gravity = self.poses + np.arange(3)
        return np.concatenate([poses, gravity, self.poses + 3 + seen.numbers, [self.width - 1]])


class _Share(NamedTuple):
    """What one IMU adds: to the reduced system at columns `at` (upper triangle), between that and its own
    parameters, and to these.
    """

    at: Index
    shared: Array
    cross: Array
    own: Array


def normal_equations(
    problem: Problem,
    state: State,
    expected: Expected,
    motion: Motion,
    sigmas: Sequence[Array],
) -> NormalEquations:
    """Return the weighted normal equations; the root stays.

    Args:
        motion: at which the derivatives are taken.
        sigmas: (k, n) of gyros and accelerometers in every motion.
    """
    layout = _Layout(len(state.chain.serials), len(problem.flex.links))
    information = np.zeros((layout.width, layout.width))
    _add_prior(problem, state, information, layout.poses)
    prior_rhs = problem.known @ (problem.calibration.mean - state.own)[:, problem.free].ravel()
    size = len(prior_rhs) // layout.modules
    apart = _apart(problem.known, layout.modules)
    eliminated, waiting = [], []
    for k in range(layout.modules):
        share = _share(problem, state, expected, motion, sigmas, layout, k)
        own = size * k + np.arange(size)
        share.cross[:, -1] += prior_rhs[own]
        add_upper(information, share.shared, share.at)
        if apart:
            full = share.own + problem.known[np.ix_(own, own)]
            eliminated.append(_eliminated(information, own, share.at, full, share.cross))
        else:
            waiting.append(share)
    if waiting:
        eliminated = [_eliminated(information, *_together(waiting, problem.known, layout.width))]
    whole = np.triu(information) + np.triu(information, 1).T
    poses = slice(6, layout.poses)
    rest = slice(layout.poses, layout.width - 1)
    return NormalEquations(
        whole[poses, poses],
        whole[poses, rest],
        whole[rest, rest],
        whole[poses, -1],
        whole[rest, -1],
        tuple(eliminated),
    )


def _share(
    problem: Problem,
    state: State,
    expected: Expected,
    motion: Motion,
    sigmas: Sequence[Array],
    layout: _Layout,
    k: int,
) -> _Share:
    data, path = problem.data, imu_path(expected.placed, k)
    seen = seen_by(path, problem.flex.carried.modules, problem.flex.carried.of_joint)
    motions = np.zeros(len(data.q_rad), dtype=np.int64) if data.motion is None else data.motion
    weight = 1.0 / np.stack([sigma[:, k] for sigma in sigmas])[:, motions]
    residual = np.concatenate([part[:, k] for part in expected.residuals], axis=1).T
    errors, rows = axis_errors(problem.free[:ERRORS])
    signals = _error_signals(problem, expected, weight, k, motion.bodies.shape[2])
    of_sensor, placement = np.arange(6)[:, None] // 3, np.arange(ERRORS, len(problem.free))
    at, count = layout.at(path, seen), errors.shape[1] + len(placement)
    shared = np.zeros((len(at), len(at)), order="F")
    crosses, owns = np.zeros((6, count, len(at))), np.zeros((6, count, count))
    mixed = mixing(state.imus, k)
    blocks = weighted_slopes(path, motion, problem.displaced, seen, mixed, weight, residual)
    for block, slopes, placed in blocks:
        flat = slopes.reshape(len(slopes), -1).T
        shared = dsyrk(1.0, flat, trans=1, beta=1.0, c=shared, overwrite_c=1)
        # The errors of an axis are its own.
        own = np.empty((6, count, placed.shape[2]))
        own[:, : rows.shape[1]] = signals[of_sensor, rows, block]
        own[:, rows.shape[1] :] = placed.transpose(1, 0, 2)
        crosses += own @ slopes.transpose(1, 2, 0)
        owns += own @ own.transpose(0, 2, 1)
    number, size = np.cumsum(problem.free) - 1, int(problem.free.sum())
    share = _Share(at, shared, np.zeros((size, len(at))), np.zeros((size, size)))
    is_free = np.append(problem.free, False)
    for of_axis, cross, inner in zip(errors, crosses, owns, strict=True):
        parameters = np.concatenate([of_axis, placement])
        kept = is_free[parameters]
        free = number[parameters[kept]]
        share.cross[free] += cross[kept]
        share.own[np.ix_(free, free)] += inner[np.ix_(kept, kept)]
    return share


def _error_signals(problem: Problem, expected: Expected, weight: Array, k: int, places: int) -> Array:
    """Return `error_signals` of one IMU by the weights of its gyro and of its accelerometer, (2, 14, m')."""
    samples, rates = weight.shape[1], problem.data.imu_rates
    true = expected.ideal.gyro_rad_s[:, k], expected.ideal.accel_m_s2[:, k]
    signals = np.zeros((2, 14, places))
    signals[..., :samples] = error_signals(*true, None if rates is None else rates[:, k])
    signals[..., :samples] *= weight[:, None]
    return signals


def _add_prior(problem: Problem, state: State, information: Array, poses: int) -> None:
    """Add what is known before of gravity and the links.

    Gravity's magnitude makes the accelerometers' scales observable.
    """
    flex, size = problem.flex, float(np.linalg.norm(state.chain.gravity))
    up, at = state.chain.gravity / size, slice(poses, poses + 3)
    information[at, at] += np.outer(up, up) / GRAVITY_SIGMA_M_S2**2
    information[at, -1] += up * (GRAVITY_M_S2 - size) / GRAVITY_SIGMA_M_S2**2
    links = np.arange(poses + 3, len(information) - 1)
    information[links, links] += flex.sigmas**-2.0
    information[links, -1] -= flex.sigmas**-2.0 * (state.compliance + flex.taken)


def _apart(known: Array, count: int) -> bool:
    """Return whether a prior correlates no IMU with another."""
    size = len(known) // count
    blocks = np.asarray(known.reshape(count, size, count, size).any(axis=(1, 3)))
    return not bool(blocks[~np.eye(count, dtype=bool)].any())


def _together(shares: Sequence[_Share], known: Array, width: int) -> tuple[Index, Index, Array, Array]:
    """Return the arguments of `_eliminated` for all IMUs at once, whose prior information is `known`."""
    size = len(known) // len(shares)
    information, cross = known.copy(), np.zeros((len(known), width))
    for k, share in enumerate(shares):
        own = slice(size * k, size * (k + 1))
        information[own, own] += share.own
        cross[own, share.at] += share.cross
    return np.arange(len(known)), np.arange(width), information, cross


def _eliminated(information: Array, own: Index, at: Index, inner: Array, cross: Array) -> Eliminated:
    """Take parameters out of a system (its upper triangle) with which they share `cross` (s, p).

    Their units differ by orders of magnitude, so that their information (s, s) is scaled.
    """
    scale = 1.0 / np.sqrt(np.diag(inner))
    scaled = inner * np.outer(scale, scale)
    try:
        lower = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        # Where samples have no noise, the prior of what they do not show is lost in rounding.
        lower = np.linalg.cholesky(scaled + ROUNDING * np.eye(len(scaled)))
    half = solve_triangular(lower, cross * scale[:, None], lower=True)
    add_upper(information, dsyrk(-1.0, half, trans=1), at)
    through = scale[:, None] * solve_triangular(lower, half, lower=True, trans=1)
    return Eliminated(own, at[:-1], through, inner)

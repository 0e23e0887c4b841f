"""The calibration of IMUs: what is known of their errors and places, and what one recording adds.

An IMU's calibration x is its errors (`imu_intrinsics`), and its turn and displacement against its catalogued
place in the housing. It belongs to the module, and is the same after a reassembly. A recording's information
L and L x about the IMUs of its modules is that of its samples, all other unknowns eliminated, without the
prior of x; the errors of one recording are correlated among its modules, so L is one matrix for all of them.
With a prior N(m, P) and recordings i with independent noise the posterior is

    P' = (P^-1 + sum L_i)^-1,     m' = P' (P^-1 m + sum L_i x_i)

(Bierman, Factorization methods for discrete sequential estimation, 1977, ch. 2): every recording and the
catalogue count once, in any order. This is the joint estimate over all recordings as far as models are linear
in errors of this size. The place alone would not do: what a bias or a scale makes of it is the same error in
every recording, and would be averaged as if it were noise. Biases change between sessions: that of an
accelerometer is a constant and a change of its own in every session, which is eliminated; those of gyros
start anew, and so do delays, which are relative to the session's common one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.batch_estimation.imu_intrinsics import ACCEL_BIAS, DELAY, GYRO_BIAS
from coordinator.batch_estimation.imu_intrinsics import SIZE as ERRORS
from module_agent.model.catalogue import ImuKind
from module_agent.model.chain import Array
from module_agent.model.imu_prior import ACCEL_BIAS_CHANGE_M_S2, ImuPrior
from module_agent.model.read_only import frozen

# One IMU: its errors, its turn and its displacement.
SIZE = ERRORS + 6
_PLACEMENT, _DISPLACEMENT = slice(ERRORS, SIZE), slice(ERRORS + 3, SIZE)


class ImuCalibration(NamedTuple):
    """What is known of the IMUs of n modules.

    serials: of the modules. mean: (n, 40) errors (34, `ImuIntrinsics`), turn [rad] and displacement [m]
    against the catalogued place, in the IMU's axes. covariance: (40 n, 40 n), zero for what counts as exact.
    """

    serials: tuple[str, ...]
    mean: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations (n, 40)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)).reshape(-1, SIZE))

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which parameters are unknown of all IMUs, (40,)."""
        return np.asarray((self.sigma > 0.0).all(axis=0))

    @property
    def placement(self) -> Array:
        """Turn [rad] and displacement [m] of every IMU, (n, 6)."""
        return self.mean[:, _PLACEMENT]

    @property
    def placement_sigma(self) -> Array:
        """Standard deviations of `placement`, (n, 6)."""
        return self.sigma[:, _PLACEMENT]

    def placement_covariance(self, module: int) -> Array:
        """Return the covariance (6, 6) of one IMU's `placement`."""
        own = slice(SIZE * module + ERRORS, SIZE * module + SIZE)
        return self.covariance[own, own]

    def widened(self, modules: Sequence[int], sigma_m: float) -> "ImuCalibration":
        """Return the same with further displacement of some IMUs, independent of all else."""
        spread = np.zeros(self.mean.shape)
        spread[list(modules), _DISPLACEMENT] = sigma_m**2
        return self._replace(covariance=frozen(self.covariance + np.diag(spread.ravel())))

    def with_any_scale(self, modules: Sequence[int], sigma: float) -> "ImuCalibration":
        """Return the same with further errors of scale and axes of some IMUs, independent of all else."""
        spread = np.zeros(self.mean.shape)
        spread[list(modules), : GYRO_BIAS.start] = sigma**2
        return self._replace(covariance=frozen(self.covariance + np.diag(spread.ravel())))

    def information(self) -> tuple[Array, "NDArray[np.int64]"]:
        """Return the inverse of the covariance of what is free, and the rows of that."""
        rows = np.flatnonzero(np.tile(self.free, len(self.serials)))
        return _inverse(self.covariance[np.ix_(rows, rows)]), rows


class CalibrationInformation(NamedTuple):
    """What one recording tells of the IMUs of n modules, without any prior of them.

    matrix: (40 n, 40 n), positive semidefinite. vector: (40 n,) the matrix times the parameters. session: the
    trace hash of the recording, which identifies it; empty if it has none yet. imu: the session's prior.
    suspicions: why the recording is not to be believed as usual.
    """

    serials: tuple[str, ...]
    matrix: Array
    vector: Array
    session: str = ""
    imu: ImuKind = "uncalibrated"
    suspicions: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The recording, for messages, by its trace hash as in reports."""
        return f"recording {self.session[:16]}"


def catalogued(serials: Sequence[str], prior: ImuPrior) -> ImuCalibration:
    """Return what is known of the IMUs of modules that were not measured."""
    sigmas = np.tile(_sigmas(prior), len(serials))
    return ImuCalibration(tuple(serials), frozen(np.zeros((len(serials), SIZE))), frozen(np.diag(sigmas**2)))


def measured_before(
    serials: Sequence[str], prior: ImuPrior, recordings: Sequence[CalibrationInformation]
) -> ImuCalibration:
    """Return what the catalogue and recordings with independent noise, each given once, tell of some modules.

    It is the prior of a new session of these modules, with the changes of biases since.
    """
    if not recordings:
        return catalogued(serials, prior)
    others = dict.fromkeys(serial for one in recordings for serial in one.serials if serial not in serials)
    everyone, changes = (*serials, *others), _changes(prior)
    constant = np.maximum(_sigmas(prior) ** 2 - changes**2, 0.0)
    rows = np.flatnonzero(np.tile(constant > 0.0, len(everyone)))
    inverse, vector = np.diag(1.0 / np.tile(constant, len(everyone))[rows]), np.zeros(len(rows))
    index = {row: k for k, row in enumerate(rows.tolist())}
    for one in recordings:
        matrix, of_recording = _without_changes(one, changes)
        first = [SIZE * everyone.index(serial) for serial in one.serials]
        at = (np.array(first)[:, None] + np.arange(SIZE)).ravel()
        own = np.array([k for k, row in enumerate(at.tolist()) if row in index], dtype=np.int64)
        here = np.array([index[row] for row in at[own].tolist()], dtype=np.int64)
        inverse[np.ix_(here, here)] += matrix[np.ix_(own, own)]
        vector[here] += of_recording[own]
    spread = _inverse(inverse)
    mean, covariance = np.zeros(SIZE * len(everyone)), np.diag(np.tile(changes**2, len(everyone)))
    mean[rows] = spread @ vector
    covariance[np.ix_(rows, rows)] += spread
    kept = slice(0, SIZE * len(serials))
    return ImuCalibration(
        tuple(serials), frozen(mean[kept].reshape(-1, SIZE)), frozen(covariance[kept, kept])
    )


def information_between(prior: ImuCalibration, posterior: ImuCalibration) -> CalibrationInformation:
    """Return what a recording added to a prior, both of the same modules.

    What rounding leaves below zero is set to zero.
    """
    (before, rows), (after, _) = prior.information(), posterior._replace(mean=prior.mean).information()
    size = prior.sigma.ravel()[rows]
    values, vectors = np.linalg.eigh((after - before) * np.outer(size, size))
    matrix, vector = np.zeros(prior.covariance.shape), np.zeros(len(prior.covariance))
    matrix[np.ix_(rows, rows)] = (vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(size, size)
    vector[rows] = after @ posterior.mean.ravel()[rows] - before @ prior.mean.ravel()[rows]
    return CalibrationInformation(prior.serials, frozen(matrix), frozen(vector))


def _sigmas(prior: ImuPrior) -> Array:
    return np.concatenate([prior.sigmas, prior.placement_sigmas])


def _changes(prior: ImuPrior) -> Array:
    """Return by how much a session's parameters (40,) differ from the module's own, standard deviations."""
    changes = np.zeros(SIZE)
    changes[GYRO_BIAS], changes[DELAY] = prior.gyro_bias_rad_s, prior.delay_s
    changes[ACCEL_BIAS] = min(ACCEL_BIAS_CHANGE_M_S2, prior.accel_bias_m_s2)
    return changes


def _without_changes(recording: CalibrationInformation, changes: Array) -> tuple[Array, Array]:
    """Return a recording's information about what sessions have in common, the changes eliminated."""
    spread = np.tile(changes, len(recording.serials))
    changed = np.flatnonzero(spread)
    inner = recording.matrix[np.ix_(changed, changed)] + np.diag(spread[changed] ** -2.0)
    through = np.linalg.solve(inner, recording.matrix[changed]).T
    matrix = recording.matrix - through @ recording.matrix[changed]
    return 0.5 * (matrix + matrix.T), recording.vector - through @ recording.vector[changed]


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a positive definite matrix whose units differ by orders of magnitude."""
    size = np.sqrt(np.diag(matrix))
    scaled = np.linalg.inv(matrix / np.outer(size, size)) / np.outer(size, size)
    return np.asarray(0.5 * (scaled + scaled.T))

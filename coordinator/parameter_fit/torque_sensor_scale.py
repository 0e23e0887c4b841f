"""Estimate the scale error of each joint's torque sensor from the joints that carry the same bodies.

A sensor that reads tau / (1 + s) makes the bodies beyond its joint too light by that factor. The joints below
carry these bodies too, so that the scales of a robot's joints are determined relative to each other; a common
scale of all is not. With the rows [r_i | z_i] of joint i and the prior s = 0 +- sigma,

    minimise sum_i |z_i - r_i phi / (1 + s_i)|^2 + sum_i (s_i / sigma)^2,

by Gauss-Newton. The prediction is scaled, not the reading: scaling the readings would scale their noise too
and bias all scales towards zero.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from coordinator.dynamics.pseudo_inertia import parameter_scale
from coordinator.parameter_fit.base_parameters import whitened
from coordinator.parameter_fit.least_squares import InertialFit
from coordinator.parameter_fit.spectrum import RANK_TOLERANCE, without_range
from module_agent.model.catalogue import TorqueKind
from module_agent.model.chain import Array
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only

# Prior of the scale of a module's torque sensor, a spring whose stiffness is known to a few percent as
# delivered. That is a guess: no figure is published.
SCALE_SIGMA: dict[TorqueKind, float] = {"calibrated": 0.0, "uncalibrated": 0.05}
# Prior of the offset, as a share of the largest torque; a real X5-1's log shows 0.4 %.
OFFSET_SHARE: dict[TorqueKind, float] = {"calibrated": 0.0, "uncalibrated": 0.005}


class TorqueScale(NamedTuple):
    """Scale errors of torque sensors: the true torques are (1 + value) times the readings; read-only.

    value: (n,). covariance: (n, n), zero of calibrated sensors.
    """

    value: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """Standard deviations (n,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    @property
    def root(self) -> Array:
        """A matrix (n, n) whose product with its transpose is the covariance."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def known_scale(joints: int) -> TorqueScale:
    """Return the scales of calibrated sensors: zero, with no uncertainty."""
    return TorqueScale(np.zeros(joints), np.zeros((joints, joints)))


def refine_scale(
    information: Sequence[JointInformation],
    fit: InertialFit,
    noise_nm: ArrayLike,
    prior_sigma: float,
    so_far: TorqueScale,
    independent_fraction: float,
) -> TorqueScale:
    """Return the scales of n joints' torque sensors.

    Args:
        information: per joint, with torques that were multiplied by 1 + `so_far.value`.
        fit: of the bodies that fit them best, without a prior. noise_nm: (n,) of the torques.
        prior_sigma: standard deviation of the prior of each scale; above zero.
        so_far: the estimate to start from.
        independent_fraction: independent samples per sample, below 1 after a low-pass.
    """
    joints = len(information)
    weights = np.sqrt(independent_fraction) / np.asarray(noise_nm, dtype=float)
    rows, readings = whitened(information, noise_nm, independent_fraction)
    predicted = [w * (piece.r @ fit.phi) for w, piece in zip(weights, information, strict=True)]
    columns = block_diag(*(one[:, None] for one in predicted))
    # The bodies may move along the directions that were fitted, no more and no fewer: what the fit has along
    # any other would be taken for an error of the scales.
    size = parameter_scale(joints)
    shares, directions = np.linalg.eigh(fit.projector * size / size[:, None])
    rows = rows * size @ directions[:, shares > 0.5]
    (slopes, target), _ = without_range(rows, RANK_TOLERANCE, (columns, readings))
    curvature = slopes.T @ slopes + np.eye(joints) / prior_sigma**2
    covariance = np.asarray(np.linalg.inv(curvature), dtype=np.float64)
    change = -covariance @ (slopes.T @ target + so_far.value / prior_sigma**2)
    value = so_far.value + change
    make_read_only((value, covariance))
    return TorqueScale(value, covariance)


def scaled(piece: JointInformation, scale: float) -> JointInformation:
    """Return rows as if the torques had been (1 + scale) times as large."""
    return piece._replace(z=(1.0 + scale) * piece.z, rest=(1.0 + scale) ** 2 * piece.rest)

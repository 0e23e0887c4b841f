"""By how much each joint's torque sensor is off in scale, as far as the joints that share bodies tell.

A sensor that shows tau / (1 + s) makes the bodies beyond its joint as much too light. What a joint carries
hangs on the joints below it too, so that the scales of a robot's joints are known relative to each other;
that all are off alike no motion shows. With the rows [r_i | z_i] of joint i and what s is known to be within,

    minimise sum_i |z_i - r_i phi / (1 + s_i)|^2 + sum_i (s_i / sigma)^2,

by Gauss and Newton. It is the prediction that is scaled: scaled readings would bring their noise down with
them, and all scales come out too small.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.dynamics.pseudo_inertia import parameter_scale
from coordinator.parameter_fit.spectrum import without_range
from module_agent.model.catalogue import TorqueKind
from module_agent.model.chain import Array
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only

# Of a module's torque sensor, a spring whose stiffness is known to a few percent as delivered. That is a
# guess: no figure is published.
SCALE_SIGMA: dict[TorqueKind, float] = {"calibrated": 0.0, "uncalibrated": 0.05}
# Of their largest torque; a real X5-1's log shows 0.4 %.
OFFSET_SHARE: dict[TorqueKind, float] = {"calibrated": 0.0, "uncalibrated": 0.005}


class TorqueScale(NamedTuple):
    """The joints' true torques are (1 + value) times what their sensors show; read-only.

    value: (n,). covariance: (n, n), zero of sensors whose scale is known.
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
    """Return that of sensors that show what is."""
    return TorqueScale(np.zeros(joints), np.zeros((joints, joints)))


def refine_scale(
    information: Sequence[JointInformation],
    phi: Array,
    noise_nm: ArrayLike,
    prior_sigma: float,
    so_far: TorqueScale,
    independent_fraction: float,
    tolerance: float,
) -> TorqueScale:
    """Return the scales of n joints' torque sensors.

    Args:
        information: per joint, with torques that were multiplied by 1 + `so_far.value`.
        phi: (10 n,) the bodies that fit them best. noise_nm: (n,) of the torques.
        prior_sigma: what is known of each scale beforehand; above zero.
        so_far: from which it goes on.
        independent_fraction: independent samples per sample, below 1 after a low-pass.
        tolerance: singular values that are smaller shares of the largest count as zero.
    """
    joints = len(information)
    weights = np.sqrt(independent_fraction) / np.asarray(noise_nm, dtype=float)
    size = parameter_scale(joints)
    rows = np.vstack(
        [w * piece.r[:, : len(size)] * size for w, piece in zip(weights, information, strict=True)]
    )
    columns = np.zeros((len(rows), joints))
    readings = np.concatenate([w * piece.z for w, piece in zip(weights, information, strict=True)])
    begin = 0
    for i, piece in enumerate(information):
        end = begin + len(piece.z)
        columns[begin:end, i] = weights[i] * (piece.r @ phi)
        begin = end
    (slopes, target), _ = without_range(rows, tolerance, (columns, readings))
    curvature = slopes.T @ slopes + np.eye(joints) / prior_sigma**2
    covariance = np.asarray(np.linalg.inv(curvature), dtype=np.float64)
    change = -covariance @ (slopes.T @ target + so_far.value / prior_sigma**2)
    value = so_far.value + change
    make_read_only((value, covariance))
    return TorqueScale(value, covariance)


def scaled(piece: JointInformation, scale: float) -> JointInformation:
    """Return rows as if the torques had been (1 + scale) times as large."""
    return piece._replace(z=(1.0 + scale) * piece.z, rest=(1.0 + scale) ** 2 * piece.rest)

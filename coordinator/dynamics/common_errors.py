"""Errors that come as a whole: of the chain that rows were computed with, and of the torque sensors' scale.

Noise averages out over thousands of rows; an error of the chain does not. Each of its directions, one
standard deviation long, makes other torques of the same motion: columns beside the regressor's, which widen
what is claimed (errors that are considered, but not estimated: Tapley, Schutz and Born 2004, Statistical
orbit determination, section 6.2).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from coordinator.dynamics.torque_scale import TorqueScale
from coordinator.kinematics.increments import apply_increment
from module_agent.dynamics.chain import Array, Chain
from module_agent.dynamics.differentiation import JointMotion
from module_agent.dynamics.information import JointInformation
from module_agent.dynamics.regressor import inverse_dynamics

# Of the largest variance of a chain's increments: less makes no difference.
_NEGLIGIBLE = 1e-8
_MOST_DIRECTIONS = 128


def chain_effects(chain: Chain, covariance: Array, phi: ArrayLike, motion: JointMotion) -> Array:
    """Return what errors of a chain, each of one deviation, do to a motion's torques, (m, n, k) [Nm].

    Args:
        chain: n joints. covariance: (6 n, 6 n) of its increments.
        phi: (10 n,) bodies.
        motion: (m, n).
    """
    values, vectors = np.linalg.eigh(covariance)
    kept = np.flatnonzero(values > _NEGLIGIBLE * max(values[-1], 0.0))[-_MOST_DIRECTIONS:]
    joints = motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2
    here = inverse_dynamics(chain, phi, *joints)
    found = [
        inverse_dynamics(apply_increment(chain, np.sqrt(values[k]) * vectors[:, k]), phi, *joints) - here
        for k in kept
    ]
    return np.stack(found, axis=2) if found else np.zeros((*here.shape, 0))


def scale_effects(information: Sequence[JointInformation], scale: TorqueScale) -> tuple[Array, ...]:
    """Return what torque sensors of a wrong scale add to the rows of every joint, (k_i, n) each [Nm].

    A sensor that shows (1 + s) of the torque makes all that its joint shows as much too large, which no
    motion tells from heavier bodies.
    """
    return tuple(piece.z[:, None] * own for piece, own in zip(information, scale.root, strict=True))


def whitened_effects(
    effects: Sequence[Array], sigma_nm: ArrayLike, independent_fraction: float = 1.0
) -> Array:
    """Return effects on the rows of all joints, (k, j), in standard deviations of the rows' noise.

    Args as `base_parameters.whitened`; effects: (k_i, j) of every joint.
    """
    weight = np.sqrt(independent_fraction) / np.asarray(sigma_nm, dtype=float)
    return np.vstack([w * one for w, one in zip(weight, effects, strict=True)])

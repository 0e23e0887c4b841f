"""Errors that come as a whole: of the chain that rows were computed with, and of the torque sensors' scale.

Noise averages out over thousands of rows; an error of the chain does not. Each of its directions, one
standard deviation long, makes other torques of the same motion: columns beside the regressor's, which widen
what is claimed (errors that are considered, but not estimated: Tapley, Schutz and Born 2004, Statistical
orbit determination, section 6.2).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from coordinator.parameter_fit.module_parts import bodies_from_parts, parts_of
from coordinator.parameter_fit.torque_sensor_scale import TorqueScale
from module_agent.model.chain import Array, Chain
from module_agent.model.information import JointInformation
from module_agent.model.perturbation import apply_perturbation
from module_agent.model.read_only import read_only
from module_agent.model.regressor import inverse_dynamics
from module_agent.signals.filtering import JointMotion

# Of the largest variance of a chain's increments: less makes no difference.
_NEGLIGIBLE = 1e-8
_MAX_DIRECTIONS = 128


def error_directions(covariance: Array) -> Array:
    """Return increments (6 n, k), read-only, each one deviation long, whose squares add to a covariance.

    Those too short to make a difference are left out.
    """
    values, vectors = np.linalg.eigh(covariance)
    kept = np.flatnonzero(values > _NEGLIGIBLE * max(values[-1], 0.0))[-_MAX_DIRECTIONS:]
    directions = np.asarray(vectors[:, kept] * np.sqrt(values[kept]))
    return read_only(directions)


def chain_effects(chain: Chain, covariance: Array, phi: ArrayLike, motion: JointMotion) -> Array:
    """Return what errors of a chain, each of one deviation, do to a motion's torques, (m, n, k) [Nm].

    The bodies stay where they are in the root frame, as one run tells them; what is told of the parts that
    they are made of moves with the chain (`body_shifts`).

    Args:
        chain: n joints. covariance: (6 n, 6 n) of its increments, k of whose
            `error_directions` matter.
        phi: (10 n,) bodies.
        motion: (m, n).
    """
    joints = motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2
    here = inverse_dynamics(chain, phi, *joints)
    effects = [
        inverse_dynamics(apply_perturbation(chain, one), phi, *joints) - here
        for one in error_directions(covariance).T
    ]
    return np.stack(effects, axis=2) if effects else np.zeros((*here.shape, 0))


def body_shifts(chain: Chain, directions: ArrayLike, phi_parts: ArrayLike) -> Array:
    """Return what errors of a chain do to bodies that are made of known parts, (10 n, k): (T' - T) phi_parts.

    A part is known in the frame of its module's IMU (`parts`), and goes wherever the chain takes that. With
    the rows r of `torque_regressor` an error of the chain does to the torque of given parts, to first order,

    ID(chain', T' phi_parts) - ID(chain, T phi_parts) = `chain_effects` + r (T' - T) phi_parts.

    Args:
        chain: n joints. directions: (6 n, k) increments.
        phi_parts: (20 n,) in the order of `parts_of([chain])`.
    """
    parts = parts_of([chain])
    here = bodies_from_parts(chain, parts)
    shifts = [
        (bodies_from_parts(apply_perturbation(chain, one), parts) - here) @ np.asarray(phi_parts, dtype=float)
        for one in np.asarray(directions, dtype=float).T
    ]
    return np.stack(shifts, axis=1) if shifts else np.zeros((len(here), 0))


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

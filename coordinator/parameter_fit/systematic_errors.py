"""Systematic errors: of the chain that rows were computed with, and of the torque sensors' scale.

Noise averages out over thousands of rows; an error of the chain does not. Each of its directions, one
standard deviation long, changes the torques of the same motion. These changes are columns that widen the
covariance (considered but not estimated parameters: Tapley, Schutz and Born 2004, Statistical orbit
determination, section 6.2).
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

# Of the largest variance of a chain's perturbation: smaller ones make no difference.
_NEGLIGIBLE = 1e-8
_MAX_DIRECTIONS = 128


def error_directions(covariance: Array) -> Array:
    """Return perturbations D (6 n, k), read-only, one standard deviation long, with D D^T the covariance.

    Negligible ones are left out.
    """
    values, vectors = np.linalg.eigh(covariance)
    kept = np.flatnonzero(values > _NEGLIGIBLE * max(values[-1], 0.0))[-_MAX_DIRECTIONS:]
    return read_only(np.asarray(vectors[:, kept] * np.sqrt(values[kept])))


def chain_effects(chain: Chain, covariance: Array, phi: ArrayLike, motion: JointMotion) -> Array:
    """Return the effects of a chain's errors, each one deviation long, on a motion's torques, (m, n, k) [Nm].

    The bodies are fixed in the root frame, as one run determines them; the parts that they are made of move
    with the chain (`body_shifts`).

    Args:
        chain: n joints. covariance: (6 n, 6 n) of its perturbation; it has k `error_directions`.
        phi: (10 n,) bodies.
        motion: (m, n).
    """
    joints, directions = (motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2), error_directions(covariance)
    here = inverse_dynamics(chain, phi, *joints)
    effects = np.empty((*here.shape, directions.shape[1]))
    for k, one in enumerate(directions.T):
        effects[..., k] = inverse_dynamics(apply_perturbation(chain, one), phi, *joints) - here
    return effects


def body_shifts(chain: Chain, directions: ArrayLike, phi_parts: ArrayLike) -> Array:
    """Return the effects of a chain's errors on bodies made of known parts, (10 n, k): (T' - T) phi_parts.

    A part is given in the frame of its module's IMU (`module_parts`) and moves with it. With the rows r of
    `torque_regressor` an error of the chain changes the torques of given parts, to first order, by

    ID(chain', T' phi_parts) - ID(chain, T phi_parts) = `chain_effects` + r (T' - T) phi_parts.

    Args:
        chain: n joints. directions: (6 n, k) perturbations.
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
    """Return the effects of torque sensors' scale errors on the rows of every joint, (k_i, n) each [Nm].

    The readings of a sensor are all too large by the same factor, which no motion can distinguish from
    heavier bodies.
    """
    return tuple(piece.z[:, None] * own for piece, own in zip(information, scale.root, strict=True))


def whitened_effects(
    effects: Sequence[Array], sigma_nm: ArrayLike, independent_fraction: float = 1.0
) -> Array:
    """Return effects on the rows of all joints, (k, j), whitened as the rows are.

    Args as `base_parameters.whitened`; effects: (k_i, j) of every joint.
    """
    weight = np.sqrt(independent_fraction) / np.asarray(sigma_nm, dtype=float)
    return np.vstack([w * one for w, one in zip(weight, effects, strict=True)])


def decorrelation(effects: ArrayLike) -> Array:
    """Return the symmetric W (k, k), read-only, with W (I + E E^T) W = I for whitened effects E (k, j).

    W times whitened rows and target are those of generalised least squares: what a systematic error can
    imitate counts no more than that error is likely. By E = U s V^T, W = I - U (1 - (1 + s^2)^(-1/2)) U^T.
    """
    left, values, _ = np.linalg.svd(np.asarray(effects, dtype=float), full_matrices=False)
    return read_only(np.eye(len(left)) - (left * (1.0 - (1.0 + values**2) ** -0.5)) @ left.T)

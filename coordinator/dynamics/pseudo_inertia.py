"""Pseudo-inertias: physical consistency of ten inertial parameters, and the nearest consistent body.

Parameters are physically consistent if some distribution of positive mass has them, which is the case exactly
if the pseudo-inertia matrix is positive definite (Wensing, Kim and Slotine 2018, Linear matrix inequalities
for physically consistent inertial parameter identification). This condition implies a positive mass, a
positive definite inertia about the centre of mass and the triangle inequality of its principal moments.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from module_agent.model.chain import Array
from module_agent.model.read_only import make_read_only

# Parameters in kg, kg m and kg m^2 have no common size. First moments are measured per 0.3 m and inertias per
# (0.3 m)^2, a usual reach of a module with its link, so that all are in kg. A scale per column of the
# regressor would enlarge columns of rounding errors, which would then count into the rank.
REACH_M = 0.3
_REACH = np.outer([REACH_M, REACH_M, REACH_M, 1.0], [REACH_M, REACH_M, REACH_M, 1.0])

# Half a gram at 0.3 m, 5e-5 kg m^2: below every module's inertia, and still far enough from singular for
# simulators that invert it.
MIN_EIGENVALUE_KG = 5e-4

_UPPER = np.triu_indices(3)


class Body(NamedTuple):
    """A rigid body: mass [kg], centre of mass (3,) [m], inertia about it (3, 3) [kg m^2]; read-only."""

    mass_kg: float
    com_m: Array
    inertia_kg_m2: Array


def pseudo_inertia(phi: ArrayLike) -> Array:
    """Return the (4, 4) integral of [r; 1] [r; 1]^T dm of ten parameters (order of thesis eq. 25)."""
    values = np.asarray(phi, dtype=float)
    inertia = np.zeros((3, 3))
    inertia[_UPPER] = inertia.T[_UPPER] = values[4:]
    pseudo = np.empty((4, 4))
    pseudo[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    pseudo[:3, 3] = pseudo[3, :3] = values[1:4]
    pseudo[3, 3] = values[0]
    return pseudo


def parameters(pseudo: ArrayLike) -> Array:
    """Return the ten parameters (10,) of a pseudo-inertia matrix: the inverse of `pseudo_inertia`."""
    matrix = np.asarray(pseudo, dtype=float)
    inertia = np.trace(matrix[:3, :3]) * np.eye(3) - matrix[:3, :3]
    return np.concatenate([[matrix[3, 3]], matrix[:3, 3], inertia[_UPPER]])


def parameter_transform(pose: ArrayLike) -> Array:
    """Return the matrix (10, 10) that transforms ten parameters from a frame at `pose` into the outer frame.

    The pseudo-inertia transforms by J' = T J T^T, T the pose (4, 4), which is linear in the parameters.
    """
    transform = np.asarray(pose, dtype=float)
    columns = [parameters(transform @ pseudo_inertia(unit) @ transform.T) for unit in np.eye(10)]
    return np.stack(columns, axis=1)


def smallest_eigenvalue(pseudo: ArrayLike) -> float:
    """Return the smallest eigenvalue of a pseudo-inertia matrix [kg], lengths counted in `REACH_M`."""
    return float(np.linalg.eigvalsh(_in_kg(pseudo))[0])


def is_consistent(pseudo: ArrayLike) -> bool:
    """Tell whether a pseudo-inertia matrix is positive definite beyond rounding.

    The bound scales with the body, because a small one about a far origin is legitimately near singular.
    """
    values = np.linalg.eigvalsh(_in_kg(pseudo))
    return bool(values[0] > 1e-9 * values[-1])


def nearest_consistent(pseudo: ArrayLike) -> Array:
    """Return the nearest consistent pseudo-inertia (4, 4): eigenvalues below `MIN_EIGENVALUE_KG` are raised
    to it.

    Nearest in the Frobenius norm with lengths in `REACH_M`, about the given origin. It is not the consistent
    body that explains the torques best.
    """
    values, vectors = np.linalg.eigh(_in_kg(pseudo))
    raised = vectors * np.maximum(values, MIN_EIGENVALUE_KG) @ vectors.T
    return np.asarray(raised * _REACH)


def body(pseudo: ArrayLike) -> Body:
    """Return mass, centre and inertia about the centre of a consistent pseudo-inertia matrix, in its axes."""
    matrix = np.asarray(pseudo, dtype=float)
    mass, centre = float(matrix[3, 3]), matrix[:3, 3] / matrix[3, 3]
    spread = matrix[:3, :3] - mass * np.outer(centre, centre)
    inertia = np.trace(spread) * np.eye(3) - spread
    make_read_only((centre, inertia))
    return Body(mass, centre, inertia)


def bodies_in_frames(pseudo: Array, homes: Array) -> tuple[Body, ...]:
    """Return bodies in frames of their own.

    Args:
        pseudo: (n, 4, 4) consistent pseudo-inertias in the root frame. homes: (n, 4, 4) poses of the frames
            in the root frame.
    """
    into = np.linalg.inv(homes)
    return tuple(body(own @ matrix @ own.T) for own, matrix in zip(into, pseudo, strict=True))


def _in_kg(pseudo: ArrayLike) -> Array:
    return np.asarray(np.asarray(pseudo, dtype=float) / _REACH)


def parameter_scale(bodies: int) -> Array:
    """Return the common sizes of parameters (10 n,): phi = scale * (parameters in kg).

    The columns of the regressor are multiplied by it.
    """
    return np.tile(REACH_M ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2], dtype=float), bodies)

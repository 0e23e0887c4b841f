"""The six parameters of the transform between two modules, from parent to child, with covariance.

X is the pose of the child's mounting face in the parent's moved face at q = 0: translation [mm] and rotation
vector [deg] in the parent's face. A parameter is unknown if it takes part in any unobservable
change of the robot; the covariance is zero along these changes.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from coordinator.kinematics.frames import distal_homes, proximal_homes
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.perturbation import adjoint, skew
from module_agent.model.read_only import frozen

Face = Literal["output", "housing"]
PARAMETERS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
# In m and rad, of changes of length 1: an unobservable turn may displace a face by a millimetre a radian.
TAKES_PART_ABOVE = 1e-3
_UNITS = np.repeat([1e3, 180.0 / np.pi], 3)


class LinkTransform(NamedTuple):
    """One link; arrays read-only.

    values: (6,) as in `PARAMETERS`. covariance: (6, 6) in their units. unknown: (6,) which of them take part
    in unobservable changes. null_directions: (6, k) those changes, orthonormal in their units.
    """

    parent: str
    child: str
    parent_face: Face
    child_face: Face
    values: Array
    covariance: Array
    unknown: tuple[bool, ...]
    null_directions: Array


def link_transforms(
    chain: Chain, types: Sequence[ModuleType], covariance: ArrayLike, null_basis: ArrayLike
) -> tuple[LinkTransform, ...]:
    """Return one transform per module that has a parent, in the order of the chain.

    covariance: (6 n, 6 n) of the chain's perturbations (`apply_perturbation`). null_basis: (6 n, k)
    unobservable perturbations of length 1. Exact motions (`null_space.Unresolved`) name parameters sharper
    than the null vectors of a noisy fit.

    Raises:
        ValueError: the arguments do not fit the chain.
    """
    count = len(chain.serials)
    spread, null = np.asarray(covariance, dtype=float), np.asarray(null_basis, dtype=float)
    if spread.shape != (6 * count, 6 * count) or null.ndim != 2 or null.shape[0] != 6 * count:
        raise ValueError(
            f"covariance of shape {spread.shape} and null basis of shape {null.shape} for {count} modules"
        )
    distal, proximal = distal_homes(chain, types), proximal_homes(chain, types)
    return tuple(
        _transform(chain, k, distal[parent], proximal[k], spread, null)
        for k, parent in enumerate(chain.parent)
        if parent != BASE
    )


def _transform(
    chain: Chain, child: int, from_face: Array, to_face: Array, covariance: Array, null_basis: Array
) -> LinkTransform:
    parent = chain.parent[child]
    pose = np.asarray(np.linalg.solve(from_face, to_face), dtype=np.float64)
    local = adjoint(np.asarray(np.linalg.inv(from_face), dtype=np.float64))
    relative = np.zeros((6, covariance.shape[0]))
    relative[:, 6 * child : 6 * child + 6] = local
    relative[:, 6 * parent : 6 * parent + 6] -= local
    slope = parameter_slope(pose) @ relative
    null, near = _null_directions(slope / _UNITS[:, None] @ null_basis)
    far = _changed_by_turning(pose, relative @ null_basis)
    unknown = tuple(bool(one) for one in near | far)
    return LinkTransform(
        parent=chain.serials[parent],
        child=chain.serials[child],
        parent_face="housing" if chain.reversed[parent] else "output",
        child_face="output" if chain.reversed[child] else "housing",
        values=frozen(_UNITS * _parameters(pose)),
        covariance=frozen(slope @ covariance @ slope.T),
        unknown=unknown,
        null_directions=null,
    )


def parameter_slope(pose: Array) -> Array:
    """Return how the six parameters [mm, deg] of a pose (4, 4) grow with a twist from the left, (6, 6).

    d t = w x t + v; the rotation vector grows by the inverse left Jacobian of SO(3) (Sola et al. 2018, A
    micro Lie theory, eq. 146).
    """
    slope = np.zeros((6, 6))
    slope[:3, :3], slope[:3, 3:] = -skew(pose[:3, 3]), np.eye(3)
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    angle, matrix = float(np.linalg.norm(turn)), skew(turn)
    # 1 / a^2 - cot(a / 2) / (2 a), whose series begins with 1 / 12.
    factor = 1.0 / 12.0 if angle < 1e-4 else 1.0 / angle**2 - 0.5 / (angle * np.tan(0.5 * angle))
    slope[3:, :3] = np.eye(3) - 0.5 * matrix + factor * matrix @ matrix
    return np.asarray(_UNITS[:, None] * slope)


def _null_directions(seen: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the changes (6, k) [mm, deg] of the six parameters by null vectors, and which they change."""
    u, size, _ = np.linalg.svd(seen, full_matrices=False)
    moving = u[:, size > TAKES_PART_ABOVE]
    columns = _UNITS[:, None] * moving
    changed = np.linalg.norm(moving, axis=1) > TAKES_PART_ABOVE
    return frozen(columns / np.linalg.norm(columns, axis=0)), np.asarray(changed)


def _changed_by_turning(pose: Array, twists: Array) -> NDArray[np.bool_]:
    """Return which parameters (6,) of a pose change when unobservable turns, (6, k), go on for a radian.

    A place at the extreme of its circle has no slope: a face straight ahead in y keeps its y at first.
    """
    changed = np.zeros(6, dtype=bool)
    for twist in twists.T:
        angle = float(np.linalg.norm(twist[:3]))
        if angle > TAKES_PART_ABOVE:
            turned = RigidTransform.from_exp_coords(twist / angle).as_matrix() @ pose
            changed |= np.abs(_parameters(turned) - _parameters(pose)) > TAKES_PART_ABOVE
    return changed


def _parameters(pose: Array) -> Array:
    """Return place [m] and rotation vector [rad] of a pose, (6,)."""
    return np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()])

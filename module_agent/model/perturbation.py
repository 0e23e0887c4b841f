"""Small and finite changes of a chain: one twist per module, in the root frame.

An increment is (6 n,): for every module [rotation (3), translation (3)], the exponential coordinates of a
displacement of its housing in the root frame at q = 0, applied from the left; IMU and axis move with it.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from module_agent.model.chain import Array, Chain
from module_agent.model.read_only import frozen


def apply_perturbation(chain: Chain, delta: ArrayLike) -> Chain:
    """Return the chain with every module displaced by its twist in `delta` (6 n,), arrays read-only.

    Raises:
        ValueError: `delta` is not (6 n,).
    """
    count = len(chain.serials)
    # A copy: scipy takes no read-only arrays.
    twists = np.array(delta, dtype=float)
    if twists.shape != (6 * count,):
        raise ValueError(f"an increment of {count} modules has shape ({6 * count},), got {twists.shape}")
    moved = RigidTransform.from_exp_coords(twists.reshape(count, 6)).as_matrix()
    return chain._replace(
        axis=frozen(np.einsum("nij,nj->ni", moved[:, :3, :3], chain.axis)),
        point=frozen(np.einsum("nij,nj->ni", moved[:, :3, :3], chain.point) + moved[:, :3, 3]),
        imu_home=frozen(moved @ chain.imu_home),
    )


def perturbation_between(before: Chain, after: Chain) -> Array:
    """Return the twists (6 n,) that displace the housings of one chain to the other's."""
    moved = RigidTransform.from_matrix(after.imu_home) * RigidTransform.from_matrix(before.imu_home).inv()
    return np.asarray(moved.as_exp_coords()).reshape(-1)


def adjoint(pose: Array) -> Array:
    """Return the (..., 6, 6) adjoints of (..., 4, 4) poses, for twists as [rotation, translation]."""
    turn = pose[..., :3, :3]
    matrix = np.zeros((*pose.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = turn
    matrix[..., 3:, :3] = skew(pose[..., :3, 3]) @ turn
    return matrix


def skew(vector: Array) -> Array:
    """Return the (..., 3, 3) matrices with skew(v) w = v x w."""
    matrix = np.zeros((*vector.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -vector[..., 2], vector[..., 1], -vector[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = vector[..., 2], -vector[..., 1], vector[..., 0]
    return matrix


def cross(a: Array, b: Array) -> Array:
    """Return a x b (..., 3, m) along the last axis but one, broadcasting.

    Several times faster than `np.cross`, which moves its axes about.
    """
    ax, ay, az = a[..., 0, :], a[..., 1, :], a[..., 2, :]
    bx, by, bz = b[..., 0, :], b[..., 1, :], b[..., 2, :]
    first = ay * bz
    product = np.empty((*first.shape[:-1], 3, first.shape[-1]))
    np.subtract(first, az * by, out=product[..., 0, :])
    np.subtract(az * bx, ax * bz, out=product[..., 1, :])
    np.subtract(ax * by, ay * bx, out=product[..., 2, :])
    return product

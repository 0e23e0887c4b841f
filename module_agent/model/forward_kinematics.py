"""Forward kinematics of a `Chain` by the product of exponentials, vectorised over samples.

Body i moves by D_i(q) = D_parent(q) exp(S_i q_i), S_i the screw of joint i at q = 0 in the root frame (Lynch
and Park, Modern Robotics, eq. 4.14, applied down a tree). Displacements act on points in the root frame,
so no link frames are needed.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.read_only import read_only


def body_displacements(chain: Chain, q_rad: ArrayLike) -> Array:
    """Return how every body is displaced from where it is at q = 0.

    Args:
        chain: n joints.
        q_rad: (m, n) joint positions.

    Returns:
        (m, n, 4, 4) D_i(q), read-only: a point of body i that is at p for q = 0 is at D_i p. Root frame.

    Raises:
        ValueError: `q_rad` is not (m, n).
    """
    q = np.asarray(q_rad, dtype=float)
    joints = len(chain.serials)
    if q.ndim != 2 or q.shape[1] != joints:
        raise ValueError(f"q_rad has shape {q.shape}; a chain of {joints} joints needs (samples, {joints})")
    displacement = np.empty((*q.shape, 4, 4))
    for i, parent in enumerate(chain.parent):
        own = screw_motion(chain.axis[i], chain.point[i], q[:, i])
        displacement[:, i] = own if parent == BASE else displacement[:, parent] @ own
    return read_only(displacement)


def imu_poses(chain: Chain, q_rad: ArrayLike) -> Array:
    """Return the pose of every IMU, (m, n, 4, 4) in the root frame, read-only, for `q_rad` of shape (m, n).

    Raises:
        ValueError: `q_rad` is not (m, n).
    """
    displacement = body_displacements(chain, q_rad)
    poses = np.empty_like(displacement)
    for k in range(len(chain.serials)):
        body = chain.carrier(k)
        home = chain.imu_home[k]
        poses[:, k] = home if body == BASE else displacement[:, body] @ home
    return read_only(poses)


def screw_motion(axis: ArrayLike, point: ArrayLike, angle_rad: ArrayLike) -> Array:
    """Return the (m, 4, 4) turns by `angle_rad` (m,) about the line through `point` along the unit `axis`."""
    angle = np.asarray(angle_rad, dtype=float)
    turn = Rotation.from_rotvec(angle[:, None] * np.asarray(axis, dtype=float)).as_matrix()
    motion = np.zeros((angle.size, 4, 4))
    motion[:, :3, :3] = turn
    motion[:, :3, 3] = np.asarray(point) - turn @ np.asarray(point, dtype=float)
    motion[:, 3, 3] = 1.0
    return motion


def places_on_axes(chain: Chain) -> Array:
    """Return the point (n, 3) of every axis that is nearest to the module's own IMU, at q = 0; read-only.

    A chain's `point` may be anywhere on the axis; the module is there.
    """
    off = chain.imu_home[:, :3, 3] - chain.point
    nearest = chain.point + np.einsum("ni,ni->n", off, chain.axis)[:, None] * chain.axis
    return read_only(nearest)

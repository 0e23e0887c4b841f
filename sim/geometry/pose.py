"""Rigid transforms as read-only 4x4 matrices."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from module_agent.model.read_only import read_only

Array = NDArray[np.float64]


def pose(
    xyz_m: Sequence[float] | Array = (0.0, 0.0, 0.0), rpy_rad: Sequence[float] | Array = (0.0, 0.0, 0.0)
) -> Array:
    """Return the 4x4 transform "rotate, then translate"; roll, pitch, yaw about fixed x, y, z as in URDF."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", rpy_rad).as_matrix()
    matrix[:3, 3] = xyz_m
    return read_only(matrix)


def inverse(transform: Array) -> Array:
    """Return the inverse of a rigid transform, shape (4, 4)."""
    rotation = transform[:3, :3].T
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ transform[:3, 3]
    return read_only(matrix)

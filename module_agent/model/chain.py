"""The kinematic model of a robot as a tree of screws (product of exponentials), read-only arrays.

Body `i` is everything rigid together on the distal side of joint `i`. All vectors are in the root frame,
which is the housing frame of the first root module with every joint at q = 0.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Chain(NamedTuple):
    """A tree of n revolute joints in the order of `serials`; a parent comes before its children.

    parent: index of the parent module, -1 for a module on the base.
    reversed: whether the module is mounted by its output, so that its housing (with the IMU) turns.
    axis: (n, 3) unit vectors at q = 0; beyond joint i all turns about axis[i] when its position grows.
    point: (n, 3) a point on each axis at q = 0 [m].
    imu_home: (n, 4, 4) pose of every IMU at q = 0.
    gravity: (3,) the specific force of rest, pointing up, about 9.81 m/s^2 long.
    """

    serials: tuple[str, ...]
    parent: tuple[int, ...]
    reversed: tuple[bool, ...]
    axis: Array
    point: Array
    imu_home: Array
    gravity: Array

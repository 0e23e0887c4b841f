"""Convex shapes that bodies touch with."""

from typing import Literal, NamedTuple

import numpy as np

from module_agent.model.read_only import read_only
from sim.geometry.pose import Array


class Shape(NamedTuple):
    """A box, cylinder, sphere or half-space, posed in some body's frame.

    pose: (4, 4) of the shape's centre; a cylinder lies along z, a half-space fills z < 0.
    size_m: edges of a box, radius and length of a cylinder, radius of a sphere, nothing of a half-space.
    """

    kind: Literal["box", "cylinder", "sphere", "plane"]
    pose: Array
    size_m: tuple[float, ...] = ()

    def seen_from(self, frame: Array) -> "Shape":
        """Return the shape with its pose in another frame, given the pose (4, 4) of the present one in it."""
        return self._replace(pose=read_only(frame @ self.pose))


def box_between(low_m: Array, high_m: Array) -> Shape:
    """Return the box with two opposite corners (3,), parallel to the axes."""
    centre = np.eye(4)
    centre[:3, 3] = (low_m + high_m) / 2.0
    x, y, z = (float(v) for v in high_m - low_m)
    return Shape("box", read_only(centre), (x, y, z))

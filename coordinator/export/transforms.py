"""The transforms of a robot description: where every joint's child frame is in its parent's."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from coordinator.description.urdf_reader import URDF_JOINT, UrdfJoint, read_joints
from module_agent.model.chain import Array


class Transform(NamedTuple):
    """A child frame in its parent's: translation [m], and rotation as a unit quaternion (x, y, z, w)."""

    parent: str
    child: str
    translation_m: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


class Transforms(NamedTuple):
    """The joints of a robot description: `fixed` ones do not move; `moving` are by their modules' serials."""

    fixed: tuple[Transform, ...]
    moving: dict[str, UrdfJoint]


def robot_transforms(urdf: str | None) -> Transforms:
    """Return the transforms of a robot description; none without one.

    Raises:
        UrdfError: it cannot be read.
    """
    joints = read_joints(urdf) if urdf is not None else ()
    fixed = tuple(
        transform for joint in joints if not joint.moves for transform in turned(joint, np.zeros(1))
    )
    return Transforms(fixed, {joint.name.removeprefix(URDF_JOINT): joint for joint in joints if joint.moves})


def turned(joint: UrdfJoint, q_rad: Array) -> Iterator[Transform]:
    """Yield the transform of a joint's child at each position (m,)."""
    x, y, z = joint.pose[:3, 3].tolist()
    rotations = Rotation.from_matrix(joint.pose[:3, :3]) * Rotation.from_rotvec(np.outer(q_rad, joint.axis))
    for rotation in rotations.as_quat().tolist():
        yield Transform(joint.parent, joint.child, (x, y, z), tuple(rotation))

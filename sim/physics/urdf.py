"""A robot's rigid bodies as URDF text, for physics engines: joints and inertia, no shapes."""

import numpy as np
from scipy.spatial.transform import Rotation

from sim.pose import Array
from sim.rigid_body import RigidBody
from sim.robot_tree import RobotTree


def urdf_text(name: str, tree: RobotTree) -> str:
    """Return the robot at q = 0 as URDF; joint and link i are called after serial i, the fixed base `world`.

    Floats are written by `repr`, so nothing is lost, and a joint's coordinate is the module's position.
    """
    rows = [f'<robot name="{name}">', '<link name="world"/>']
    for i, serial in enumerate(tree.serials):
        parent = "world" if tree.parent[i] < 0 else tree.serials[tree.parent[i]]
        rows += [
            f'<link name="{serial}">{_inertial(tree.bodies[i])}</link>',
            f'<joint name="joint-{serial}" type="continuous">',
            f'<parent link="{parent}"/><child link="{serial}"/>{_origin(tree.origin[i])}',
            f'<axis xyz="0 0 {float(tree.axis_sign[i])!r}"/></joint>',
        ]
    return "\n".join([*rows, "</robot>"])


def _numbers(values: Array) -> str:
    return " ".join(repr(float(v)) for v in values)


def _origin(transform: Array) -> str:
    rpy = Rotation.from_matrix(transform[:3, :3]).as_euler("xyz", suppress_warnings=True)
    return f'<origin xyz="{_numbers(transform[:3, 3])}" rpy="{_numbers(rpy)}"/>'


def _inertial(body: RigidBody) -> str:
    # Principal moments and axes: the engine would otherwise diagonalise the tensor itself, to 1e-6 only.
    moments, axes = np.linalg.eigh(body.inertia_kg_m2)
    if np.linalg.det(axes) < 0.0:
        axes = -axes
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = axes, body.com_m
    ixx, iyy, izz = (repr(float(m)) for m in moments)
    return (
        f'<inertial>{_origin(frame)}<mass value="{body.mass_kg!r}"/>'
        f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )

"""A skeleton as URDF text, for physics engines: joints and inertia, and shapes where they may touch."""

import numpy as np
from scipy.spatial.transform import Rotation

from sim.geometry.pose import Array
from sim.geometry.rigid_body import RigidBody
from sim.geometry.shape import Shape
from sim.physics.contact import collision_text
from sim.physics.skeleton import Skeleton

# Physics engines take lower > upper for "no limits", which a sliding joint cannot leave out.
_NO_LIMIT = '<limit lower="1" upper="-1" effort="1e9" velocity="1e9"/>'


def urdf_text(name: str, skeleton: Skeleton, shapes: bool = False) -> str:
    """Return the robot with all joints at 0 as URDF; link i is called after body i, the fixed base `world`.

    Floats are written by `repr`, so nothing is lost, and a joint's coordinate is the skeleton's. `shapes`
    adds what the bodies touch with.
    """
    fixed = _collisions(skeleton.fixed_shapes) if shapes else ""
    rows = [f'<robot name="{name}">', f'<link name="world">{fixed}</link>']
    for i, body in enumerate(skeleton.names):
        parent = "world" if skeleton.parent[i] < 0 else skeleton.names[skeleton.parent[i]]
        touching = _collisions(skeleton.shapes[i]) if shapes else ""
        kind, limit = ("prismatic", _NO_LIMIT) if skeleton.prismatic[i] else ("continuous", "")
        rows += [
            f'<link name="{body}">{_inertial(skeleton.bodies[i])}{touching}</link>',
            f'<joint name="{joint_name(body)}" type="{kind}">',
            f'<parent link="{parent}"/><child link="{body}"/>{_origin(skeleton.origin[i])}{limit}',
            f'<axis xyz="0 0 {float(skeleton.axis_sign[i])!r}"/></joint>',
        ]
    return "\n".join([*rows, "</robot>"])


def joint_name(body: str) -> str:
    """Return the name of the joint that moves a body."""
    return f"joint-{body}"


def _collisions(shapes: tuple[Shape, ...]) -> str:
    return "".join(collision_text(shape, _origin(shape.pose)) for shape in shapes)


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

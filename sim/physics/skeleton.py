"""All joints of the simulated robot: those of its modules, and the passive ones of its compliant structure.

A passive joint is a spring with a damper in one direction. Passive joints come before the joint that they
carry, so the order stays depth first, as physics engines number their links.
"""

from typing import NamedTuple

import numpy as np

from module_agent.model.read_only import read_only
from sim.geometry.pose import Array, inverse, pose
from sim.geometry.rigid_body import RigidBody, joined, moved
from sim.geometry.shape import Shape
from sim.robot.robot_file import BASE, BaseCompliance, Robot
from sim.robot.robot_tree import Segment, build_tree

# Physics engines need a body between two passive joints at one place; its mass is far below all others.
_LIGHT = RigidBody(1e-6, read_only(np.zeros(3)), read_only(np.eye(3) * 1e-10))
_AXES = "xyz"


class Skeleton(NamedTuple):
    """A tree of m joints and as many bodies, parents before children.

    Body i turns or slides with joint i. Its frame has its origin on the joint and its z along the joint.

    names: the bodies' names: the serial for a module's joint, such as `base/x` or `X-1/flex1-z` for others.
    parent: (m,) the parent body, -1 for the world. prismatic: (m,) whether a joint slides.
    axis_sign: (m,) the direction along z in which a joint's position grows.
    origin: (m, 4, 4) the bodies' frames in their parents' (the world for -1) with all joints at 0.
    module: (n,) the modules' joints. passive: (p,) the others.
    stiffness, damping: (p,) of the passive joints [N/m, N s/m] or [Nm/rad, Nm s/rad].
    imu_body: (n,) the body that carries a module's IMU, -1 for the world. imu_pose: (n, 4, 4) its pose there.
    gravity_m_s2: along -z of the world.
    shapes: of every body, in its frame; they count where there is something to touch. fixed_shapes: of what
        does not move at all, in the world.
    """

    names: tuple[str, ...]
    parent: tuple[int, ...]
    prismatic: tuple[bool, ...]
    axis_sign: Array
    origin: Array
    bodies: tuple[RigidBody, ...]
    module: tuple[int, ...]
    passive: tuple[int, ...]
    stiffness: Array
    damping: Array
    imu_body: tuple[int, ...]
    imu_pose: Array
    gravity_m_s2: float
    shapes: tuple[tuple[Shape, ...], ...]
    fixed_shapes: tuple[Shape, ...]


class _Joint(NamedTuple):
    """A joint, its bodies and their shapes; frame, bodies and shapes in the world, with all joints at 0."""

    name: str
    parent: int
    home: Array
    bodies: list[RigidBody]
    shapes: list[Shape]
    sign: float = 1.0
    prismatic: bool = False
    spring: tuple[float, float] | None = None


def build_skeleton(robot: Robot, base_shake: float = 0.0, link_flex: float = 0.0) -> Skeleton:
    """Return the joints of a robot whose base's and links' compliance is multiplied by the given factors.

    A factor of 0 means rigid. Damping shrinks with the root of the stiffness, so the damping ratio stays.
    """
    tree = build_tree(robot)
    joints: list[_Joint] = []
    fixed: list[Shape] = []
    ground = -1
    if robot.base.compliance is not None and base_shake > 0.0:
        ground = _hang_base(joints, robot.base.compliance, robot.base.world_pose, base_shake)
    module: list[int] = []
    carrier: list[int] = []
    for i, p in enumerate(tree.parent):
        held = ground if p < 0 else module[p]
        for number, segment in enumerate(tree.segments[i]):
            held = _hang_segment(joints, held, f"{tree.serials[i]}/flex{number}", segment, link_flex)
            (joints[held].shapes if held >= 0 else fixed).extend(segment.shapes)
        carrier.append(held)
        module.append(len(joints))
        own, sign = [tree.moved[i]], float(tree.axis_sign[i])
        joints.append(
            _Joint(tree.serials[i], held, tree.output[i], own, list(tree.moved_shapes[i]), sign=sign)
        )
    imu_body = [own if back else c for own, c, back in zip(module, carrier, tree.reversed, strict=True)]
    springs = [joint.spring for joint in joints if joint.spring is not None]

    def relative_to(body: int, transform: Array) -> Array:
        return transform if body < 0 else inverse(joints[body].home) @ transform

    return Skeleton(
        names=tuple(joint.name for joint in joints),
        parent=tuple(joint.parent for joint in joints),
        prismatic=tuple(joint.prismatic for joint in joints),
        axis_sign=read_only(np.array([joint.sign for joint in joints])),
        origin=read_only(np.array([relative_to(joint.parent, joint.home) for joint in joints])),
        bodies=tuple(
            moved(joined(joint.bodies), inverse(joint.home)) if joint.bodies else _LIGHT for joint in joints
        ),
        module=tuple(module),
        passive=tuple(i for i, joint in enumerate(joints) if joint.spring is not None),
        stiffness=read_only(np.array([stiffness for stiffness, _ in springs])),
        damping=read_only(np.array([damping for _, damping in springs])),
        imu_body=tuple(imu_body),
        imu_pose=read_only(
            np.array([relative_to(b, h) for b, h in zip(imu_body, tree.imu_home, strict=True)])
        ),
        gravity_m_s2=tree.gravity_m_s2,
        shapes=tuple(tuple(one.seen_from(inverse(joint.home)) for one in joint.shapes) for joint in joints),
        fixed_shapes=tuple(fixed),
    )


def _hang_base(joints: list[_Joint], given: BaseCompliance, base: Array, factor: float) -> int:
    """Add the directions in which the base gives; return the last one."""
    place = base @ pose(given.pivot_m)
    directions = (
        (True, "", given.stiffness_n_m, given.damping_n_s_m),
        (False, "r", given.stiffness_nm_rad, given.damping_nm_s_rad),
    )
    for prismatic, prefix, stiffness, damping in directions:
        for axis in np.flatnonzero(stiffness):
            name, spring = f"{BASE}/{prefix}{_AXES[axis]}", _softened(stiffness[axis], damping[axis], factor)
            home = place @ _Z_ALONG[axis]
            joints.append(_Joint(name, len(joints) - 1, home, [], [], prismatic=prismatic, spring=spring))
    joints[-1].bodies.append(moved(given.body, base))
    return len(joints) - 1


def _hang_segment(joints: list[_Joint], held: int, name: str, segment: Segment, factor: float) -> int:
    """Add the directions in which a segment's hinge gives; return the body that the segment belongs to."""
    hinge = segment.hinge
    if hinge is not None and factor > 0.0:
        for axis in np.flatnonzero(hinge.stiffness_nm_rad):
            spring = _softened(hinge.stiffness_nm_rad[axis], hinge.damping_nm_s_rad[axis], factor)
            joints.append(
                _Joint(f"{name}-{_AXES[axis]}", held, hinge.pose @ _Z_ALONG[axis], [], [], spring=spring)
            )
            held = len(joints) - 1
    if held >= 0:
        joints[held].bodies.append(segment.body)
    return held


def _softened(stiffness: float, damping: float, factor: float) -> tuple[float, float]:
    return stiffness / factor, damping / factor**0.5


def _z_along(axis: int) -> Array:
    """Return the rotation that takes z to an axis: a cyclic permutation."""
    turn = np.eye(4)
    turn[:3, :3] = np.roll(np.eye(3), axis + 1, axis=0)
    return read_only(turn)


_Z_ALONG = tuple(map(_z_along, range(3)))

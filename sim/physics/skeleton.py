"""All joints of the simulated robot: those of its modules, and the passive ones of its compliant structure.

A passive joint is a spring with a damper in one direction. Passive joints come before the joint that they
carry, so the order stays depth first, as physics engines number their links.
"""

from typing import NamedTuple

import numpy as np

from module_agent.model.read_only import read_only
from sim.geometry.link_parts import Hinge
from sim.geometry.pose import Array, inverse, pose
from sim.geometry.rigid_body import RigidBody, joined, moved, tensor
from sim.robot.robot_file import BASE, BaseCompliance, Robot
from sim.robot.robot_tree import RobotTree, Segment, build_tree

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


def build_skeleton(robot: Robot, base_shake: float = 0.0, link_flex: float = 0.0) -> Skeleton:
    """Return the joints of a robot whose base's and links' compliance is multiplied by the given factors.

    A factor of 0 means rigid. Damping shrinks with the root of the stiffness, so the damping ratio stays.
    """
    tree = build_tree(robot)
    frame = _Frame()
    ground = -1
    if robot.base.compliance is not None and base_shake > 0.0:
        ground = _hang_base(frame, robot.base.compliance, robot.base.world_pose, base_shake)
    joint: list[int] = []
    carrier: list[int] = []
    for i, p in enumerate(tree.parent):
        held = ground if p < 0 else joint[p]
        for number, segment in enumerate(tree.segments[i]):
            held = _hang_segment(frame, held, f"{tree.serials[i]}/flex{number}", segment, link_flex)
        carrier.append(held)
        joint.append(frame.add(tree.serials[i], held, tree.home[i], sign=float(tree.axis_sign[i])))
        frame.pieces[-1].append(tree.moved[i])
    bodies = [j if back else c for j, c, back in zip(joint, carrier, tree.reversed, strict=True)]
    return frame.skeleton(tree, joint, bodies)


def _hang_base(frame: "_Frame", given: BaseCompliance, base: Array, factor: float) -> int:
    place = base @ pose(given.pivot_m)
    last = -1
    directions = (
        (True, "", given.stiffness_n_m, given.damping_n_s_m),
        (False, "r", given.stiffness_nm_rad, given.damping_nm_s_rad),
    )
    for prismatic, prefix, stiffness, damping in directions:
        for axis in (a for a in range(3) if stiffness[a] > 0.0):
            name = f"{BASE}/{prefix}{_AXES[axis]}"
            last = frame.add(name, last, place @ _Z_ALONG[axis], prismatic)
            frame.add_spring(stiffness[axis], damping[axis], factor)
    body = RigidBody(given.mass_kg, read_only(np.array(given.com_xyz_m)), tensor(*given.inertia))
    frame.pieces[last].append(moved(body, base))
    return last


def _hang_segment(frame: "_Frame", held: int, name: str, segment: Segment, factor: float) -> int:
    if segment.hinge is not None and factor > 0.0:
        hinge: Hinge = segment.hinge
        for axis in np.flatnonzero(hinge.stiffness_nm_rad):
            held = frame.add(f"{name}-{_AXES[axis]}", held, hinge.pose @ _Z_ALONG[axis])
            frame.add_spring(hinge.stiffness_nm_rad[axis], hinge.damping_nm_s_rad[axis], factor)
    if held >= 0:
        frame.pieces[held].append(segment.body)
    return held


def _z_along() -> tuple[Array, Array, Array]:
    """Return the rotations that take z to x, y and z: cyclic permutations of the axes."""
    turns = []
    for axis in range(3):
        turn = np.eye(4)
        turn[:3, :3] = np.roll(np.eye(3), axis + 1, axis=0)
        turns.append(read_only(turn))
    return turns[0], turns[1], turns[2]


_Z_ALONG = _z_along()


class _Frame:
    """Accumulates the joints of a skeleton; poses and bodies in the world."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.parent: list[int] = []
        self.prismatic: list[bool] = []
        self.sign: list[float] = []
        self.home: list[Array] = []
        self.pieces: list[list[RigidBody]] = []
        self.springs: list[tuple[int, float, float]] = []

    def add(self, name: str, parent: int, home: Array, prismatic: bool = False, sign: float = 1.0) -> int:
        self.names.append(name)
        self.parent.append(parent)
        self.prismatic.append(prismatic)
        self.sign.append(sign)
        self.home.append(home)
        self.pieces.append([])
        return len(self.names) - 1

    def add_spring(self, stiffness: float, damping: float, factor: float) -> None:
        """Make the last joint a passive spring, softer by `factor`."""
        self.springs.append((len(self.names) - 1, stiffness / factor, damping / factor**0.5))

    def _relative_to(self, body: int, transform: Array) -> Array:
        return transform if body < 0 else inverse(self.home[body]) @ transform

    def skeleton(self, tree: RobotTree, module: list[int], imu_body: list[int]) -> Skeleton:
        passive, stiffness, damping = zip(*self.springs, strict=True) if self.springs else ((), (), ())
        pairs = zip(self.parent, self.home, strict=True)
        imus = zip(imu_body, tree.housing, tree.types, strict=True)
        return Skeleton(
            names=tuple(self.names),
            parent=tuple(self.parent),
            prismatic=tuple(self.prismatic),
            axis_sign=read_only(np.array(self.sign)),
            origin=read_only(np.array([self._relative_to(p, home) for p, home in pairs])),
            bodies=tuple(
                moved(joined(own), inverse(home)) if own else _LIGHT
                for own, home in zip(self.pieces, self.home, strict=True)
            ),
            module=tuple(module),
            passive=tuple(passive),
            stiffness=read_only(np.array(stiffness)),
            damping=read_only(np.array(damping)),
            imu_body=tuple(imu_body),
            imu_pose=read_only(
                np.array([self._relative_to(b, h @ pose(kind.imu_xyz)) for b, h, kind in imus])
            ),
            gravity_m_s2=tree.gravity_m_s2,
        )

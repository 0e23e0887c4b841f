"""Rigid bodies, joints and IMU poses of a robot, from its file: the simulation's true model.

Body i is everything rigid together on the distal side of joint i. Its frame has its origin on the joint's
axis and is parallel to the module's output frame at q = 0; the world has z up.
"""

from typing import NamedTuple

import numpy as np

from module_agent.model.catalogue import ModuleType, module_type
from module_agent.model.chain import Chain
from module_agent.model.read_only import read_only
from sim.geometry.link_parts import Hinge, Part, placed
from sim.geometry.pose import Array, inverse, pose
from sim.geometry.rigid_body import RigidBody, joined, moved, negative, parameters, tensor
from sim.robot.robot_file import Module, Robot

_FLANGE_KG, _FLANGE_RADIUS_M, _FLANGE_HEIGHT_M = 0.030, 0.018, 0.006


class Segment(NamedTuple):
    """A rigid segment of a link, in the world at q = 0: its body, and the hinge at its proximal end.

    Without a hinge it is fixed to the segment before it, or to the parent's body.
    """

    body: RigidBody
    hinge: Hinge | None


class RobotTree(NamedTuple):
    """A tree of n bodies, parents before children; poses are in the world at q = 0.

    The bodies, and all that refers to them, are those of the rigid robot; `segments` describe its compliance.

    types: the modules' catalogue entries.
    parent: index of the parent body, -1 for the fixed base.
    axis_sign: (n,) the joint's axis is this times the z axis of the body's frame.
    home: (n, 4, 4) the bodies' frames. origin: (n, 4, 4) the same in the parent's frame (the world for -1).
    bodies: every body's mass and inertia in its own frame.
    housing: (n, 4, 4) the modules' housing frames. output: (n, 4, 4) their output frames.
    imu_body: the body that carries module i's IMU, -1 for the base. imu_pose: (n, 4, 4) its pose therein.
    way: for every module the corners of its link, (k, 3), from the parent's distal frame to its own.
    moved: for every module what its joint alone turns (flange, or housing if reversed), in the world.
    segments: for every module the segments of its link, its own held part in the last of them.
    gravity_m_s2: gravity along -z of the world.
    """

    serials: tuple[str, ...]
    types: tuple[ModuleType, ...]
    parent: tuple[int, ...]
    reversed: tuple[bool, ...]
    axis_sign: Array
    home: Array
    origin: Array
    bodies: tuple[RigidBody, ...]
    housing: Array
    output: Array
    imu_body: tuple[int, ...]
    imu_pose: Array
    way: tuple[Array, ...]
    moved: tuple[RigidBody, ...]
    segments: tuple[tuple[Segment, ...], ...]
    gravity_m_s2: float


def flange(kind: ModuleType) -> RigidBody:
    """Return the body that turns with a module's output, in the output frame: a small disc below its face."""
    across = _FLANGE_KG * (3 * _FLANGE_RADIUS_M**2 + _FLANGE_HEIGHT_M**2) / 12
    along = _FLANGE_KG * _FLANGE_RADIUS_M**2 / 2
    com = read_only(np.array([0.0, 0.0, -_FLANGE_HEIGHT_M / 2]))
    return RigidBody(_FLANGE_KG, com, tensor(across, across, along, 0.0, 0.0, 0.0))


def housing(kind: ModuleType) -> RigidBody:
    """Return a module without its flange, in the housing frame; the sum of both is the catalogue's body."""
    whole = RigidBody(kind.mass_kg, read_only(np.array(kind.com_xyz)), tensor(*kind.inertia))
    return joined([whole, negative(moved(flange(kind), pose(kind.output_xyz)))])


def build_tree(robot: Robot) -> RobotTree:
    """Return the tree of a robot."""
    housings: list[Array] = []
    outputs: list[Array] = []
    links: list[_Link] = []
    own: list[RigidBody] = []
    for module, p in zip(robot.modules, robot.parents, strict=True):
        here = robot.base.world_pose
        if p >= 0:
            here = housings[p] if robot.modules[p].mounted == "reversed" else outputs[p]
        link = _Link(here, module)
        here = link.end
        kind = module_type(module.type)
        backwards = module.mounted == "reversed"
        across = pose(kind.output_xyz)
        housings.append(here @ inverse(across) if backwards else here)
        outputs.append(here if backwards else here @ across)
        both = moved(housing(kind), housings[-1]), moved(flange(kind), outputs[-1])
        link.add(both[1] if backwards else both[0])
        carried = [] if module.payload is None else [placed(Part(pose=module.payload)).body]
        end = housings[-1] if backwards else outputs[-1]
        own.append(joined([both[0] if backwards else both[1], *(moved(body, end) for body in carried)]))
        links.append(link)
    return _tree(robot, np.array(housings), np.array(outputs), own, links)


class _Link:
    """Accumulates the parts of a link: its end so far, its corners, and its segments."""

    def __init__(self, start: Array, module: Module):
        self.end = start
        self._way = [start[:3, 3]]
        self._hinges: list[Hinge | None] = [None]
        self._pieces: list[list[RigidBody]] = [[]]
        if module.flex is not None:
            stiffness, damping = module.flex.stiffness_nm_rad, module.flex.damping_nm_s_rad
            self._hang(Hinge(start, np.array(stiffness), np.array(damping)))
        for part in map(placed, module.link):
            if module.flex is None and part.hinge is not None:
                self._hang(part.hinge._replace(pose=self.end @ part.hinge.pose))
            self.add(moved(part.body, self.end))
            self.end = self.end @ part.output
            self._way.append(self.end[:3, 3])

    def _hang(self, hinge: Hinge) -> None:
        if hinge.stiffness_nm_rad.any():
            self._hinges.append(hinge)
            self._pieces.append([])

    def add(self, body: RigidBody) -> None:
        self._pieces[-1].append(body)

    @property
    def way(self) -> Array:
        return read_only(np.array(self._way))

    @property
    def segments(self) -> tuple[Segment, ...]:
        return tuple(Segment(joined(p), h) for p, h in zip(self._pieces, self._hinges, strict=True))


def _tree(
    robot: Robot, housings: Array, outputs: Array, own: list[RigidBody], links: list[_Link]
) -> RobotTree:
    parent = robot.parents
    backwards = tuple(m.mounted == "reversed" for m in robot.modules)
    types = tuple(module_type(m.type) for m in robot.modules)
    imu_body = tuple(i if back else p for i, (back, p) in enumerate(zip(backwards, parent, strict=True)))
    imu_home = np.array([h @ pose(kind.imu_xyz) for h, kind in zip(housings, types, strict=True)])
    segments = tuple(link.segments for link in links)
    pieces = [[body] for body in own]
    for p, link in zip(parent, segments, strict=True):
        if p >= 0:
            pieces[p] += [segment.body for segment in link]

    def relative_to(body: int, transform: Array) -> Array:
        return transform if body < 0 else inverse(outputs[body]) @ transform

    return RobotTree(
        serials=robot.serials,
        types=types,
        parent=parent,
        reversed=backwards,
        axis_sign=read_only(np.where(backwards, -1.0, 1.0)),
        home=read_only(outputs),
        origin=read_only(np.array([relative_to(p, outputs[i]) for i, p in enumerate(parent)])),
        bodies=tuple(moved(joined(own), inverse(outputs[i])) for i, own in enumerate(pieces)),
        housing=read_only(housings),
        output=read_only(outputs),
        imu_body=imu_body,
        imu_pose=read_only(np.array([relative_to(b, imu_home[i]) for i, b in enumerate(imu_body)])),
        way=tuple(link.way for link in links),
        moved=tuple(own),
        segments=segments,
        gravity_m_s2=robot.base.gravity_m_s2,
    )


def true_chain(robot: Robot) -> Chain:
    """Return the kinematic truth in the root frame: the housing frame of the first module at q = 0."""
    tree = build_tree(robot)
    to_root = inverse(tree.housing[0])
    joints = to_root @ tree.home
    imu_in_housing = np.array([pose(kind.imu_xyz) for kind in tree.types])
    return Chain(
        serials=tree.serials,
        parent=tree.parent,
        reversed=tree.reversed,
        axis=read_only(joints[:, :3, 2] * tree.axis_sign[:, None]),
        point=read_only(joints[:, :3, 3]),
        imu_home=read_only(to_root @ tree.housing @ imu_in_housing),
        gravity=read_only(to_root[:3, :3] @ np.array([0.0, 0.0, robot.base.gravity_m_s2])),
    )


def true_inertia(robot: Robot) -> Array:
    """Return every body's [m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz] at q = 0, (n, 10), read-only.

    In the root frame and about its origin, in the order of the thesis' eq. 25.
    """
    tree = build_tree(robot)
    to_root = inverse(tree.housing[0])
    return read_only(
        np.array(
            [parameters(moved(b, to_root @ home)) for b, home in zip(tree.bodies, tree.home, strict=True)]
        )
    )

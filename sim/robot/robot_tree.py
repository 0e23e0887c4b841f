"""Rigid bodies, joints and IMU poses of a robot, from its file: the simulation's true model.

Body i is everything rigid together on the distal side of joint i. Its frame has its origin on the joint's
axis and is parallel to the module's output frame at q = 0; the world has z up.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from module_agent.model.catalogue import ModuleType, module_type
from module_agent.model.chain import Chain
from module_agent.model.read_only import read_only
from sim.geometry.link_parts import Hinge, placed
from sim.geometry.pose import Array, inverse, pose
from sim.geometry.rigid_body import RigidBody, joined, moved, negative, parameters, tensor
from sim.geometry.shape import Shape, box_between
from sim.robot.robot_file import Build, Module, Robot

AS_CATALOGUED = Build()


def _disc(mass_kg: float, radius_m: float, height_m: float) -> RigidBody:
    """Return a disc below the origin."""
    across = mass_kg * (3 * radius_m**2 + height_m**2) / 12
    com = read_only(np.array([0.0, 0.0, -height_m / 2]))
    return RigidBody(mass_kg, com, tensor(across, across, mass_kg * radius_m**2 / 2, 0.0, 0.0, 0.0))


# What turns with a module's output, in the output's frame.
FLANGE = _disc(0.030, 0.018, 0.006)


class Segment(NamedTuple):
    """A rigid segment of a link, in the world at q = 0: its body, its shapes, the hinge at its proximal end.

    Without a hinge it is fixed to the segment before it, or to the parent's body.
    """

    body: RigidBody
    shapes: tuple[Shape, ...]
    hinge: Hinge | None


class RobotTree(NamedTuple):
    """A tree of n bodies, parents before children; poses are in the world at q = 0.

    The bodies, and all that refers to them, are those of the rigid robot; `segments` describe its compliance.

    types: the modules' catalogue entries.
    parent: index of the parent body, -1 for the fixed base.
    axis_sign: (n,) the joint's axis is this times the z axis of the output's frame.
    bodies: every body's mass and inertia in its own frame, which is that of the module's output.
    housing: (n, 4, 4) the modules' housing frames. output: (n, 4, 4) their output frames.
    imu_home: (n, 4, 4) the IMUs.
    way: for every module the corners of its link, (k, 3), from the parent's distal frame to its own.
    moved: for every module what its joint alone turns (flange, or housing if reversed), in the world.
    moved_shapes: for every module the shapes of that, in the world.
    segments: for every module the segments of its link, its own held part in the last of them.
    gravity_m_s2: gravity along -z of the world.
    """

    serials: tuple[str, ...]
    types: tuple[ModuleType, ...]
    parent: tuple[int, ...]
    reversed: tuple[bool, ...]
    axis_sign: Array
    bodies: tuple[RigidBody, ...]
    housing: Array
    output: Array
    imu_home: Array
    way: tuple[Array, ...]
    moved: tuple[RigidBody, ...]
    moved_shapes: tuple[tuple[Shape, ...], ...]
    segments: tuple[tuple[Segment, ...], ...]
    gravity_m_s2: float


def housing(kind: ModuleType, build: Build = AS_CATALOGUED) -> RigidBody:
    """Return a module without its flange, in the housing frame; the sum of both is the whole module."""
    centre, factor = read_only(np.add(kind.com_xyz, build.com_xyz_m)), build.mass_factor
    whole = RigidBody(factor * kind.mass_kg, centre, read_only(factor * tensor(*kind.inertia)))
    return joined([whole, negative(moved(FLANGE, pose(kind.output_xyz)))])


def build_tree(robot: Robot) -> RobotTree:
    """Return the tree of a robot."""
    parent, types = robot.parents, tuple(module_type(m.type) for m in robot.modules)
    backwards = tuple(m.mounted == "reversed" for m in robot.modules)
    builds = [module.build or AS_CATALOGUED for module in robot.modules]
    housings: list[Array] = []
    outputs: list[Array] = []
    links: list[_Link] = []
    own: list[RigidBody] = []
    own_shapes: list[tuple[Shape, ...]] = []
    for module, p, kind, build, back in zip(robot.modules, parent, types, builds, backwards, strict=True):
        start = robot.base.world_pose
        if p >= 0:
            start = housings[p] if backwards[p] else outputs[p]
        link = _Link(start, module)
        across = _displaced(build.axis_xyz_m, build.axis_turn_rad) @ pose(kind.output_xyz)
        housings.append(link.end @ inverse(across) if back else link.end)
        outputs.append(link.end if back else link.end @ across)
        both = moved(housing(kind, build), housings[-1]), moved(FLANGE, outputs[-1])
        held, turned = reversed(both) if back else both
        # A flange is within its housing's envelope.
        case = (_envelope(kind).seen_from(housings[-1]),)
        link.add(held, () if back else case)
        end = housings[-1] if back else outputs[-1]
        carried = [] if module.payload is None else [moved(module.payload.body, end)]
        shapes = () if module.payload is None else module.payload.shapes
        own_shapes.append((*(case if back else ()), *(one.seen_from(end) for one in shapes)))
        own.append(joined([turned, *carried]))
        links.append(link)
    imus = [
        home @ pose(kind.imu_xyz) @ _displaced(build.imu_xyz_m, build.imu_turn_rad)
        for home, kind, build in zip(housings, types, builds, strict=True)
    ]
    segments = tuple(link.segments() for link in links)
    pieces = [[body] for body in own]
    for p, link_segments in zip(parent, segments, strict=True):
        if p >= 0:
            pieces[p] += [segment.body for segment in link_segments]
    return RobotTree(
        serials=robot.serials,
        types=types,
        parent=parent,
        reversed=backwards,
        axis_sign=read_only(np.where(backwards, -1.0, 1.0)),
        bodies=tuple(moved(joined(b), inverse(home)) for b, home in zip(pieces, outputs, strict=True)),
        housing=read_only(np.array(housings)),
        output=read_only(np.array(outputs)),
        imu_home=read_only(np.array(imus)),
        way=tuple(read_only(np.array(link.way)) for link in links),
        moved=tuple(own),
        moved_shapes=tuple(own_shapes),
        segments=segments,
        gravity_m_s2=robot.base.gravity_m_s2,
    )


class _Link:
    """Accumulates the parts of a link: its end so far, its corners, and its segments."""

    def __init__(self, start: Array, module: Module):
        self.end = start
        self.way = [start[:3, 3]]
        self._pieces: list[tuple[list[RigidBody], list[Shape], Hinge | None]] = [([], [], None)]
        if module.flex is not None:
            stiffness, damping = module.flex.stiffness_nm_rad, module.flex.damping_nm_s_rad
            self._hang(Hinge(start, np.array(stiffness), np.array(damping)))
        for part in map(placed, module.link):
            if module.flex is None and part.hinge is not None:
                self._hang(part.hinge._replace(pose=self.end @ part.hinge.pose))
            self.add(moved(part.body, self.end), tuple(one.seen_from(self.end) for one in part.shapes))
            self.end = self.end @ part.output
            self.way.append(self.end[:3, 3])

    def _hang(self, hinge: Hinge) -> None:
        if hinge.stiffness_nm_rad.any():
            self._pieces.append(([], [], hinge))

    def add(self, body: RigidBody, shapes: tuple[Shape, ...]) -> None:
        self._pieces[-1][0].append(body)
        self._pieces[-1][1].extend(shapes)

    def segments(self) -> tuple[Segment, ...]:
        return tuple(Segment(joined(bodies), tuple(shapes), hinge) for bodies, shapes, hinge in self._pieces)


def _envelope(kind: ModuleType) -> Shape:
    return box_between(np.array(kind.housing_min_xyz), np.array(kind.housing_max_xyz))


def _displaced(xyz_m: tuple[float, float, float], turn_rad: tuple[float, float, float]) -> Array:
    """Return a pose from a displacement and a rotation vector."""
    moved_by = np.eye(4)
    moved_by[:3, :3], moved_by[:3, 3] = Rotation.from_rotvec(turn_rad).as_matrix(), xyz_m
    return moved_by


def _nominal_housings(tree: RobotTree) -> Array:
    """Return the poses (n, 4, 4) of housings as catalogued on the modules' true axes, in the world."""
    return np.asarray(tree.output @ np.array([inverse(pose(kind.output_xyz)) for kind in tree.types]))


def true_chain(robot: Robot) -> Chain:
    """Return the kinematic truth in the root frame: the housing frame of the first module at q = 0.

    What is true of a module is its axis: its housing's frame is where a housing as catalogued would have that
    axis, and `imu_home` is the catalogued place in that frame, wherever the IMU sits (`sensing_chain`).
    """
    tree = build_tree(robot)
    housings = _nominal_housings(tree)
    to_root = inverse(housings[0])
    joints = to_root @ tree.output
    imu_in_housing = np.array([pose(kind.imu_xyz) for kind in tree.types])
    return Chain(
        serials=tree.serials,
        parent=tree.parent,
        reversed=tree.reversed,
        axis=read_only(joints[:, :3, 2] * tree.axis_sign[:, None]),
        point=read_only(joints[:, :3, 3]),
        imu_home=read_only(to_root @ housings @ imu_in_housing),
        gravity=read_only(to_root[:3, :3] @ np.array([0.0, 0.0, robot.base.gravity_m_s2])),
    )


def sensing_chain(robot: Robot) -> Chain:
    """Return the true chain with the IMUs where they sit in their housings: its readings are the sensors'."""
    tree = build_tree(robot)
    to_root = inverse(_nominal_housings(tree)[0])
    return true_chain(robot)._replace(imu_home=read_only(to_root @ tree.imu_home))


def true_inertia(robot: Robot) -> Array:
    """Return every body's [m, m c (3), Ixx, Ixy, Ixz, Iyy, Iyz, Izz] at q = 0, (n, 10), read-only.

    In the root frame and about its origin, in the order of the thesis' eq. 25.
    """
    tree = build_tree(robot)
    to_root = inverse(_nominal_housings(tree)[0])
    pairs = zip(tree.bodies, tree.output, strict=True)
    return read_only(np.array([parameters(moved(body, to_root @ home)) for body, home in pairs]))

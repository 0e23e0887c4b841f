"""A URDF file as a `Chain`, with the inertias that it claims.

The root link's frame is the root frame. Links that a fixed joint joins are one body; links fixed to the
root link do not move and are left out. A body's own frame is that of the link right behind its joint.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError, fromstring, parse

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from coordinator.description.urdf_writer import INERTIA
from coordinator.dynamics.pseudo_inertia import parameters, pseudo_inertia
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.errors import UsageError
from module_agent.model.read_only import make_read_only, read_only

STANDARD_GRAVITY = (0.0, 0.0, 9.81)
# What is before a module's serial in the URDF of a run: name of its joint, and of its IMU's frame.
URDF_JOINT, URDF_IMU = "joint_", "imu_"
_MOVING, _FIXED = ("revolute", "continuous"), ("fixed", "prismatic")


# The inertia of a rotor is no part of URDF; Drake's extension of the transmission has it.
DRAKE = "http://drake.mit.edu"
_NOTHING: Mapping[str, float] = MappingProxyType({})


class UrdfError(UsageError):
    """A URDF file that cannot be read as a tree of revolute joints."""


class UrdfRobot(NamedTuple):
    """A robot as its URDF describes it; arrays are read-only.

    chain: n moving joints; `serials` are the joints' names, in the file's order as far as a parent comes
        before its children.
    bodies: names of the links right behind the joints.
    homes: (n, 4, 4) pose of every such link's frame at q = 0 in the root frame.
    links: every link's place; `carried` are those that move with some joint.
    phi: (10 n,) the inertias of the file, as in `torque_regressor`: in the root frame at q = 0, of all
        links of a body together. None if no moving link has one.
    limits: (n, 3) lowest and highest position [rad] and speed [rad/s], infinite where the file gives none.
    effort_nm: (n,) largest torque, infinite where the file gives none.
    drives: (n, 3) inertia of the rotor behind the gear [kg m^2], damping [Nm s/rad] and friction [Nm] of the
        joints, zero where the file gives none.
    held: joints that could move and are taken as fixed, prismatic and mimicking ones for example, with their
        positions [rad, m].
    path: of the file.
    """

    chain: Chain
    bodies: tuple[str, ...]
    homes: Array
    links: Mapping[str, "PlacedLink"]
    phi: Array | None
    limits: Array
    effort_nm: Array
    drives: Array
    held: dict[str, float]
    path: Path = Path()

    @property
    def carried(self) -> frozenset[str]:
        """The links that move with some joint."""
        return frozenset(name for name, place in self.links.items() if place.body != BASE)


class PlacedLink(NamedTuple):
    """A link: the pose of its frame at q = 0 in the root frame, and the body that it belongs to."""

    pose: Array
    body: int


class UrdfJoint(NamedTuple):
    """A joint: pose (4, 4) of the child's frame in the parent's at zero, axis (3,) in the child's.

    moves: whether it turns. limits: position, speed and effort. held: position of a joint taken as fixed.
    """

    name: str
    parent: str
    child: str
    moves: bool
    pose: Array
    axis: Array
    limits: tuple[float, float, float, float]
    held: float | None


def read_urdf(
    path: str | Path, gravity: ArrayLike = STANDARD_GRAVITY, held: Mapping[str, float] = _NOTHING
) -> UrdfRobot:
    """Return the robot that a URDF file describes: its chain of n moving joints and its inertias.

    Args:
        path: of the file. Joints are revolute, continuous, prismatic or fixed and form a tree; prismatic ones
            and those that mimic another are taken as fixed.
        gravity: (3,) specific force at rest in the root link's frame [m/s^2]; it points upwards.
        held: joints that are to be fixed, with their positions [rad, m]; others that are fixed are at zero.

    Raises:
        UrdfError: no XML, no robot, no tree, or a joint of another type; the message names file and joint or
            link.
        OSError: the file cannot be read.
    """
    try:
        root = parse(path).getroot()
    except ParseError as error:
        raise UrdfError(f"{path}: not XML: {error}") from None
    if root.tag != "robot":
        raise UrdfError(f"{path}: its element is <{root.tag}>; a URDF begins with <robot>")
    try:
        return _robot(root, np.array(gravity, dtype=float), held)._replace(path=Path(path))
    except UrdfError as error:
        raise UrdfError(f"{path}: {error}") from None


def read_joints(text: str) -> tuple[UrdfJoint, ...]:
    """Return the joints of a URDF's text in the file's order.

    Raises:
        UrdfError: no XML, or a joint that `read_urdf` would not read either.
    """
    try:
        root = fromstring(text)
    except ParseError as error:
        raise UrdfError(f"not XML: {error}") from None
    links = {_name(link): link for link in root.findall("link")}
    return tuple(_joint(element, links, _NOTHING) for element in root.findall("joint"))


def _robot(root: Element, gravity: Array, held: Mapping[str, float]) -> UrdfRobot:
    links = {_name(link): link for link in root.findall("link")}
    joints = [_joint(element, links, held) for element in root.findall("joint")]
    root_link = _root_link(joints, links)
    moving, placed = _placed(joints, root_link)
    if not moving:
        raise UrdfError("it has no moving joint")
    homes = np.array([placed[joint.child].pose for joint in moving])
    axis = np.array([home[:3, :3] @ j.axis for home, j in zip(homes, moving, strict=True)])
    point = homes[:, :3, 3].copy()
    make_read_only((homes, axis, point, gravity))
    chain = Chain(
        serials=tuple(joint.name for joint in moving),
        parent=tuple(placed[joint.parent].body for joint in moving),
        reversed=(False,) * len(moving),
        axis=axis,
        point=point,
        imu_home=homes,
        gravity=gravity,
    )
    carried = {link: place for link, place in placed.items() if place.body != BASE}
    return UrdfRobot(
        chain,
        tuple(joint.child for joint in moving),
        homes,
        placed,
        _inertias(links, carried, len(moving)),
        read_only(np.array([joint.limits[:3] for joint in moving])),
        read_only(np.array([joint.limits[3] for joint in moving])),
        _drives(root, [joint.name for joint in moving]),
        {joint.name: joint.held for joint in joints if joint.held is not None},
    )


def _joint(element: Element, links: dict[str, Element], held: Mapping[str, float]) -> UrdfJoint:
    name, kind = _name(element), element.get("type", "")
    if kind not in (*_MOVING, *_FIXED):
        raise UrdfError(
            f"joint {name!r} is {kind or 'of no type'}; revolute, continuous, prismatic and fixed are known"
        )
    ends = []
    for end in ("parent", "child"):
        end_element = element.find(end)
        link = None if end_element is None else end_element.get("link")
        if link is None or link not in links:
            raise UrdfError(f"joint {name!r} has {end} {link!r}, and no link has that name")
        ends.append(link)
    axis, pose = _axis(element, name, kind), joint_pose(element, 0.0)
    limits = _limits(element, name, kind)
    if kind == "fixed" or (kind in _MOVING and name not in held and element.find("mimic") is None):
        return UrdfJoint(name, ends[0], ends[1], kind in _MOVING, pose, axis, limits, None)
    position = float(held.get(name, 0.0))
    return UrdfJoint(name, ends[0], ends[1], False, joint_pose(element, position), axis, limits, position)


def joint_pose(element: Element, position: float) -> Array:
    """Return the pose (4, 4) of a joint's child in its parent, the joint at a position [rad, m].

    Raises:
        UrdfError: an origin or an axis that is none.
    """
    name, kind = _name(element), element.get("type", "")
    displaced = np.eye(4)
    if kind == "prismatic":
        displaced[:3, 3] = position * _axis(element, name, kind)
    elif kind != "fixed":
        displaced[:3, :3] = Rotation.from_rotvec(position * _axis(element, name, kind)).as_matrix()
    pose: Array = element_pose(element.find("origin"), f"origin of joint {name!r}") @ displaced
    return pose


def _axis(element: Element, name: str, kind: str) -> Array:
    axis_element = element.find("axis")
    axis = np.array([1.0, 0.0, 0.0])
    if axis_element is not None:
        axis = numbers(axis_element, "xyz", f"axis of joint {name!r}", 3)
    length = float(np.linalg.norm(axis))
    if kind != "fixed" and not length > 1e-9:
        raise UrdfError(f"axis of joint {name!r} is zero; it must be a direction")
    return axis / max(length, 1e-9)


def _drives(root: Element, names: Sequence[str]) -> Array:
    """Return rotor inertia, damping and friction of the joints (n, 3)."""
    drives = np.zeros((len(names), 3))
    for joint in root.findall("joint"):
        dynamics = joint.find("dynamics")
        if dynamics is not None and joint.get("name") in names:
            where = f"dynamics of joint {joint.get('name')!r}"
            drives[names.index(_name(joint)), 1:] = [
                _float(dynamics.get(key, "0"), key, where) for key in ("damping", "friction")
            ]
    for transmission in root.findall("transmission"):
        driven, actuator = transmission.find("joint"), transmission.find("actuator")
        if driven is None or actuator is None or driven.get("name") not in names:
            continue
        where = f"transmission of joint {driven.get('name')!r}"
        rotor, gear = (actuator.find(f"{{{DRAKE}}}{key}") for key in ("rotor_inertia", "gear_ratio"))
        ratio = 1.0 if gear is None else _float(gear.get("value", ""), "gear_ratio", where)
        if rotor is not None:
            inertia = _float(rotor.get("value", ""), "rotor_inertia", where)
            drives[names.index(_name(driven)), 0] = inertia * ratio**2
    return read_only(drives)


def _limits(element: Element, name: str, kind: str) -> tuple[float, float, float, float]:
    """Return the lowest and the highest position, the speed and the effort; infinite if not given."""
    limit, where = element.find("limit"), f"limit of joint {name!r}"
    if limit is None:
        return -np.inf, np.inf, np.inf, np.inf
    low, high, speed, effort = (
        _float(limit.get(key, "0"), key, where) for key in ("lower", "upper", "velocity", "effort")
    )
    if kind == "continuous" or not low < high:
        low, high = -np.inf, np.inf
    return low, high, speed if speed > 0.0 else np.inf, effort if effort > 0.0 else np.inf


def _root_link(joints: Sequence[UrdfJoint], links: dict[str, Element]) -> str:
    children = [joint.child for joint in joints]
    if twice := [link for link in children if children.count(link) > 1]:
        raise UrdfError(f"link {twice[0]!r} is the child of several joints; a tree is needed")
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        raise UrdfError(
            f"its root links are {', '.join(roots) or 'none'}; a tree has one, every other is a child"
        )
    return roots[0]


def _placed(joints: Sequence[UrdfJoint], root_link: str) -> tuple[list[UrdfJoint], dict[str, PlacedLink]]:
    """Return the moving joints in the file's order, but parents before children, and all links' places."""
    placed, waiting, moving = {root_link: PlacedLink(np.eye(4), BASE)}, list(joints), list[UrdfJoint]()
    while waiting:
        joint = next((one for one in waiting if one.parent in placed), None)
        if joint is None:
            raise UrdfError(f"joint {waiting[0].name!r} is part of a ring; a tree is needed")
        waiting.remove(joint)
        below = placed[joint.parent]
        placed[joint.child] = PlacedLink(below.pose @ joint.pose, len(moving) if joint.moves else below.body)
        if joint.moves:
            moving.append(joint)
    return moving, placed


def _inertias(links: dict[str, Element], carried: dict[str, PlacedLink], joints: int) -> Array | None:
    total = np.zeros((joints, 4, 4))
    claimed = False
    for name, (pose, body) in carried.items():
        if (inertial := links[name].find("inertial")) is not None:
            claimed = True
            total[body] += pose @ _link_inertia(inertial, f"inertial of link {name!r}") @ pose.T
    return read_only(np.concatenate([parameters(pseudo) for pseudo in total])) if claimed else None


def _link_inertia(inertial: Element, where: str) -> Array:
    """Return the pseudo-inertia in the link's frame."""
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    if mass is None or inertia is None:
        raise UrdfError(f"{where} lacks <mass> or <inertia>")
    about_centre = [_float(inertia.get(key, ""), key, where) for key in INERTIA]
    phi = np.array([_float(mass.get("value", ""), "value", where), 0.0, 0.0, 0.0, *about_centre])
    pose = element_pose(inertial.find("origin"), where)
    return np.asarray(pose @ pseudo_inertia(phi) @ pose.T)


def element_pose(origin: Element | None, where: str) -> Array:
    """Return the pose (4, 4) of an origin element, or the identity.

    Raises:
        UrdfError: it holds something else than numbers.
    """
    pose = np.eye(4)
    if origin is not None:
        # Roll, pitch and yaw are turns about fixed axes.
        pose[:3, :3] = Rotation.from_euler("xyz", numbers(origin, "rpy", where, 3, "0 0 0")).as_matrix()
        pose[:3, 3] = numbers(origin, "xyz", where, 3, "0 0 0")
    return pose


def numbers(element: Element, key: str, where: str, count: int, default: str = "") -> Array:
    """Return the numbers (count,) of an attribute.

    Raises:
        UrdfError: there are others, or another number of them.
    """
    cells = element.get(key, default).split()
    if len(cells) != count:
        raise UrdfError(f"{where}: {key}={element.get(key)!r}; {count} finite numbers are needed")
    return np.array([_float(cell, key, where) for cell in cells])


def _float(word: str, key: str, where: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise UrdfError(f"{where}: {key} holds {word!r}; a finite number is needed")
    return value


def _name(element: Element) -> str:
    name = element.get("name")
    if not name:
        raise UrdfError(f"a <{element.tag}> has no name")
    return name

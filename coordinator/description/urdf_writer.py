"""The identified robot as a URDF file: joints, frames, shapes, and inertias where they are known.

`world` has z up, so that the usual gravity (0, 0, -9.81) is right however the robot is mounted; `base` is the
root frame. Body i is the link `body_<serial>` with z on its joint's axis at q = 0 and turns by
`joint_<serial>`. Links without mass are frames: `imu_<serial>` on the body that carries the IMU and, where
the module types are given, `housing_<serial>` and `output_<serial>` as the catalogue has them, and
`tip_<serial>` at the end of every branch, which is the moved face of the last module (HRDF's end effector).

Shapes are for drawing and for planners: a box for every housing, a cylinder for every link, both to see and
to touch. What a link truly looks like is not identified.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any
from xml.etree.ElementTree import Comment, Element, ElementTree, SubElement, indent

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from coordinator.description.module_geometry import LINK_RADIUS_M, Module, placed_modules
from coordinator.description.module_geometry import links as links_between
from coordinator.dynamics.inertia_prior import module_prior
from coordinator.dynamics.pseudo_inertia import (
    Body,
    body,
    is_consistent,
    nearest_consistent,
    parameters,
    pseudo_inertia,
    smallest_eigenvalue,
)
from coordinator.kinematics.frames import distal_homes, housing_homes, output_homes
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.files import replacing
from module_agent.model.read_only import read_only
from module_agent.model.regressor import PER_BODY, check_phi

INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
ALL_DETERMINED: Mapping[str, Sequence[str]] = MappingProxyType({})
# Shorter links are faces that lie on each other.
_MIN_LINK_M = 1e-3


def write_urdf(
    path: Path,
    chain: Chain,
    phi: ArrayLike | None,
    name: str = "robot",
    module_types: Sequence[ModuleType] | None = None,
    undetermined: Mapping[str, Sequence[str]] = ALL_DETERMINED,
    unknown: Mapping[str, Sequence[str]] = ALL_DETERMINED,
) -> None:
    """Write the robot of n joints; the file is the complete old or the complete new one.

    phi: (10 n,) inertial parameters as in `torque_regressor`. With None those of the modules' make are
        written, and a comment says so; without types none are. Parameters that are no real body's are
        replaced by the nearest real body (`nearest_consistent`), and a comment says so.
    module_types: per joint; their limits and losses, frames and shapes are written.
    undetermined: by the serial, parameters of its body that torques alone do not determine; a comment in the
        link names them.
    unknown: by the child's serial, parameters of the transform from its parent that take part in an
        unobservable change (`link_transforms`); a comment in the joint names them.

    Raises:
        ValueError: `phi` or `module_types` do not fit the chain.
        OSError: the file cannot be written.
    """
    write_xml(path, robot_element(chain, phi, name, module_types, undetermined, unknown))


def robot_element(
    chain: Chain,
    phi: ArrayLike | None,
    name: str = "robot",
    module_types: Sequence[ModuleType] | None = None,
    undetermined: Mapping[str, Sequence[str]] = ALL_DETERMINED,
    unknown: Mapping[str, Sequence[str]] = ALL_DETERMINED,
) -> Element:
    """Return the `robot` element; for the arguments and errors see `write_urdf`."""
    joints = len(chain.serials)
    if module_types is not None and len(module_types) != joints:
        raise ValueError(f"{len(module_types)} module types for a chain of {joints} joints")
    bodies = None if phi is None else check_phi(chain, phi).reshape(joints, PER_BODY)
    is_catalogues = bodies is None and module_types is not None
    if is_catalogues and module_types is not None:
        bodies = np.array([parameters(one) for one in module_prior(chain, module_types)])
    homes = link_homes(chain)
    names = {BASE: "base"} | {k: f"body_{serial}" for k, serial in enumerate(chain.serials)}
    robot = Element("robot", name=name)
    comment(robot, "Joint positions are the modules' own; every frame is where it is at q = 0. SI units.")
    if is_catalogues:
        comment(
            robot, "Masses and inertias are the catalogue's of the modules' types; they are not identified."
        )
    SubElement(robot, "link", name="world")
    links = {BASE: SubElement(robot, "link", name="base")}
    _joint(robot, "world_to_base", "fixed", "world", "base", upright_pose(chain.gravity))
    for i, serial in enumerate(chain.serials):
        links[i] = SubElement(robot, "link", name=names[i])
        if bodies is not None:
            comment_undetermined(links[i], undetermined.get(serial, ()))
            _inertial(links[i], bodies[i], homes[i])
        parent = chain.parent[i]
        pose = _relative(homes, parent, homes[i])
        joint = _joint(robot, f"joint_{serial}", "continuous", names[parent], names[i], pose)
        if unknown.get(serial):
            comment(
                joint,
                f"Not determined by the run: {', '.join(unknown[serial])} of the link to this module "
                "(see unresolved in result.json).",
            )
        SubElement(joint, "axis", xyz="0 0 1")
        if module_types is not None:
            _make_of_joint(joint, module_types[i])
    frames = [("imu", k, chain.carrier(k), chain.imu_home[k]) for k in range(joints)]
    if module_types is not None:
        comment(
            robot,
            "Shapes are approximations: boxes around housings by the catalogue, and for links straight tubes "
            "of the kit between the identified places of modules.",
        )
        _add_shapes(links, homes, chain, placed_modules(chain, module_types))
        frames += _module_frames(chain, module_types)
    for kind, k, on, home in frames:
        frame = f"{kind}_{chain.serials[k]}"
        SubElement(robot, "link", name=frame)
        mount = f"{kind}_mount_{chain.serials[k]}"
        _joint(robot, mount, "fixed", names[on], frame, _relative(homes, on, home))
    return robot


def _make_of_joint(joint: Element, made: ModuleType) -> None:
    """Add the limits and losses of a module's type to its joint, which has ends if the type has."""
    limit = {"effort": numbers(made.max_effort_nm), "velocity": numbers(made.max_speed_rad_s)}
    if made.range_rad is not None:
        joint.set("type", "revolute")
        limit |= {"lower": numbers(made.range_rad[0]), "upper": numbers(made.range_rad[1])}
    SubElement(joint, "limit", limit)
    comment(joint, f"Losses of the {made.name} by its catalogue; they are not identified.")
    motor = made.motor
    SubElement(joint, "dynamics", damping=numbers(motor.viscous_nm_s_rad), friction=numbers(motor.coulomb_nm))


def _module_frames(chain: Chain, types: Sequence[ModuleType]) -> list[tuple[str, int, int, Array]]:
    """Return the frames of the modules: their kind, module, body that carries them, pose (4, 4) at q = 0."""
    housing, output = housing_homes(chain, types), output_homes(chain, types)
    distal, modules = distal_homes(chain, types), range(len(chain.serials))
    return [
        *(("housing", k, chain.carrier(k), housing[k]) for k in modules),
        *(("output", k, chain.parent[k] if chain.reversed[k] else k, output[k]) for k in modules),
        *(("tip", k, k, distal[k]) for k in chain.leaves),
    ]


def _add_shapes(bodies: Mapping[int, Element], homes: Array, chain: Chain, placed: Sequence[Module]) -> None:
    """Add boxes of housings and cylinders of links to the links of the bodies that carry them."""
    for serial, module, link in zip(chain.serials, placed, links_between(chain, placed), strict=True):
        box = Element("box", size=numbers(module.box_size))
        pose = module.housing.copy()
        pose[:3, 3] += module.housing[:3, :3] @ module.box_centre
        on = module.housing_body
        _add_shape(bodies[on], f"housing_{serial}", _relative(homes, on, pose), box)
        if link.body != BASE and link.length_m > _MIN_LINK_M:
            pose = np.eye(4)
            pose[:3, :3] = _shortest_turn(np.array([0.0, 0.0, 1.0]), (link.end - link.start) / link.length_m)
            pose[:3, 3] = 0.5 * (link.start + link.end)
            tube = Element("cylinder", radius=numbers(LINK_RADIUS_M), length=numbers(link.length_m))
            _add_shape(bodies[link.body], f"link_{serial}", _relative(homes, link.body, pose), tube)


def _add_shape(link: Element, name: str, pose: Array, shape: Element) -> None:
    for use in ("visual", "collision"):
        one = SubElement(link, use, name=f"{use}_{name}")
        SubElement(one, "origin", origin_of(pose))
        SubElement(one, "geometry").append(shape)


def link_homes(chain: Chain) -> Array:
    """Return the pose (n, 4, 4) of every body's link frame at q = 0 in the root frame, read-only.

    The origin is the chain's point on the axis, z the axis; x and y come by the shortest turn from the
    root's.
    """
    homes = np.tile(np.eye(4), (len(chain.serials), 1, 1))
    for home, axis, point in zip(homes, chain.axis, chain.point, strict=True):
        home[:3, :3] = _shortest_turn(np.array([0.0, 0.0, 1.0]), axis)
        home[:3, 3] = point
    return read_only(homes)


def _shortest_turn(from_direction: Array, to_direction: Array) -> Array:
    return np.asarray(Rotation.align_vectors([to_direction], [from_direction])[0].as_matrix())


def upright_pose(gravity: Array) -> Array:
    """Return the pose (4, 4) of the root frame in a world with z up, by the shortest turn."""
    pose = np.eye(4)
    length = float(np.linalg.norm(gravity))
    if length > 0.0:
        pose[:3, :3] = _shortest_turn(gravity / length, np.array([0.0, 0.0, 1.0]))
    return pose


def _relative(homes: Array, parent: int, pose: Array) -> Array:
    return pose if parent == BASE else np.asarray(np.linalg.solve(homes[parent], pose))


def _joint(robot: Element, name: str, kind: str, parent: str, child: str, pose: Array) -> Element:
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", origin_of(pose))
    return joint


def origin_of(pose: Array) -> dict[str, str]:
    """Return the attributes of the origin of a pose (4, 4)."""
    # URDF turns about the fixed x, y and z in this order. At a pitch of 90 degrees roll and yaw are one
    # angle: any split of it is right, so the warning is suppressed.
    rpy = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", suppress_warnings=True)
    return {"xyz": numbers(pose[:3, 3]), "rpy": numbers(rpy)}


def _inertial(link: Element, phi: Array, home: Array) -> None:
    """Add the inertial block of ten parameters (root frame) to a link at `home`."""
    into_link = np.linalg.inv(home)
    pseudo = into_link @ pseudo_inertia(phi) @ into_link.T
    if not is_consistent(pseudo):
        comment(
            link,
            f"The identified parameters of this link are no real body's (mass {phi[0]:.4g} kg, smallest "
            f"eigenvalue of the pseudo-inertia {smallest_eigenvalue(pseudo):.3g} kg): torques do not show "
            "all of them. This is the nearest real body; for torques use the parameters in result.json.",
        )
        pseudo = nearest_consistent(pseudo)
    link.append(inertial_element(body(pseudo), numbers))


def inertial_element(real: Body, text: Callable[[ArrayLike], str]) -> Element:
    """Return the inertial block of a body in its link's frame, with numbers as `text` writes them."""
    block = Element("inertial")
    SubElement(block, "origin", xyz=text(real.com_m), rpy="0 0 0")
    SubElement(block, "mass", value=text(real.mass_kg))
    SubElement(block, "inertia", inertia_attributes(real, text))
    return block


def inertia_attributes(real: Body, text: Callable[[ArrayLike], str]) -> dict[str, str]:
    """Return the six entries of a body's inertia about its centre by their names."""
    entries = zip(INERTIA, real.inertia_kg_m2[np.triu_indices(3)], strict=True)
    return {key: text(value) for key, value in entries}


def comment_undetermined(parent: Element, names: Sequence[str]) -> None:
    """Add a comment with the parameters of a body that torques alone do not determine, if there are any."""
    if names:
        comment(
            parent,
            f"Torques alone do not determine {', '.join(names)} of this body: the module types decide, "
            "to a factor of two. See identifiability, and mass_sigma_kg of bodies, in result.json.",
        )


def comment(parent: Element, text: str) -> None:
    """Add a comment."""
    parent.append(comment_of(text))


def comment_of(text: str) -> Any:
    """Return a comment, in which XML allows no double hyphen."""
    return Comment(f" {re.sub('-(?=-)', '- ', text)} ")


def numbers(values: ArrayLike) -> str:
    """Return numbers as text, with the 15 digits that survive a round trip in every reader; no zero is -0."""
    return " ".join(f"{float(value) + 0.0:.15g}" for value in np.asarray(values, dtype=float).ravel())


def write_xml(path: Path, root: Element) -> None:
    """Write an XML file; it is the complete old or the complete new one.

    Raises:
        OSError: the file cannot be written.
    """
    indent(root, space="  ")
    with replacing(path) as temporary:
        ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)

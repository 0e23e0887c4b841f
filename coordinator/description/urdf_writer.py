"""The identified robot as a URDF file: continuous joints, IMU frames, and inertias where they are known.

`world` has z up, so that the usual gravity (0, 0, -9.81) is right however the robot is mounted; `base` is the
root frame. Body i is the link `body_<serial>` with z on its joint's axis at q = 0 and turns by
`joint_<serial>`; `imu_<serial>` is a link fixed to the body that carries the IMU.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from xml.etree.ElementTree import Comment, Element, ElementTree, SubElement, indent

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from coordinator.dynamics.pseudo_inertia import (
    Body,
    body,
    is_consistent,
    nearest_consistent,
    pseudo_inertia,
    smallest_eigenvalue,
)
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.files import replacing
from module_agent.model.read_only import read_only
from module_agent.model.regressor import PER_BODY, check_phi

INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
ALL_DETERMINED: Mapping[str, Sequence[str]] = MappingProxyType({})


def write_urdf(
    path: Path,
    chain: Chain,
    phi: ArrayLike | None,
    name: str = "robot",
    module_types: Sequence[ModuleType] | None = None,
    undetermined: Mapping[str, Sequence[str]] = ALL_DETERMINED,
) -> None:
    """Write the robot of n joints; the file is the complete old or the complete new one.

    phi: (10 n,) inertial parameters as in `torque_regressor`, None to write no inertias. Parameters that are
    no real body's are replaced by the nearest real body (`nearest_consistent`), and a comment says so.
    module_types: per joint; their effort and speed limits are written.
    undetermined: by the serial, parameters of its body that torques alone do not determine; a comment in the
        link names them.

    Raises:
        ValueError: `phi` or `module_types` do not fit the chain.
        OSError: the file cannot be written.
    """
    write_xml(path, robot_element(chain, phi, name, module_types, undetermined))


def robot_element(
    chain: Chain,
    phi: ArrayLike | None,
    name: str = "robot",
    module_types: Sequence[ModuleType] | None = None,
    undetermined: Mapping[str, Sequence[str]] = ALL_DETERMINED,
) -> Element:
    """Return the `robot` element; for the arguments and errors see `write_urdf`."""
    joints = len(chain.serials)
    if module_types is not None and len(module_types) != joints:
        raise ValueError(f"{len(module_types)} module types for a chain of {joints} joints")
    bodies = None if phi is None else check_phi(chain, phi).reshape(joints, PER_BODY)
    homes = link_homes(chain)
    names = {BASE: "base"} | {k: f"body_{serial}" for k, serial in enumerate(chain.serials)}
    robot = Element("robot", name=name)
    comment(robot, "Joint positions are the modules' own; every frame is where it is at q = 0. SI units.")
    SubElement(robot, "link", name="world")
    SubElement(robot, "link", name="base")
    _joint(robot, "world_to_base", "fixed", "world", "base", upright_pose(chain.gravity))
    for i, serial in enumerate(chain.serials):
        link = SubElement(robot, "link", name=names[i])
        if bodies is not None:
            comment_undetermined(link, undetermined.get(serial, ()))
            _inertial(link, bodies[i], homes[i])
        parent = chain.parent[i]
        pose = _relative(homes, parent, homes[i])
        joint = _joint(robot, f"joint_{serial}", "continuous", names[parent], names[i], pose)
        SubElement(joint, "axis", xyz="0 0 1")
        if module_types is not None:
            effort, velocity = module_types[i].max_effort_nm, module_types[i].max_speed_rad_s
            SubElement(joint, "limit", effort=numbers(effort), velocity=numbers(velocity))
    for k, serial in enumerate(chain.serials):
        on = chain.carrier(k)
        SubElement(robot, "link", name=f"imu_{serial}")
        pose = _relative(homes, on, chain.imu_home[k])
        _joint(robot, f"imu_mount_{serial}", "fixed", names[on], f"imu_{serial}", pose)
    return robot


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
    # URDF turns about the fixed x, y and z in this order. At a pitch of 90 degrees roll and yaw are one
    # angle: any split of it is right, so the warning is suppressed.
    rpy = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", suppress_warnings=True)
    SubElement(joint, "origin", xyz=numbers(pose[:3, 3]), rpy=numbers(rpy))
    return joint


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
    """Add a comment, in which XML allows no double hyphen."""
    parent.append(Comment(f" {text.replace('--', '- -')} "))


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

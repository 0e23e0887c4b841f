"""The identified robot as a URDF file: continuous joints, IMU frames, and inertias where they are known.

`world` has z up, so that the usual gravity (0, 0, -9.81) is right however the robot is mounted; `base` is the
root frame. Body i is the link `body_<serial>` with z on its joint's axis at q = 0 and turns by
`joint_<serial>`; `imu_<serial>` is a link fixed to the body that carries the IMU.
"""

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Comment, Element, ElementTree, SubElement, indent

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from coordinator.dynamics.pseudo_inertia import (
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


def write_urdf(
    path: Path,
    chain: Chain,
    phi: ArrayLike | None,
    name: str = "robot",
    module_types: Sequence[ModuleType] | None = None,
) -> None:
    """Write the robot; the file is the complete old or the complete new one.

    Args:
        path: the file.
        chain: n joints.
        phi: (10 n,) inertial parameters as in `torque_regressor`, None to write no inertias. Parameters that
            are no real body's are replaced by the nearest real body (`nearest_consistent`), and a comment
            says so.
        name: of the robot.
        module_types: per joint; their effort and speed limits are written.

    Raises:
        ValueError: `phi` or `module_types` do not fit the chain.
        OSError: the file cannot be written.
    """
    robot = robot_element(chain, phi, name, module_types)
    indent(robot, space="  ")
    with replacing(path) as temporary:
        ElementTree(robot).write(temporary, encoding="utf-8", xml_declaration=True)


def robot_element(
    chain: Chain,
    phi: ArrayLike | None,
    name: str = "robot",
    module_types: Sequence[ModuleType] | None = None,
) -> Element:
    """Return the `robot` element; for the arguments and errors see `write_urdf`."""
    joints = len(chain.serials)
    if module_types is not None and len(module_types) != joints:
        raise ValueError(f"{len(module_types)} module types for a chain of {joints} joints")
    bodies = None if phi is None else check_phi(chain, phi).reshape(joints, PER_BODY)
    homes = link_homes(chain)
    robot = Element("robot", name=name)
    _comment(robot, "Joint positions are the modules' own; every frame is where it is at q = 0. SI units.")
    SubElement(robot, "link", name="world")
    SubElement(robot, "link", name="base")
    _joint(robot, "world_to_base", "fixed", "world", "base", upright_pose(chain.gravity))
    for i, serial in enumerate(chain.serials):
        link = SubElement(robot, "link", name=f"body_{serial}")
        if bodies is not None:
            _inertial(link, bodies[i], homes[i])
        parent = chain.parent[i]
        joint = _joint(
            robot,
            f"joint_{serial}",
            "continuous",
            _link_name(chain, parent),
            f"body_{serial}",
            _relative(homes, parent, homes[i]),
        )
        SubElement(joint, "axis", xyz="0 0 1")
        if module_types is not None:
            kind = module_types[i]
            SubElement(joint, "limit", effort=_text(kind.max_effort_nm), velocity=_text(kind.max_speed_rad_s))
    for k, serial in enumerate(chain.serials):
        on = chain.carrier(k)
        SubElement(robot, "link", name=f"imu_{serial}")
        pose = _relative(homes, on, chain.imu_home[k])
        _joint(robot, f"imu_mount_{serial}", "fixed", _link_name(chain, on), f"imu_{serial}", pose)
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
    rotation: Array = Rotation.align_vectors([to_direction], [from_direction])[0].as_matrix()
    return rotation


def upright_pose(gravity: Array) -> Array:
    """Return the pose (4, 4) of the root frame in a world with z up, by the shortest turn."""
    pose = np.eye(4)
    length = float(np.linalg.norm(gravity))
    if length > 0.0:
        pose[:3, :3] = _shortest_turn(gravity / length, np.array([0.0, 0.0, 1.0]))
    return pose


def _link_name(chain: Chain, body_index: int) -> str:
    return "base" if body_index == BASE else f"body_{chain.serials[body_index]}"


def _relative(homes: Array, parent: int, pose: Array) -> Array:
    relative: Array = pose if parent == BASE else np.linalg.solve(homes[parent], pose)
    return relative


def _joint(robot: Element, name: str, kind: str, parent: str, child: str, pose: Array) -> Element:
    joint = SubElement(robot, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    # URDF turns about the fixed x, y and z in this order. At a pitch of 90 degrees roll and yaw are one
    # angle: any split of it is right, so the warning is suppressed.
    rpy = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", suppress_warnings=True)
    SubElement(joint, "origin", xyz=_texts(pose[:3, 3]), rpy=_texts(rpy))
    return joint


def _inertial(link: Element, phi: Array, home: Array) -> None:
    """Add the inertial block of ten parameters (root frame) to a link at `home`."""
    into_link = np.linalg.inv(home)
    pseudo = into_link @ pseudo_inertia(phi) @ into_link.T
    if not is_consistent(pseudo):
        _comment(
            link,
            f"The identified parameters of this link are no real body's (mass {phi[0]:.4g} kg, smallest "
            f"eigenvalue of the pseudo-inertia {smallest_eigenvalue(pseudo):.3g} kg): torques do not show "
            "all of them. This is the nearest real body; for torques use the parameters in result.json.",
        )
        pseudo = nearest_consistent(pseudo)
    real = body(pseudo)
    block = SubElement(link, "inertial")
    SubElement(block, "origin", xyz=_texts(real.com_m), rpy="0 0 0")
    SubElement(block, "mass", value=_text(real.mass_kg))
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    values = real.inertia_kg_m2[np.triu_indices(3)]
    SubElement(block, "inertia", {key: _text(value) for key, value in zip(names, values, strict=True)})


def _comment(parent: Element, text: str) -> None:
    parent.append(Comment(f" {text} "))


def _text(value: float) -> str:
    # 15 digits: what survives a round trip through decimal in every reader.
    return f"{float(value):.15g}"


def _texts(values: ArrayLike) -> str:
    return " ".join(_text(value) for value in np.asarray(values, dtype=float))

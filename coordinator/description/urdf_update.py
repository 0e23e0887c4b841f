"""Put fitted bodies and friction into a robot's own URDF, whose other contents stay."""

from collections.abc import Sequence
from xml.etree.ElementTree import (
    Comment,
    Element,
    SubElement,
    TreeBuilder,
    XMLParser,
    indent,
    parse,
    tostring,
)

import numpy as np
from numpy.typing import ArrayLike

from coordinator.description.urdf_reader import UrdfRobot
from coordinator.description.urdf_writer import inertial_element
from coordinator.dynamics.drive_model import DriveColumn
from coordinator.dynamics.pseudo_inertia import Body
from module_agent.model.chain import Array
from module_agent.model.read_only import read_only


def fitted_urdf_text(robot: UrdfRobot, bodies: Sequence[Body], friction: ArrayLike) -> str:
    """Return the text of a robot's URDF with other bodies and friction.

    The inertia of a body is in the link right behind its joint; links fixed to that lose their own, which is
    contained in it. Joints get viscous and Coulomb friction.

    robot: its file is read again. bodies: (n,) in the frames of the links `robot.bodies`. friction: (n, 2)
    viscous [Nm s/rad] and Coulomb [Nm] of every joint.
    """
    # Comments of the given file are kept.
    root = parse(robot.path, XMLParser(target=TreeBuilder(insert_comments=True))).getroot()
    heads = dict(zip(robot.bodies, bodies, strict=True))
    for link in root.findall("link"):
        name = link.get("name", "")
        if name in robot.carried:
            for old in link.findall("inertial"):
                link.remove(old)
        if name in heads:
            link.insert(0, inertial_element(heads[name], _exact))
    drives = dict(zip(robot.chain.serials, np.asarray(friction).tolist(), strict=True))
    for joint in root.findall("joint"):
        if joint.get("name", "") in drives:
            _set_friction(joint, *drives[joint.get("name", "")])
    indent(root)
    root.insert(0, Comment(" Inertias and friction were identified from torques. "))
    return str(tostring(root, encoding="utf-8", xml_declaration=True), "utf-8")


def friction_of(drives: Sequence[DriveColumn], values: Sequence[float], joints: int) -> Array:
    """Return damping and friction of each joint as a URDF has them, (n, 2), none below zero, read-only.

    A URDF has no element for what coupled joints share.
    """
    friction = np.zeros((joints, 2))
    for drive, value in zip(drives, values, strict=True):
        if len(drive.joints) == 1 and drive.term in ("viscous", "coulomb"):
            friction[drive.joints[0], ("viscous", "coulomb").index(drive.term)] = max(0.0, float(value))
    return read_only(friction)


def _set_friction(joint: Element, damping: float, friction: float) -> None:
    for old in joint.findall("dynamics"):
        joint.remove(old)
    SubElement(joint, "dynamics", damping=_exact(damping), friction=_exact(friction))


def _exact(values: ArrayLike) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values).ravel())

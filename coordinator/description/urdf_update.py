"""Put fitted bodies and friction into a robot's own URDF, whose other contents stay."""

from collections.abc import Sequence
from pathlib import Path
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
from coordinator.dynamics.drive_model import DriveColumn
from coordinator.dynamics.pseudo_inertia import Body
from module_agent.model.chain import Array
from module_agent.model.files import write_text


def fitted_urdf_text(robot: UrdfRobot, bodies: Sequence[Body], friction: ArrayLike) -> str:
    """Return the text of a robot's URDF with other bodies and friction.

    The inertia of a body is in the link right behind its joint; links fixed to that lose their own, which is
    contained in it. Joints get viscous and Coulomb friction.

    Args:
        robot: of `read_urdf`, whose file is read again. bodies: (n,) in the frames of the links
        `robot.bodies`.
        friction: (n, 2) viscous [Nm s/rad] and Coulomb [Nm] of every joint.
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
            link.insert(0, _inertial(heads[name]))
    drives = dict(zip(robot.chain.serials, np.asarray(friction).tolist(), strict=True))
    for joint in root.findall("joint"):
        if joint.get("name", "") in drives:
            _set_friction(joint, *drives[joint.get("name", "")])
    indent(root)
    root.insert(0, Comment(" Inertias and friction were identified from torques. "))
    return str(tostring(root, encoding="utf-8", xml_declaration=True), "utf-8")


def write_fitted_urdf(path: Path, text: str) -> None:
    """Write the text of a URDF; the file is the complete old or the complete new one.

    Raises:
        OSError: the file cannot be written.
    """
    write_text(path, text)


def friction_of(drives: Sequence[DriveColumn], values: Sequence[float], joints: int) -> Array:
    """Return damping and friction of each joint as a URDF has them, (n, 2), none below zero, read-only.

    A URDF has no element for what coupled joints share.
    """
    friction = np.zeros((joints, 2))
    for drive, value in zip(drives, values, strict=True):
        if len(drive.joints) == 1 and drive.term in ("viscous", "coulomb"):
            friction[drive.joints[0], ("viscous", "coulomb").index(drive.term)] = max(0.0, float(value))
    friction.flags.writeable = False
    return friction


def _inertial(body: Body) -> Element:
    element = Element("inertial")
    SubElement(element, "origin", xyz=" ".join(_text(x) for x in body.com_m), rpy="0 0 0")
    SubElement(element, "mass", value=_text(body.mass_kg))
    i = body.inertia_kg_m2
    entries = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), i[np.triu_indices(3)], strict=True)
    SubElement(element, "inertia", {key: _text(value) for key, value in entries})
    return element


def _set_friction(joint: Element, damping: float, friction: float) -> None:
    for old in joint.findall("dynamics"):
        joint.remove(old)
    SubElement(joint, "dynamics", damping=_text(damping), friction=_text(friction))


def _text(value: float) -> str:
    return repr(float(value))

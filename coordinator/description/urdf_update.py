"""The URDF that was given, with the bodies that explain the torques instead of those that it claimed."""

import os
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import (
    Comment,
    Element,
    ElementTree,
    SubElement,
    TreeBuilder,
    XMLParser,
    indent,
    parse,
)

import numpy as np

from coordinator.description.urdf_reader import UrdfRobot
from coordinator.dynamics.drive_model import DriveColumn
from coordinator.dynamics.pseudo_inertia import Body


def write_fitted_urdf(
    path: Path,
    given: Path,
    robot: UrdfRobot,
    bodies: Sequence[Body],
    friction: Sequence[tuple[float, float]],
) -> None:
    """Write a copy of the file `given`; the file is the complete old or the complete new one.

    The inertia of a body stands in the link right behind its joint; links fixed to that have none of their
    own any more, because it is within. Joints get viscous and Coulomb friction.

    Args:
        path: the file. given: what `robot` was read from.
        bodies: (n,) in the frames of the links. friction: (n,) per joint damping and friction.

    Raises:
        OSError: a file cannot be read or written.
    """
    # Comments are the owner's too.
    tree = parse(given, XMLParser(target=TreeBuilder(insert_comments=True)))
    root = tree.getroot()
    heads = dict(zip(robot.bodies, bodies, strict=True))
    for link in root.findall("link"):
        name = link.get("name", "")
        if name in robot.carried:
            for old in link.findall("inertial"):
                link.remove(old)
        if name in heads:
            link.insert(0, _inertial(heads[name]))
    rubbing = dict(zip(robot.chain.serials, friction, strict=True))
    for joint in root.findall("joint"):
        if joint.get("name", "") in rubbing:
            _rub(joint, *rubbing[joint.get("name", "")])
    indent(root)
    root.insert(0, Comment(" Inertias and friction were identified from torques. "))
    _write(tree, path)


def friction_of(
    drives: Sequence[DriveColumn], values: Sequence[float], joints: int
) -> list[tuple[float, float]]:
    """Return what a URDF can say of the drives: damping and friction of each joint, none below zero.

    What coupled joints share has no place in a URDF.
    """
    found = np.zeros((joints, 2))
    for drive, value in zip(drives, values, strict=True):
        if len(drive.joints) == 1 and drive.term in ("viscous", "coulomb"):
            found[drive.joints[0], ("viscous", "coulomb").index(drive.term)] = max(0.0, float(value))
    return [(float(damping), float(friction)) for damping, friction in found]


def _inertial(body: Body) -> Element:
    element = Element("inertial")
    SubElement(element, "origin", xyz=" ".join(_text(x) for x in body.com_m), rpy="0 0 0")
    SubElement(element, "mass", value=_text(body.mass_kg))
    i = body.inertia_kg_m2
    entries = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), i[np.triu_indices(3)], strict=True)
    SubElement(element, "inertia", {key: _text(value) for key, value in entries})
    return element


def _rub(joint: Element, damping: float, friction: float) -> None:
    for old in joint.findall("dynamics"):
        joint.remove(old)
    SubElement(joint, "dynamics", damping=_text(damping), friction=_text(friction))


def _write(tree: "ElementTree[Element]", path: Path) -> None:
    temporary = path.with_name(path.name + ".part")
    tree.write(temporary, encoding="utf-8", xml_declaration=True)
    os.replace(temporary, path)


def _text(value: float) -> str:
    return repr(float(value))

"""Put fitted bodies and friction into a robot's own URDF, whose other contents stay."""

from collections.abc import Sequence
from xml.etree.ElementTree import (
    Element,
    SubElement,
    TreeBuilder,
    XMLParser,
    indent,
    parse,
    register_namespace,
    tostring,
)

import numpy as np
from numpy.typing import ArrayLike

from coordinator.description.urdf_reader import DRAKE, UrdfRobot, joint_pose
from coordinator.description.urdf_writer import comment_of, inertial_element, origin_of
from coordinator.dynamics.pseudo_inertia import Body


def fitted_urdf_text(
    robot: UrdfRobot, bodies: Sequence[Body], drives: ArrayLike, lacking: Sequence[str] = ()
) -> str:
    """Return the text of a robot's URDF with other bodies, friction and rotors.

    The inertia of a body is in the link right behind its joint; links fixed to that lose their own, which is
    contained in it. So do links behind a joint that was held for the fit, which becomes fixed where it was.
    The other joints get viscous and Coulomb friction, and a transmission with the rotor's inertia behind the
    gear, as Drake reads it.

    Args:
        robot: of `read_urdf`, whose file is read again. bodies: (n,) in the frames of the links
        `robot.bodies`.
        drives: (n, 3) rotor inertia [kg m^2], viscous [Nm s/rad] and Coulomb [Nm] of every joint.
        lacking: what was identified and has no place in a URDF, for the comment.
    """
    register_namespace("drake", DRAKE)
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
    transmissions = {
        joint.get("name"): one
        for one in root.findall("transmission")
        if (joint := one.find("joint")) is not None
    }
    values = dict(zip(robot.chain.serials, np.asarray(drives).tolist(), strict=True))
    fixed = []
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        if name in robot.held:
            _fix(joint, robot.held[name])
            fixed.append(name)
        if name in values:
            rotor, damping, friction = values[name]
            for old in joint.findall("dynamics"):
                joint.remove(old)
            SubElement(joint, "dynamics", damping=_exact(damping), friction=_exact(friction))
            if rotor > 0.0 or name in transmissions:
                _set_rotor(root, transmissions.get(name), name, rotor)
    indent(root)
    comment = "Inertias, friction and rotors (kg m^2, behind the gear) were identified from torques."
    lacks = f" Identified, but not in this file: {', '.join(lacking)}." if lacking else ""
    held = f" Fixed, as they were held: {', '.join(fixed)}." if fixed else ""
    root.insert(0, comment_of(f"{comment}{held}{lacks}"))
    return str(tostring(root, encoding="utf-8", xml_declaration=True), "utf-8")


def _fix(joint: Element, position: float) -> None:
    """Fix a joint at a position [rad, m]; what only a moving one has goes."""
    pose = joint_pose(joint, position)
    joint.set("type", "fixed")
    for part in list(joint):
        if part.tag not in ("parent", "child"):
            joint.remove(part)
    SubElement(joint, "origin", origin_of(pose))


def _set_rotor(root: Element, transmission: Element | None, joint: str, inertia: float) -> None:
    if transmission is None:
        transmission = SubElement(root, "transmission", name=f"{joint}_transmission")
        SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
        SubElement(transmission, "joint", name=joint)
    actuator = transmission.find("actuator")
    if actuator is None:
        actuator = SubElement(transmission, "actuator", name=f"{joint}_motor")
    for key, value in (("rotor_inertia", inertia), ("gear_ratio", 1.0)):
        for old in actuator.findall(f"{{{DRAKE}}}{key}"):
            actuator.remove(old)
        SubElement(actuator, f"{{{DRAKE}}}{key}", value=_exact(value))


def _exact(values: ArrayLike) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values).ravel())

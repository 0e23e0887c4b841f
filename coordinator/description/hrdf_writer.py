"""The identified robot in the manufacturer's robot description format (HRDF 1.6), for its API and tools.

A forward X5 module is an `actuator`, which goes from its housing to its output; what was identified between
two modules is a `rigid-body`. The format has no actuator that is mounted by its output and none for modules
other than its own types: those are a `joint` about z between rigid bodies. Every joint is tagged with its
serial, every end of a branch with `tip_<serial>`. IMUs, limits and uncertainty are in `result.json` only. The
base frame has z up; the degrees of freedom are in the order of the file, which a comment in it repeats.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import ArrayLike

from coordinator.description.urdf_writer import (
    ALL_DETERMINED,
    INERTIA,
    comment,
    comment_undetermined,
    inertia_attributes,
    link_homes,
    numbers,
    upright_pose,
    write_xml,
)
from coordinator.dynamics.inertia_prior import modules_alone
from coordinator.dynamics.pseudo_inertia import body, is_consistent, nearest_consistent, pseudo_inertia
from coordinator.kinematics.frames import distal_homes, housing_homes
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.regressor import PER_BODY, check_phi

VERSION = "1.6.0"
# Two frames, or a joint's axis and its module's, are the same below this (m, and rad at a metre).
SAME_BELOW = 1e-11


class _Robot(NamedTuple):
    """The frames before, after and at the moved face of every joint, its actuator and its body.

    bodies: (n, 4, 4) pseudo-inertias. identified: whether those of the actuators are part of them.
    """

    chain: Chain
    entry: Array
    leave: Array
    actuator: tuple[str | None, ...]
    tip: Array
    bodies: Array
    identified: bool
    undetermined: Mapping[str, Sequence[str]]


def write_hrdf(
    path: Path,
    chain: Chain,
    types: Sequence[ModuleType],
    phi: ArrayLike | None = None,
    name: str = "robot",
    undetermined: Mapping[str, Sequence[str]] = ALL_DETERMINED,
) -> None:
    """Write the robot of n joints, with a type each; the file is the complete old or the complete new one.

    phi: (10 n,) inertial parameters as in `torque_regressor`. They include the modules' own masses, so that
    the actuators get none; without them modules have their types' mass and links none.
    undetermined: by the serial, parameters of its body that torques alone do not determine; a comment before
        the body names them.

    Raises:
        ValueError: `phi` or `types` do not fit the chain.
        OSError: the file cannot be written.
    """
    write_xml(path, hrdf_element(chain, types, phi, name, undetermined))


def hrdf_element(
    chain: Chain,
    types: Sequence[ModuleType],
    phi: ArrayLike | None = None,
    name: str = "robot",
    undetermined: Mapping[str, Sequence[str]] = ALL_DETERMINED,
) -> Element:
    """Return the `robot` element; for the arguments and errors see `write_hrdf`."""
    housing, tip, axes = housing_homes(chain, types), distal_homes(chain, types), link_homes(chain)
    made = tuple(_actuator(chain, k, kind, tip[k]) for k, kind in enumerate(types))
    if phi is None:
        bodies = modules_alone(chain, types, [k for k, actuator in enumerate(made) if actuator is None])
    else:
        bodies = np.stack([pseudo_inertia(one) for one in check_phi(chain, phi).reshape(-1, PER_BODY)])
    is_made = np.array([m is not None for m in made])[:, None, None]
    entry, leave = np.where(is_made, housing, axes), np.where(is_made, tip, axes)
    rot = numbers(upright_pose(chain.gravity)[:3, :3])
    robot = Element("robot", version=VERSION, rot=rot, description=name)
    order = ", ".join(chain.serials[k] for k in joint_order(chain))
    comment(robot, f"Lengths in m. The order of the degrees of freedom: {order}.")
    unidentified = "Masses are not identified: modules have their types' mass, and links have none."
    comment(
        robot, unidentified if phi is None else "The modules' own masses are part of the identified bodies."
    )
    own = _Robot(chain, entry, leave, made, tip, bodies, phi is not None, undetermined)
    _follow(robot, own, BASE, np.eye(4))
    return robot


def joint_order(chain: Chain) -> tuple[int, ...]:
    """Return the joints in the order in which the format counts its degrees of freedom: branch by branch."""
    order: list[int] = []
    stack = list(reversed(chain.roots))
    while stack:
        joint = stack.pop()
        order.append(joint)
        stack += reversed(chain.children(joint))
    return tuple(order)


def _actuator(chain: Chain, k: int, kind: ModuleType, output: Array) -> str | None:
    """Return the format's type for a module, None if it has none that turns as this one does."""
    off = output[:3, 3] - chain.point[k]
    across = off - chain.axis[k] * (chain.axis[k] @ off)
    apart = max(float(np.abs(output[:3, 2] - chain.axis[k]).max()), float(np.abs(across).max()))
    return kind.hrdf_actuator if kind.hrdf_actuator and not chain.reversed[k] and apart < SAME_BELOW else None


def _follow(parent: Element, robot: _Robot, carrier: int, frame: Array) -> None:
    """Add the elements of the body `carrier`, which begins at `frame`; recursive at forks only."""
    while True:
        children = robot.chain.children(carrier)
        if len(children) != 1:
            break
        _rigid(parent, robot, carrier, frame, robot.entry[children[0]])
        carrier, frame = children[0], _joint(parent, robot, children[0])
    if not children:
        _rigid(parent, robot, carrier, frame, frame)
        tip = _pose(np.linalg.inv(frame) @ robot.tip[carrier], "output_")
        SubElement(
            parent, "end-effector", {"type": "Custom", "tag": f"tip_{robot.chain.serials[carrier]}"} | tip
        )
        return
    fork = SubElement(parent, "rigid-body", _mass(parent, robot, carrier, frame))
    for child in children:
        output = SubElement(fork, "output", _pose(np.linalg.inv(frame) @ robot.entry[child], ""))
        _follow(output, robot, child, _joint(output, robot, child))


def _joint(parent: Element, robot: _Robot, k: int) -> Array:
    """Add joint k and return the frame after it at q = 0."""
    serial, made = robot.chain.serials[k], robot.actuator[k]
    if made is None:
        SubElement(parent, "joint", {"axis": "rz", "tag": serial})
    else:
        none = dict.fromkeys(("mass", *INERTIA), "0") if robot.identified else {}
        SubElement(parent, "actuator", {"type": made, "tag": serial} | none)
    return np.asarray(robot.leave[k])


def _rigid(parent: Element, robot: _Robot, carrier: int, frame: Array, end: Array) -> None:
    """Add the body from `frame` to `end`, unless it is neither long nor heavy."""
    across = np.linalg.inv(frame) @ end
    if np.abs(across - np.eye(4)).max() < SAME_BELOW and not _is_heavy(robot, carrier):
        return
    SubElement(parent, "rigid-body", _mass(parent, robot, carrier, frame) | _pose(across, "output_"))


def _is_heavy(robot: _Robot, carrier: int) -> bool:
    return carrier != BASE and bool(robot.bodies[carrier].any())


def _mass(parent: Element, robot: _Robot, carrier: int, frame: Array) -> dict[str, str]:
    """Return the mass attributes of a body in `frame`; a comment says where it had to be made a real one."""
    if not _is_heavy(robot, carrier):
        return {"mass": "0"}
    comment_undetermined(parent, robot.undetermined.get(robot.chain.serials[carrier], ()))
    into = np.linalg.inv(frame)
    pseudo = into @ robot.bodies[carrier] @ into.T
    if not is_consistent(pseudo):
        comment(
            parent,
            "The identified parameters of the next body are no real body's; this is the nearest real one. "
            "For torques use those in result.json.",
        )
        pseudo = nearest_consistent(pseudo)
    real = body(pseudo)
    mass = {"mass": numbers(real.mass_kg), "com_trans": numbers(real.com_m)}
    return mass | inertia_attributes(real, numbers)


def _pose(pose: Array, prefix: str) -> dict[str, str]:
    return {f"{prefix}trans": numbers(pose[:3, 3]), f"{prefix}rot": numbers(pose[:3, :3])}

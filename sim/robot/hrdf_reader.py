"""Robots from the manufacturer's robot description format (HRDF 1.x), made of parts that the simulator has.

A robot is a chain of elements in the order of the file; `<output>` in a rigid body begins a branch. Numbers
are formulas of `pi`, + - * / and brackets, rotations nine numbers or a product such as Rx(pi/2)*Rz(pi). Words
are the same in lower and upper case. A module's serial is its element's tag.
"""

import ast
import math
import operator
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError, fromstring

import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from module_agent.model.catalogue import CATALOGUE
from module_agent.model.model_faults import faults_of, first_fault
from sim.geometry.link_parts import BRACKETS, End, FreePose, Part, Tube, placed
from sim.geometry.pose import Array
from sim.geometry.rigid_body import RigidBody, joined, moved
from sim.robot.robot_file import BASE, Base, Module, Robot, RobotFileError

_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: lambda a, b: a @ b if isinstance(a, np.ndarray) else a * b,
    ast.Div: operator.truediv,
}
_AXES = {"rx": "x", "ry": "y", "rz": "z"}
_INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
# HRDF's names of what a file may call otherwise here.
_BRACKETS = {name.lower().removeprefix("x5"): name for name in BRACKETS}
_COMMON = {"tag", "name"}
_ENDS = {"rightangle": "RightAngle", "inline": "Inline"}
_OURS: dict[str, End] = {"RightAngle": "right-angle", "Inline": "inline"}
_END_EFFECTORS = {"custom": "Custom", "x5parallel": "X5Parallel"}
# The parallel gripper: mass, centre and output as hebi-py has them. Its inertia is not published; this is
# that of a uniform box of 60 by 60 by 90 mm on the module's face.
_GRIPPER = FreePose(
    mass_kg=0.2464,
    com_xyz_m=(0.0, 0.0, 0.045),
    inertia=(2.4e-4, 2.4e-4, 1.5e-4, 0.0, 0.0, 0.0),
    xyz_m=(0.0, 0.0, 0.095),
)
# Attributes of each element; any other one would be read wrongly by being left out.
_KNOWN = {
    "actuator": {"type"},
    "bracket": {"type", "mass_offset"},
    "link": {"type", "extension", "twist", "input", "output", "mass_offset"},
    "rigid-body": {"mass", "com_trans", "com_rot", *_INERTIA, "output_trans", "output_rot"},
    "end-effector": {"type", "mass", "com_trans", "com_rot", *_INERTIA, "output_trans", "output_rot"},
    "output": {"trans", "rot"},
    "robot": {"version", "trans", "rot", "description"},
}


def read_hrdf(path: Path) -> Robot:
    """Return the robot of a file; it stands on the floor unless the file turns it.

    Raises:
        RobotFileError: the file cannot be read, or has what the simulator has not; the message says what.
    """
    try:
        root = fromstring(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ParseError) as error:
        raise RobotFileError(f"{path}: no HRDF can be read: {error}") from error
    return _Reader(path).robot(root)


class _Place(NamedTuple):
    """Where the file has come to: the module that carries it, and the parts since its output."""

    parent: str
    parts: tuple[Part, ...]


class _Reader:
    """Reads the elements of one file."""

    def __init__(self, path: Path):
        self._path = path
        self._modules: list[dict[str, Any]] = []
        # Bodies behind the last module of a branch, in its output's frame.
        self._loads: dict[str, list[RigidBody]] = {}

    def robot(self, root: Element) -> Robot:
        if root.tag.lower() != "robot":
            raise self._fail(f"its root is <{root.tag}>, that of HRDF is <robot>")
        self._check(root)
        self._branch(root, _Place(BASE, ()))
        if not self._modules:
            raise self._fail("it has no actuator")
        roll, pitch, yaw = Rotation.from_matrix(self._rotation(root, "rot")).as_euler("xyz", degrees=True)
        try:
            modules = [
                Module.model_validate(one | {"payload": self._payload(one["serial"])})
                for one in self._modules
            ]
            name = re.sub(r"[^A-Za-z0-9_.-]+", "-", self._path.stem).lstrip("_.-") or "robot"
            base = Base(rpy_deg=(roll, pitch, yaw))
            return Robot.model_validate({"name": name, "base": base, "module": modules})
        except ValidationError as error:
            raise self._fail(first_fault(error)) from error

    def _branch(self, parent: Element, at: _Place) -> None:
        """Follow the elements of a branch, and leave what is behind its last module to that module."""
        for element in parent:
            self._check(element)
            outputs = [child for child in element if child.tag.lower() == "output"]
            before = at
            at = self._element(element, at)
            for number, output in enumerate(outputs):
                # The body itself is counted once, in its first branch.
                own = (self._solid(element, "") if number == 0 else FreePose(),)
                self._check(output)
                trunk = before.parts if number == 0 else _massless(before.parts)
                step = self._posed(self._vector(output, "trans"), self._rotation(output, "rot"))
                parts = (*trunk, *(Part(pose=one) for one in (*own, step)))
                self._branch(output, _Place(at.parent, parts))
            if outputs:
                return
        if at.parent != BASE:
            self._loads.setdefault(at.parent, []).extend(_bodies(at.parts))

    def _element(self, element: Element, at: _Place) -> _Place:
        kind = element.tag.lower()
        if kind == "actuator":
            return _Place(self._actuator(element, at), ())
        if kind == "link":
            part = Part(tube=self._tube(element))
        elif kind == "bracket":
            part = Part(bracket=self._word(element, "type", _BRACKETS, "x5"))
        elif kind == "end-effector" and self._word(element, "type", _END_EFFECTORS, "", "custom") != "Custom":
            if own := sorted(element.attrib.keys() - {"type"} - _COMMON):
                raise self._fail(
                    f"<{element.tag}> has {', '.join(own)}, which only those of type Custom have"
                )
            part = Part(pose=_GRIPPER)
        else:
            part = Part(pose=self._solid(element, "output_"))
        return _Place(at.parent, (*at.parts, *self._more(element, part), part))

    def _more(self, element: Element, part: Part) -> tuple[Part, ...]:
        """Return what a library part weighs more here, at its centre of mass, as a part before it."""
        mass = self._number(element, "mass_offset")
        if not mass:
            return ()
        more = RigidBody(mass, placed(part).body.com_m, np.zeros((3, 3)))
        return (Part(pose=self._posed(np.zeros(3), np.eye(3), more)),)

    def _actuator(self, element: Element, at: _Place) -> str:
        types: dict[str, str] = {}
        for name, one in CATALOGUE.items():
            # The first of a type is the one that is made today.
            types.setdefault(one.hrdf_actuator.lower(), name)
        types.pop("", None)
        kind = self._word(element, "type", types)
        serial = element.get("tag") or element.get("name") or f"actuator-{len(self._modules) + 1}"
        if any(one["serial"] == serial for one in self._modules):
            raise self._fail(f"two actuators have the tag {serial!r}; a module's serial is its tag")
        self._modules.append({"serial": serial, "type": kind, "parent": at.parent, "link": at.parts})
        return serial

    def _tube(self, element: Element) -> Tube:
        self._word(element, "type", {"x5": "X5"})
        first, last = (self._word(element, end, _ENDS, "", "RightAngle") for end in ("input", "output"))
        length, twist = (self._number(element, name) for name in ("extension", "twist"))
        try:
            return Tube(length_m=length, twist_rad=twist, input=_OURS[first], output=_OURS[last])
        except ValidationError as error:
            place, reason = faults_of(error)[0]
            name = {"length_m": "extension", "twist_rad": "twist"}.get(str(place[0]), "") if place else ""
            raise self._fail(f"<{element.tag}>: {name + ': ' if name else ''}{reason}") from error

    def _solid(self, element: Element, prefix: str) -> FreePose:
        """Return a rigid body; its output is as attributes with this prefix say, none without."""
        turn = self._rotation(element, "com_rot")
        ixx, iyy, izz, ixy, ixz, iyz = (self._number(element, name) for name in _INERTIA)
        inertia = turn @ np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]) @ turn.T
        across, rotation = np.zeros(3), np.eye(3)
        if prefix:
            across, rotation = (
                self._vector(element, f"{prefix}trans"),
                self._rotation(element, f"{prefix}rot"),
            )
        mass, com = self._number(element, "mass"), self._vector(element, "com_trans")
        return self._posed(across, rotation, RigidBody(mass, com, inertia))

    def _payload(self, serial: str) -> FreePose | None:
        load = joined(self._loads.get(serial, ()))
        return self._posed(np.zeros(3), np.eye(3), load) if load.mass_kg else None

    def _posed(self, xyz: Array, rotation: Array, body: RigidBody | None = None) -> FreePose:
        try:
            return _free(xyz, rotation, body)
        except ValidationError as error:
            raise self._fail(first_fault(error)) from error

    # ------------------------------------------------------------------ attributes

    def _fail(self, reason: str) -> RobotFileError:
        return RobotFileError(f"{self._path}: {reason}")

    def _check(self, element: Element) -> None:
        kind = element.tag.lower()
        if kind not in _KNOWN:
            known = ", ".join(sorted(_KNOWN.keys() - {"robot"}))
            raise self._fail(f"<{element.tag}> is not known; known are {known}")
        if unknown := sorted(element.attrib.keys() - _KNOWN[kind] - _COMMON):
            why = "; a module's mass is its type's" if kind == "actuator" else ""
            raise self._fail(f"<{element.tag}> has {', '.join(unknown)}, which is not known here{why}")

    def _word(
        self, element: Element, name: str, known: dict[str, str], prefix: str = "", default: str = ""
    ) -> str:
        word = element.get(name, default).lower()
        found = known.get(word) or known.get(word.removeprefix(prefix))
        if found is None:
            raise self._fail(
                f"<{element.tag}> of {name} {element.get(name)!r}; known are {', '.join(known.values())}"
            )
        return found

    def _number(self, element: Element, name: str) -> float:
        return self._scalar(element, name, element.get(name, "0"))

    def _vector(self, element: Element, name: str) -> Array:
        words = element.get(name, "0 0 0").split()
        if len(words) != 3:
            raise self._fail(f"<{element.tag}>: {name} has {len(words)} numbers, not 3")
        return np.array([self._scalar(element, name, word) for word in words])

    def _rotation(self, element: Element, name: str) -> Array:
        text = element.get(name, "1 0 0 0 1 0 0 0 1")
        if "r" in text.lower():
            found = np.asarray(self._formula(element, name, text))
        else:
            words = text.split()
            found = np.array([self._scalar(element, name, word) for word in words])
        matrix = found.reshape(3, 3) if found.size == 9 else np.zeros((3, 3))
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-4 or np.linalg.det(matrix) < 0.0:
            raise self._fail(f"<{element.tag}>: {name} {text!r} is no rotation")
        return matrix

    def _scalar(self, element: Element, name: str, text: str) -> float:
        value = self._formula(element, name, text)
        if np.ndim(value):
            raise self._fail(f"<{element.tag}>: {name} {text!r} is a rotation, not a number")
        return float(value)

    def _formula(self, element: Element, name: str, text: str) -> Any:
        try:
            value = _value(ast.parse(text.strip(), mode="eval").body)
        except (SyntaxError, ValueError, TypeError, ZeroDivisionError, RecursionError) as error:
            raise self._fail(f"<{element.tag}>: {name} {text!r} is no number or formula") from error
        if not np.all(np.isfinite(value)):
            raise self._fail(f"<{element.tag}>: {name} {text!r} is not finite")
        return value


def _value(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=int() | float() as number):
            return float(number)
        case ast.Name(id=name) if name.lower() == "pi":
            return math.pi
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            return -_value(inner)
        case ast.UnaryOp(op=ast.UAdd(), operand=inner):
            return _value(inner)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(left), _value(right))
        case ast.Call(func=ast.Name(id=name), args=[angle]) if name.lower() in _AXES:
            return Rotation.from_euler(_AXES[name.lower()], _value(angle)).as_matrix()
    raise ValueError(ast.dump(node))


def _free(xyz: Array, rotation: Array, body: RigidBody | None = None) -> FreePose:
    rpy = Rotation.from_matrix(rotation).as_euler("xyz", degrees=True)
    place = {"xyz_m": tuple(xyz.tolist()), "rpy_deg": tuple(rpy.tolist())}
    if body is None or not body.mass_kg:
        return FreePose.model_validate(place)
    i = body.inertia_kg_m2
    moments = tuple(float(i[at]) for at in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    solid = {"mass_kg": body.mass_kg, "com_xyz_m": tuple(body.com_m.tolist()), "inertia": moments}
    return FreePose.model_validate(place | solid)


def _bodies(parts: Sequence[Part]) -> list[RigidBody]:
    """Return the bodies of parts in the frame in which the first one begins."""
    bodies, at = [], np.eye(4)
    for part in parts:
        one = placed(part)
        bodies.append(moved(one.body, at))
        at = at @ one.output
    return bodies


def _massless(parts: Sequence[Part]) -> tuple[Part, ...]:
    """Return where parts lead to, without their bodies."""
    at = np.eye(4)
    for part in parts:
        at = at @ placed(part).output
    return (Part(pose=_free(at[:3, 3], at[:3, :3])),) if parts else ()

"""Safety files: the limits of a robot's modules as TOML, or as the manufacturer's safety parameters in XML.

[default]                       # what modules have that say nothing else
position_rad = [-1.5, 1.5]      # -inf and inf: no limit
at_limit = "hold"               # disabled, motor_off, hold or spring; ["hold", "spring"] for lower and upper
velocity_rad_s = 1.0            # or [-1.0, 0.5]; so with the next
effort_nm = 5.0
current_a = 1.2
winding_c = 120.0
braking_rad_s2 = 5.0
m_stop = "motor_off"            # disabled, motor_off or hold

[module.X-00009]                # what this one has instead
position_rad = [-0.5, 0.5]

The keys are those of `Safety`. XML has a value for each module, in their order, and neither current, winding
nor braking; its root is `safety`, with values for all, or `group_safety`.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring
from xml.parsers import expat

from pydantic import ValidationError

from module_agent.control.safety import UNCONFIGURED, LimitAction, MStopAction, Safety
from module_agent.model.errors import UsageError
from module_agent.model.model_faults import Location, faults_of
from module_agent.model.toml_location import fault_lines, parse_toml

_POSITION_ACTIONS: dict[str, LimitAction] = {
    "disabled": "disabled",
    "motor_off": "motor_off",
    "off": "motor_off",
    "motor_hold": "hold",
    "hold": "hold",
    "spring": "spring",
}
_M_STOPS: dict[str, MStopAction] = {
    "disabled": "disabled",
    "motor_off": "motor_off",
    "off": "motor_off",
    "motor_hold": "hold",
    "hold": "hold",
}
# How the manufacturer writes the words.
_WRITTEN = {"disabled": "disabled", "motor_off": "motor_off", "hold": "motor_hold", "spring": "spring"}
# What XML can say of a module, and what HEBI's modules have.
XML_FIELDS = {"position_rad", "at_limit", "velocity_rad_s", "effort_nm", "m_stop"}


class SafetyFileError(UsageError):
    """A safety file cannot be read or written; the message names file, line and key."""


def read_safety(path: Path, serials: Sequence[str], whole_robot: bool = False) -> dict[str, Safety]:
    """Return the configuration of the modules with these serials, in whose order the values of XML are.

    whole_robot: these are all modules of the robot, so that a table for another one is a mistake.

    Raises:
        SafetyFileError: the file cannot be read, is wrong, or says nothing of a module.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SafetyFileError(f"{path}: cannot be read: {error}") from error
    if path.suffix.lower() == ".xml" or text.lstrip().startswith("<"):
        return dict(zip(serials, _read_xml(text, path, len(serials)), strict=True))
    return _read_toml(text, path, serials, whole_robot)


# ------------------------------------------------------------------ TOML


def _read_toml(text: str, path: Path, serials: Sequence[str], whole_robot: bool) -> dict[str, Safety]:
    data = parse_toml(text, str(path), SafetyFileError)
    tables = data.get("module", {})
    faults: list[tuple[Location, str]] = [
        ((key,), "unknown key: a safety file has [default] and [module.SERIAL]")
        for key in data
        if key not in ("default", "module")
    ]
    named: list[tuple[Location, Any]] = [(("default",), data.get("default", {})), (("module",), tables)]
    if isinstance(tables, dict):
        named += [(("module", serial), table) for serial, table in tables.items()]
    faults += [(location, "must be a table") for location, table in named if not isinstance(table, dict)]
    if faults:
        raise SafetyFileError(fault_lines(faults, text, path))
    # Checked whole, and those of other modules, too: a wrong key must not wait for its module.
    default = _checked(data.get("default", {}), ("default",), text, path)
    own = {s: _checked({**default, **table}, ("module", s), text, path) for s, table in tables.items()}
    missing = [serial for serial in serials if serial not in tables] if "default" not in data else []
    if missing:
        raise SafetyFileError(
            f"{path}:1: it says nothing of {', '.join(missing)}: give each a table [module.SERIAL], or all a "
            "[default]"
        )
    others = [serial for serial in tables if serial not in serials] if whole_robot else []
    if others:
        known = ", ".join(serials)
        raise SafetyFileError(
            fault_lines(
                [(("module", s), f"the robot has no such module, it has {known}") for s in others], text, path
            )
        )
    return {serial: Safety.model_validate(own.get(serial, default)) for serial in serials}


def _checked(table: dict[str, Any], location: Location, text: str, path: Path) -> dict[str, Any]:
    try:
        Safety.model_validate(table)
    except ValidationError as error:
        # The place in a pair says nothing that the line does not.
        faults = [((*location, *at[:1]), reason) for at, reason in faults_of(error)]
        raise SafetyFileError(fault_lines(faults, text, path)) from error
    return table


def safety_toml(safety: Mapping[str, Safety]) -> str:
    """Return the safety file of modules by serial; `read_safety` reads it back as it was."""
    lines = []
    for serial, one in safety.items():
        lines += [f'[module."{serial}"]', *(f"{k} = {_toml(v)}" for k, v in one if v is not None), ""]
    return "\n".join(lines)


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


# ------------------------------------------------------------------ XML


def _read_xml(text: str, path: Path, modules: int) -> list[Safety]:
    values = _XmlReader(path, modules).read(text)
    read = []
    for k in range(modules):
        fields: dict[str, Any] = {}
        for section, name in (
            ("position", "position_rad"),
            ("velocity", "velocity_rad_s"),
            ("effort", "effort_nm"),
        ):
            fields[name] = (
                values.of(k, section, "min_limit", -math.inf),
                values.of(k, section, "max_limit", math.inf),
            )
        fields["at_limit"] = values.of(k, "position", "limit_strategy", "hold")
        fields["m_stop"] = values.of(k, "mstop", "strategy", None)
        try:
            read.append(Safety.model_validate(fields))
        except ValidationError as error:
            (at, reason), *_ = faults_of(error)
            section = str(at[0]).split("_")[0]
            line = values.lines.get((section, "max_limit"), values.lines.get((section, "min_limit"), 1))
            raise SafetyFileError(
                f"{path}:{line}: {section}: module {k + 1} of {modules}: {reason}"
            ) from error
    return read


class _XmlReader:
    """Reads safety parameters; `lines` are those of the elements, by section and name."""

    def __init__(self, path: Path, modules: int):
        self._path, self._modules = path, modules
        self._values: dict[tuple[str, str], list[Any]] = {}
        self.lines: dict[tuple[str, str], int] = {}
        self._open: list[tuple[str, int]] = []
        self._text = ""
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._characters
        self._parser.StartDoctypeDeclHandler = self._doctype

    def read(self, text: str) -> "_XmlReader":
        try:
            self._parser.Parse(text, True)
        except expat.ExpatError as error:
            raise SafetyFileError(
                f"{self._path}:{error.lineno}: not XML: {expat.ErrorString(error.code)}"
            ) from error
        return self

    def of(self, module: int, section: str, name: str, default: Any) -> Any:
        """Return a value of one module, the default where the file has none."""
        values = self._values.get((section, name))
        return default if values is None else values[module]

    def _fail(self, reason: str, line: int | None = None) -> SafetyFileError:
        place = ".".join(name for name, _ in self._open)
        return SafetyFileError(f"{self._path}:{line or self._parser.CurrentLineNumber}: {place}: {reason}")

    def _doctype(self, *_: object) -> None:
        raise self._fail("a document type has no place in a safety file")

    def _start(self, name: str, _attributes: dict[str, str]) -> None:
        self._open.append((name, self._parser.CurrentLineNumber))
        self._text = ""
        place = tuple(name for name, _ in self._open)
        if len(place) == 1 and name not in ("safety", "group_safety"):
            raise self._fail("the root of a safety file is safety or group_safety")
        if len(place) == 2 and name not in _XML_ELEMENTS:
            raise self._fail(f"unknown element, known are {', '.join(_XML_ELEMENTS)}")
        if len(place) == 3 and name not in _XML_ELEMENTS[place[1]]:
            raise self._fail(f"unknown element, known are {', '.join(_XML_ELEMENTS[place[1]])}")
        if len(place) > 3:
            raise self._fail("nothing is in here")

    def _characters(self, text: str) -> None:
        self._text += text

    def _end(self, _name: str) -> None:
        line = self._open[-1][1]
        words, self._text = self._text.split(), ""
        if len(self._open) == 3:
            key = self._open[1][0], self._open[2][0]
            if key in self._values:
                raise self._fail("is given twice", line)
            self._values[key] = self._values_of(key, words, line)
            self.lines[key] = line
        elif words:
            raise self._fail(f"{words[0]!r} is in no element", line)
        self._open.pop()

    def _values_of(self, key: tuple[str, str], words: list[str], line: int) -> list[Any]:
        wanted = 1 if self._open[0][0] == "safety" else self._modules
        if len(words) != wanted:
            raise self._fail(f"{len(words)} values for {wanted} modules", line)
        read = _XML_ELEMENTS[key[0]][key[1]]
        values = []
        for word in words:
            try:
                values.append(read(word))
            except (KeyError, ValueError) as error:
                known = " ".join(_WORDS[key]) if key in _WORDS else "a number, -inf or inf"
                raise self._fail(f"{word!r} is not {known}", line) from error
        return values * (self._modules if wanted == 1 else 1)


def _number(word: str) -> float:
    value = float(word)
    if math.isnan(value):
        raise ValueError(word)
    return value


_RANGE: dict[str, Callable[[str], Any]] = {"min_limit": _number, "max_limit": _number}
_WORDS: dict[tuple[str, str], Iterable[str]] = {
    ("mstop", "strategy"): _M_STOPS,
    ("position", "limit_strategy"): _POSITION_ACTIONS,
}
_XML_ELEMENTS: dict[str, dict[str, Callable[[str], Any]]] = {
    "mstop": {"strategy": lambda word: _M_STOPS[word.lower()]},
    "position": {
        "limit_strategy": lambda word: _POSITION_ACTIONS[word.lower()],
        # The manufacturer's own programs write an infinite angle as nan.
        "min_limit": lambda word: -math.inf if math.isnan(float(word)) else float(word),
        "max_limit": lambda word: math.inf if math.isnan(float(word)) else float(word),
    },
    "velocity": _RANGE,
    "effort": _RANGE,
}


def safety_xml(safety: Sequence[Safety]) -> str:
    """Return the safety parameters of modules, in their order, as the manufacturer's programs read them.

    Raises:
        UsageError: a configuration has what the format does not.
    """
    for number, one in enumerate(safety, start=1):
        only = {key for key, value in one if value != getattr(UNCONFIGURED, key)} - XML_FIELDS
        if only:
            raise UsageError(f"module {number}: safety parameters in XML have no {', '.join(sorted(only))}")
    root = Element("group_safety", version="1.0.0")
    if any(one.m_stop for one in safety):
        m_stops = [_WRITTEN[one.m_stop] if one.m_stop else "" for one in safety]
        if "" in m_stops:
            raise UsageError(
                f"module {m_stops.index('') + 1} has no m_stop: XML has one for each or for none"
            )
        SubElement(SubElement(root, "mstop"), "strategy").text = " ".join(m_stops)
    ranges = [_one_action(number, one) for number, one in enumerate(safety, start=1)]
    position = SubElement(root, "position")
    SubElement(position, "limit_strategy").text = " ".join(_WRITTEN[action] for _, action in ranges)
    _write_limits(position, [limits for limits, _ in ranges])
    _write_limits(SubElement(root, "velocity"), [one.velocity_rad_s for one in safety])
    _write_limits(SubElement(root, "effort"), [one.effort_nm for one in safety])
    indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(root, encoding="unicode")}\n'


def _write_limits(section: Element, limits: Sequence[tuple[float, float]]) -> None:
    for name, values in zip(("min_limit", "max_limit"), zip(*limits, strict=True), strict=True):
        SubElement(section, name).text = " ".join(map(repr, values))


def _one_action(number: int, safety: Safety) -> tuple[tuple[float, float], LimitAction]:
    """Return the limits of a module's position and the action at both, which XML has in common.

    Raises:
        UsageError: the actions differ, and both limits are finite.
    """
    actions = {a for a, limit in zip(safety.at_limit, safety.range_rad, strict=True) if math.isfinite(limit)}
    if not actions:
        return safety.position_rad, "disabled"
    if len(actions) > 1:
        low, high = safety.at_limit
        raise UsageError(
            f"module {number} has {low} at its lower limit and {high} at its upper one: XML has one"
        )
    return safety.range_rad, actions.pop()

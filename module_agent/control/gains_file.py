"""The manufacturer's gains files: XML with one value per module in each element.

<group_gains><control_strategy>3 4</control_strategy><position><kp>0.5 15</kp></position></group_gains>

Files may be partial, and their elements come in any order; one value stands for all modules. What a file does
not say stays as it is. `inf` is no limit. Strategies are numbers; their names, which hebi-py refuses, are
read.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from xml.etree.ElementTree import (
    Element,
    ParseError,
    SubElement,
    TreeBuilder,
    XMLParser,
    fromstring,
    indent,
    tostring,
)

from pydantic import ValidationError

from module_agent.control.gains import check_gains, default_gains, for_message, from_message
from module_agent.model.catalogue import module_type
from module_agent.model.errors import UsageError
from module_agent.model.files import write_text
from module_agent.model.model_faults import first_fault
from module_agent.wire.messages import GainSet, PidGains
from module_agent.wire.refusal import WireError

ROOTS = ("group_gains", "gains")
LOOPS = ("position", "velocity", "effort")
STRATEGIES = ("Off", "DirectPWM", "Strategy2", "Strategy3", "Strategy4")

T = TypeVar("T")


class GainsFileError(UsageError):
    """A gains file cannot be read; the message names file and element."""


class _Elements(TreeBuilder):
    """Builds the elements of a gains file, without a document type: its entities may grow to any size."""

    def __init__(self, path: Path):
        super().__init__()
        self._path = path

    def doctype(self, *_: object) -> None:
        raise GainsFileError(f"{self._path}: a document type has no place in a gains file")


class GainsFile(NamedTuple):
    """What a gains file says: of each element one value for all modules, or one for each.

    Attributes:
        path: the file.
        strategies: control strategies, 0-4; none if the file does not say them.
        gains: values by loop and gain.
    """

    path: Path
    strategies: list[int]
    gains: dict[tuple[str, str], list[float | bool]]

    def applied(self, present: Sequence[GainSet]) -> list[GainSet]:
        """Return the gains for modules that have the `present` ones, in their order.

        Raises:
            GainsFileError: the file is for another number of modules.
        """
        sets: list[dict[str, Any]] = [one.model_dump() for one in present]
        if self.strategies:
            strategies = self._each("control_strategy", self.strategies, len(sets))
            for own, strategy in zip(sets, strategies, strict=True):
                own["strategy"] = strategy
        for (loop, name), values in self.gains.items():
            for own, value in zip(sets, self._each(name, values, len(sets)), strict=True):
                own[loop][name] = value
        return [GainSet.model_validate(own) for own in sets]

    def _each(self, name: str, values: list[T], modules: int) -> list[T]:
        if len(values) not in (1, modules):
            raise GainsFileError(f"{self.path}: <{name}> has {len(values)} values for {modules} modules")
        return values * modules if len(values) == 1 else values


def read_gains(path: Path, modules: int | None = None) -> GainsFile:
    """Return what a gains file says.

    Args:
        path: the file.
        modules: for how many modules it has to be, None for any number.

    Raises:
        GainsFileError: no such file, not of this format, elements for different numbers of modules, or
            for another number than `modules`, or a gain that no module takes.
    """
    try:
        root = fromstring(path.read_text(encoding="utf-8"), XMLParser(target=_Elements(path)))
    except (OSError, UnicodeDecodeError, ParseError) as error:
        raise GainsFileError(f"{path}: no gains file can be read: {error}") from error
    if root.tag not in ROOTS:
        raise GainsFileError(f"{path}: its root is <{root.tag}>, that of a gains file is <{ROOTS[0]}>")
    strategies: list[int] = []
    gains: dict[tuple[str, str], list[float | bool]] = {}
    for element in root:
        if element.tag == "control_strategy":
            strategies = [_strategy(path, word) for word in _words(path, element)]
        elif element.tag in LOOPS:
            for gain in element:
                values = [_value(path, element.tag, gain.tag, word) for word in _words(path, gain)]
                gains[element.tag, gain.tag] = values
        else:
            raise GainsFileError(f"{path}: unknown element <{element.tag}>")
    found = GainsFile(path, strategies, gains)
    _check(found, modules)
    return found


def _check(found: GainsFile, modules: int | None) -> None:
    """Check the values with those of any modules, here the factory's: each is checked by itself."""
    if modules is None:
        modules = max((len(found.strategies), *(len(values) for values in found.gains.values()), 1))
    try:
        for own in found.applied([default_gains(module_type("X5-1"), 3)] * modules):
            check_gains(own)
    except ValidationError as error:
        raise GainsFileError(f"{found.path}: {first_fault(error)}") from error
    except WireError as error:
        raise GainsFileError(f"{found.path}: {error}") from error


def write_gains(path: Path, gains: Sequence[GainSet]) -> None:
    """Write the gains of modules in their order; the file is the complete old or the complete new one."""
    root = Element(ROOTS[0])
    SubElement(root, "control_strategy").text = " ".join(str(one.strategy) for one in gains)
    for loop in LOOPS:
        section = SubElement(root, loop)
        for name in PidGains.model_fields:
            values = [getattr(getattr(one, loop), name) for one in gains]
            SubElement(section, name).text = " ".join(_text(value) for value in values)
    indent(root, "\t")
    write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n")


def _words(path: Path, element: Element) -> list[str]:
    words = (element.text or "").split()
    if not words:
        raise GainsFileError(f"{path}: <{element.tag}> has no value")
    return words


def _strategy(path: Path, word: str) -> int:
    names = [name.lower() for name in STRATEGIES]
    if word.lower() in names:
        return names.index(word.lower())
    if word.isdigit() and int(word) < len(STRATEGIES):
        return int(word)
    raise GainsFileError(f"{path}: control strategy {word!r}; known are {', '.join(STRATEGIES)}")


def _value(path: Path, loop: str, name: str, word: str) -> float | bool:
    if name not in PidGains.model_fields:
        raise GainsFileError(f"{path}: unknown element <{name}> in <{loop}>")
    if name == "d_on_error" and word.lower() in ("true", "false"):
        return word.lower() == "true"
    try:
        value = float(word)
    except ValueError as error:
        raise GainsFileError(f"{path}: {loop}.{name}: {word!r} is no number") from error
    if math.isnan(value):
        raise GainsFileError(f"{path}: {loop}.{name}: {word!r} is no number")
    return value != 0.0 if name == "d_on_error" else for_message(value)


def _text(value: float | bool) -> str:
    if isinstance(value, bool):
        return str(int(value))
    return repr(from_message(float(value)))

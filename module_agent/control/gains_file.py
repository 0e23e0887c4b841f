"""The manufacturer's gains files: XML with one value per module in each element.

<group_gains><control_strategy>3 4</control_strategy><position><kp>0.5 15</kp></position></group_gains>

Files may be partial, and their elements come in any order; one value stands for all modules. What a file does
not say stays as it is. `inf` is no limit. Strategies are numbers; their names, which hebi-py refuses, are
read.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
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

from module_agent.control.gains import for_message, from_message
from module_agent.model.errors import UsageError
from module_agent.model.files import write_text
from module_agent.model.model_faults import first_fault
from module_agent.wire.messages import GainSet, PidGains

ROOTS = ("group_gains", "gains")
LOOPS = ("position", "velocity", "effort")
STRATEGIES = ("Off", "DirectPWM", "Strategy2", "Strategy3", "Strategy4")


class GainsFileError(UsageError):
    """A gains file cannot be read; the message names file and element."""


class _Elements(TreeBuilder):
    """Builds the elements of a gains file, without a document type: its entities may grow to any size."""

    def __init__(self, path: Path):
        super().__init__()
        self._path = path

    def doctype(self, *_: object) -> None:
        raise GainsFileError(f"{self._path}: a document type has no place in a gains file")


def read_gains(path: Path, present: Sequence[GainSet]) -> list[GainSet]:
    """Return the gains of a file for modules that have the `present` ones, in their order.

    Raises:
        GainsFileError: no such file, not of this format, for another number of modules, or a gain that
            cannot be.
    """
    try:
        root = fromstring(path.read_text(encoding="utf-8"), XMLParser(target=_Elements(path)))
    except (OSError, UnicodeDecodeError, ParseError) as error:
        raise GainsFileError(f"{path}: no gains file can be read: {error}") from error
    if root.tag not in ROOTS:
        raise GainsFileError(f"{path}: its root is <{root.tag}>, that of a gains file is <{ROOTS[0]}>")
    sets: list[dict[str, Any]] = [one.model_dump() for one in present]
    for element in root:
        if element.tag == "control_strategy":
            for own, word in zip(sets, _words(path, element, len(sets)), strict=True):
                own["strategy"] = _strategy(path, word)
        elif element.tag in LOOPS:
            for gain in element:
                for own, word in zip(sets, _words(path, gain, len(sets)), strict=True):
                    own[element.tag][gain.tag] = _value(path, element.tag, gain.tag, word)
        else:
            raise GainsFileError(f"{path}: unknown element <{element.tag}>")
    try:
        return [GainSet.model_validate(own) for own in sets]
    except ValidationError as error:
        raise GainsFileError(f"{path}: {first_fault(error)}") from error


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


def _words(path: Path, element: Element, modules: int) -> list[str]:
    words = (element.text or "").split()
    if len(words) not in (1, modules):
        raise GainsFileError(f"{path}: <{element.tag}> has {len(words)} values for {modules} modules")
    return words * modules if len(words) == 1 else words


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

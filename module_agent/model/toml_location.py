"""TOML files read and checked by a pydantic model: an error names file, line and key.

`tomllib` keeps no lines, so they are searched for in the text. What it reads but no setting can be is refused
here: nesting without end, and integers that TOML does not promise.
"""

import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from module_agent.model.errors import UsageError
from module_agent.model.model_faults import Location

_HEADER = re.compile(r"\s*(\[\[?)\s*([A-Za-z0-9_.\"-]+)\s*\]\]?")
_KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")
# No file of ours has more than six levels; TOML promises integers of 64 bits.
MAX_DEPTH = 16
MIN_INTEGER, MAX_INTEGER = -(2**63), 2**63 - 1
_DEEP = re.compile(rf"[\[{{](?:[^\[\]{{}}]*[\[{{]){{{MAX_DEPTH}}}")
_LONG = re.compile(r"\d[\d_]{999}")
_AT_LINE = re.compile(r"\(at line (\d+), column \d+\)")


def read_toml(path: Path, error: Callable[[str], Exception] = UsageError) -> tuple[dict[str, Any], str]:
    """Read a TOML file; return what it says, and its text, in which `fault_lines` finds the lines.

    Raises:
        Exception: what `error` makes of the message, by default a UsageError: the file cannot be read, or as
            `parse_toml`.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as fault:
        raise error(f"{path}: cannot be read: {fault.strerror or fault}") from fault
    except UnicodeDecodeError as fault:
        raise error(f"{path}: cannot be read, it is no text: {fault}") from fault
    return parse_toml(text, str(path), error), text


def parse_toml(text: str, name: str, error: Callable[[str], Exception]) -> dict[str, Any]:
    """Parse the text of the file `name`.

    Raises:
        Exception: what `error` makes of the message, which names file and line: the text is not TOML, nested
            deeper than `MAX_DEPTH`, or has an integer of more than 64 bits.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        match = _AT_LINE.search(str(fault))
        line = int(match.group(1)) if match else max(1, len(text.splitlines()))
        raise error(f"{name}:{line}: not TOML: {_AT_LINE.sub('', str(fault)).strip()}") from fault
    except RecursionError as fault:
        raise error(f"{name}:{_line_of_match(_DEEP, text)}: {_TOO_DEEP}") from fault
    except ValueError as fault:
        # Python reads no more than 4,300 digits.
        raise error(f"{name}:{_line_of_match(_LONG, text)}: {_TOO_LARGE}") from fault
    if unreadable := _unreadable(table):
        raise error(fault_lines([unreadable], text, name))
    return table


_TOO_DEEP = f"nested deeper than {MAX_DEPTH} levels"
_TOO_LARGE = "an integer of more than 64 bits"


def _line_of_match(pattern: re.Pattern[str], text: str) -> int:
    match = pattern.search(text)
    return 1 + text.count("\n", 0, match.start()) if match else 1


def _unreadable(table: dict[str, Any]) -> tuple[Location, str] | None:
    """Return where a document has what no setting can be, and what."""
    waiting: list[tuple[Location, Any]] = [((), table)]
    while waiting:
        location, value = waiting.pop()
        if len(location) > MAX_DEPTH:
            return location, _TOO_DEEP
        if isinstance(value, int) and not MIN_INTEGER <= value <= MAX_INTEGER:
            return location, _TOO_LARGE
        parts = (
            value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        )
        waiting += [((*location, key), part) for key, part in parts]
    return None


def fault_lines(faults: Iterable[tuple[Location, str]], text: str, name: str | Path) -> str:
    """Return one line for every fault, with file, line and key."""
    lines = []
    for location, reason in faults:
        key = "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in location).lstrip(".")
        lines.append(f"{name}:{line_of(text, location)}: {key + ': ' if key else ''}{reason}")
    return "\n".join(lines)


def line_of(text: str, location: Location) -> int:
    """Return the line (from 1) of a key, or of the nearest thing around it that is written in the text."""
    known = _index(text)
    for length in range(len(location), 0, -1):
        if location[:length] in known:
            return _within(text, known, location[:length], location[length:])
    return 1


def _index(text: str) -> dict[Location, int]:
    """Map every table header and every key at the beginning of a line to its line."""
    lines: dict[Location, int] = {}
    counts: dict[Location, int] = {}
    table: Location = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            table = _table(header.group(2).split("."), header.group(1) == "[[", counts)
            lines.setdefault(table, number)
        elif key := _KEY.match(line):
            lines.setdefault((*table, key.group(1)), number)
    return lines


def _table(names: list[str], repeated: bool, counts: dict[Location, int]) -> Location:
    """Return the location of a table; its parents are the latest ones of their arrays."""
    path: Location = ()
    for name in names[:-1]:
        path = (*path, name.strip('"'))
        if path in counts:
            path = (*path, counts[path])
    path = (*path, names[-1].strip('"'))
    if repeated:
        counts[path] = counts.get(path, -1) + 1
        path = (*path, counts[path])
    return path


def _within(text: str, known: dict[Location, int], parent: Location, rest: Location) -> int:
    """Follow the remaining names through the lines of a value that spans several."""
    lines, line = text.splitlines(), known[parent]
    end = min((n for n in known.values() if n > line), default=len(lines) + 1)
    for name in (k for k in rest if isinstance(k, str)):
        for number in range(line, end):
            if re.search(rf"(?<![A-Za-z0-9_-]){re.escape(name)}\s*=", lines[number - 1]):
                line = number
                break
    return line

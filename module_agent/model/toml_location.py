"""TOML files checked by a pydantic model: an error names file, line and key.

`tomllib` keeps no lines, so they are searched for in the text.
"""

import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from pydantic import ValidationError

Location = tuple[int | str, ...]

_HEADER = re.compile(r"\s*(\[\[?)\s*([A-Za-z0-9_.\"-]+)\s*\]\]?")
_KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")
_AT_LINE = re.compile(r"\(at line (\d+), column \d+\)")


def parse_toml(text: str, name: str, error: Callable[[str], Exception]) -> dict[str, Any]:
    """Parse the text of the file `name`.

    Raises:
        Exception: what `error` makes of the message, which names file and line.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        match = _AT_LINE.search(str(fault))
        line = int(match.group(1)) if match else max(1, len(text.splitlines()))
        raise error(f"{name}:{line}: not TOML: {_AT_LINE.sub('', str(fault)).strip()}") from fault


def faults_of(error: ValidationError) -> list[tuple[Location, str]]:
    """Return where a document does not fit its model, and why."""
    plain = {"extra_forbidden": "unknown key", "missing": "is missing"}
    return [
        (tuple(e["loc"]), plain.get(e["type"], str(e["msg"]).removeprefix("Value error, ")))
        for e in error.errors(include_url=False)
    ]


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

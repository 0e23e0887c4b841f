"""On which line of a TOML text a key stands; `tomllib` keeps no lines, and an error should name one."""

import re
import tomllib

Location = tuple[int | str, ...]

_HEADER = re.compile(r"\s*(\[\[?)\s*([A-Za-z0-9_.\"-]+)\s*\]\]?")
_KEY = re.compile(r"\s*([A-Za-z0-9_-]+)\s*=")
_AT_LINE = re.compile(r"\(at line (\d+), column \d+\)")


def syntax_error_line(error: tomllib.TOMLDecodeError, text: str) -> tuple[int, str]:
    """Return the line (from 1) and the reason of a syntax error."""
    match = _AT_LINE.search(str(error))
    if match is None:
        return max(1, len(text.splitlines())), str(error)
    return int(match.group(1)), _AT_LINE.sub("", str(error)).strip()


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
    start = known[parent]
    ends = [n for n in known.values() if n > start]
    end = min(ends, default=len(text.splitlines()) + 1)
    lines = text.splitlines()
    line = start
    for name in (k for k in rest if isinstance(k, str)):
        for number in range(line, end):
            if re.search(rf"(?<![A-Za-z0-9_-]){re.escape(name)}\s*=", lines[number - 1]):
                line = number
                break
    return line

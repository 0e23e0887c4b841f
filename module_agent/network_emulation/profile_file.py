"""Network files: a profile as TOML, with the fields of `NetworkProfile`, and its traces in files next to it.

name = "workshop"        # the file's own name if not given
delay_ms = 1.0
jitter_ms = 2.0

[stall]
apart_s = 5.0
mean_ms = 30.0

[to_coordinator]         # where this direction differs
trace = "uplink.csv"     # in this file's folder; see `trace`
"""

import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from module_agent.model.errors import UsageError
from module_agent.network_emulation.profile import PROFILES, NetworkProfile
from module_agent.network_emulation.toml_location import Location, line_of, syntax_error_line
from module_agent.network_emulation.trace import TraceError, read_trace


class NetworkError(UsageError):
    """No such network, or a file that describes none; the message names file, line and key."""


def network(value: str) -> NetworkProfile:
    """Return the profile of this name, or the one in the network file at this path.

    Raises:
        NetworkError: neither a known name nor a file, or the file is wrong; the message says where.
    """
    if value in PROFILES:
        return PROFILES[value]
    path = Path(value)
    if not path.is_file():
        raise NetworkError(
            f"unknown network profile {value!r}, and no such file; known are {', '.join(PROFILES)}"
        )
    return load_network(path)


def network_relative_to(value: str, folder: Path) -> str:
    """Return a name or path for `network` from one that is relative to a folder."""
    return value if value in PROFILES else str(folder / value)


def load_network(path: Path) -> NetworkProfile:
    """Load a network file and the traces that it names.

    Raises:
        NetworkError: the file cannot be read or describes no network; the message names file, line and key.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise NetworkError(f"{path}: cannot be read: {error}") from error
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        line, reason = syntax_error_line(error, text)
        raise NetworkError(f"{path}:{line}: not TOML: {reason}") from error
    data.setdefault("name", path.stem)
    _read_traces(data, path, text)
    try:
        return NetworkProfile.model_validate(data)
    except ValidationError as error:
        faults = [_fault(path, text, dict(e)) for e in error.errors(include_url=False)]
        raise NetworkError("\n".join(faults)) from error


def _read_traces(data: dict[str, Any], path: Path, text: str) -> None:
    """Replace the file names of traces by the traces."""
    for table in ((), ("to_modules",), ("to_coordinator",)):
        path_table = data.get(table[0]) if table else data
        if not isinstance(path_table, dict) or "trace" not in path_table:
            continue
        location: Location = (*table, "trace")
        where = f"{path}:{line_of(text, location)}: {_dotted(location)}"
        if not isinstance(path_table["trace"], str):
            raise NetworkError(f"{where}: must be the name of a CSV file")
        try:
            path_table["trace"] = read_trace(path.parent / path_table["trace"])
        except TraceError as error:
            raise NetworkError(f"{where}: {error}") from error


def _fault(path: Path, text: str, error: dict[str, Any]) -> str:
    location: Location = tuple(error["loc"])
    key = f"{_dotted(location)}: " if location else ""
    return f"{path}:{line_of(text, location)}: {key}{_reason(error)}"


def _dotted(location: Location) -> str:
    return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in location).lstrip(".")


def _reason(error: dict[str, Any]) -> str:
    if error["type"] == "extra_forbidden":
        return "unknown key"
    if error["type"] == "missing":
        return "is missing"
    return str(error["msg"]).removeprefix("Value error, ")

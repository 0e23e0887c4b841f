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

from pathlib import Path

from pydantic import ValidationError

from module_agent.model.errors import UsageError
from module_agent.model.model_faults import faults_of
from module_agent.model.toml_location import fault_lines, read_toml
from module_agent.network_emulation.profile import PROFILES, NetworkProfile
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
    table, text = read_toml(path, NetworkError)
    if not table:
        raise NetworkError(f"{path} sets nothing; for an undisturbed network give none")
    data = {"name": path.stem} | table
    for location in (("trace",), ("to_modules", "trace"), ("to_coordinator", "trace")):
        part = data if len(location) == 1 else data.get(location[0])
        if isinstance(part, dict) and "trace" in part:
            try:
                if not isinstance(part["trace"], str):
                    raise TraceError("must be the name of a CSV file")
                part["trace"] = read_trace(path.parent / part["trace"])
            except TraceError as error:
                raise NetworkError(fault_lines([(location, str(error))], text, path)) from error
    try:
        return NetworkProfile.model_validate(data)
    except ValidationError as error:
        raise NetworkError(fault_lines(faults_of(error), text, path)) from error

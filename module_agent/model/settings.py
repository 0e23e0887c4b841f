"""Settings that repeat on every command line: from `x5.toml`, or variables of the environment.

A command line takes precedence over a variable, a variable over the file. The file is `x5.toml` in the
working folder, or the one that `X5_SETTINGS` names; empty, it names none:

    robot = "my_arm"
    connect = ["tcp/192.168.1.5:7447"]
    secure = "keys"                      # relative to the file
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from module_agent.model.errors import UsageError
from module_agent.model.suggestion import did_you_mean
from module_agent.model.toml_location import read_toml

FILE, PREFIX = "x5.toml", "X5_"
SETTINGS_VARIABLE = "X5_SETTINGS"
# By the name of an option what the file may hold; lists for options that are repeated.
SETTINGS: Mapping[str, tuple[type, ...]] = {
    "robot": (str,),
    "listen": (str,),
    "connect": (str, list),
    "secure": (str,),
    "quiet": (bool,),
    "log_level": (str,),
}
LOG_LEVELS = ("debug", "info", "warning", "error")


def variable(name: str) -> str:
    """Return the variable of the environment for a setting: `X5_ROBOT` for `robot`."""
    return PREFIX + name.upper()


def read_settings(environment: Mapping[str, str], folder: Path) -> dict[str, Any]:
    """Return the settings of the file, none without a file.

    Args:
        environment: may name the file.
        folder: where it is otherwise.

    Raises:
        UsageError: the file that is named is not there, is no TOML, or has a setting that there is not.
    """
    named = environment.get(SETTINGS_VARIABLE)
    path = folder / FILE if named is None else Path(named)
    if named == "" or (named is None and not path.is_file()):
        return {}
    table, _ = read_toml(path, UsageError if named is None else _named)
    return {name.replace("-", "_"): _checked(path, name, value) for name, value in table.items()}


def _named(fault: str) -> UsageError:
    return UsageError(f"{SETTINGS_VARIABLE} names {fault}")


def _checked(path: Path, name: str, value: object) -> object:
    kinds = SETTINGS.get(name.replace("-", "_"))
    if kinds is None:
        raise UsageError(
            f"{path}: there is no setting {name!r}{did_you_mean(name, SETTINGS)}; "
            f"settings are {', '.join(SETTINGS)}"
        )
    items = value if isinstance(value, list) and list in kinds else [value]
    if not all(isinstance(item, kinds) and not isinstance(item, list) for item in items):
        raise UsageError(f"{path}: {name} = {value!r}; {' or '.join(k.__name__ for k in kinds)} is needed")
    if name == "secure":
        return str(path.parent / str(value))
    return items if list in kinds else value

"""Experiments of the thesis together: what is to be done, and what has been done before."""

import hashlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

import coordinator
import module_agent
import sim
from module_agent.model.errors import UsageError
from module_agent.model.files import write_text
from module_agent.model.suggestion import did_you_mean
from sim.thesis.experiment import Experiment, ExperimentResult, Scope, Unit

_SOURCES = (".py", ".toml")
_KEY_LENGTH = 24


def selected(known: Sequence[Experiment], only: Sequence[str] = ()) -> tuple[Experiment, ...]:
    """Return the known experiments of some identifiers in their order; all if none is given.

    Raises:
        UsageError: there is no such experiment; the message lists those that there are.
    """
    names = [each.id for each in known]
    for name in only:
        if name not in names:
            raise UsageError(
                f"no experiment {name!r}{did_you_mean(name, names)}; there are {', '.join(names)}"
            )
    return tuple(each for each in known if not only or each.id in only)


def units_of(chosen: Sequence[Experiment], scope: Scope) -> dict[str, Unit]:
    """Return the units of some experiments by key, each once."""
    return {key(unit): unit for each in chosen for unit in each.units(scope)}


def results(
    chosen: Sequence[Experiment], scope: Scope, measured: dict[str, Any]
) -> tuple[ExperimentResult, ...]:
    """Return the results of some experiments from those of all their units by key."""
    return tuple(each.result([measured[key(unit)] for unit in each.units(scope)]) for each in chosen)


def key(unit: Unit) -> str:
    """Return what the result of a unit depends on as a hash: function, arguments and the code's version."""
    work = f"{unit.work.__module__}.{unit.work.__qualname__}{unit.arguments!r}"
    return hashlib.sha256(f"{code_version()} {work}".encode()).hexdigest()[:_KEY_LENGTH]


@cache
def code_version() -> str:
    """Return a hash of all source files of the three packages, tables and robots included."""
    digest = hashlib.sha256()
    for package in (module_agent, coordinator, sim):
        folder = Path(package.__path__[0])
        for path in sorted(path for path in folder.rglob("*") if path.suffix in _SOURCES):
            digest.update(f"{folder.name}/{path.relative_to(folder).as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:_KEY_LENGTH]


class Store:
    """Results of units in a folder, one JSON file for each, named by its key."""

    def __init__(self, folder: Path):
        self._folder = folder

    def load(self, name: str, unit: Unit) -> Any:
        """Return the result of a unit; None if there is none, or its file is not whole."""
        path = self._path(name)
        try:
            return TypeAdapter(unit.kind).validate_json(path.read_bytes())
        except (FileNotFoundError, ValidationError):
            return None

    def keep(self, name: str, unit: Unit, result: Any) -> None:
        """Write the result of a unit.

        Raises:
            OSError: the file cannot be written.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        write_text(self._path(name), TypeAdapter(unit.kind).dump_json(result).decode() + "\n")

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.json"

"""The versions of a known robot: the run that it is known from first, and the runs that replace it since.

A robot's folder is that of its first run, version 1. Later versions are whole run folders in `versions/`,
numbered from 2; `versions/current` is a symbolic link to the one that holds, replaced in one step, and
`versions/history.json` says when and why. A reader finds the old version or the new one, complete.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from coordinator.recording.run_folder import RESULT
from module_agent.model.errors import UsageError
from module_agent.model.files import replacing, write_json
from module_agent.model.model_faults import first_fault

VERSIONS, CURRENT, HISTORY = "versions", "current", "history.json"
FIRST = 1

Change = Literal["replaced", "confirmed", "failed", "chosen"]


class HistoryEntry(BaseModel):
    """One line of the history of a robot.

    replaced: `version` is the model from then on. confirmed: it was measured, and the model before holds.
    failed: it could not be measured. chosen: a person made this version the current one again.
    utc: ISO 8601. folder: relative to the robot's.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    utc: str
    what: Change
    version: int
    folder: str
    why: tuple[str, ...] = ()
    found: tuple[str, ...] = ()


class VersionError(UsageError):
    """There is no such version, or its folder is damaged or not writable; the message names it."""


def current_run(folder: Path) -> Path:
    """Return the folder of the run that holds of a robot: its current version, or the folder itself.

    Raises:
        VersionError: the current version holds no result.
    """
    link = folder / VERSIONS / CURRENT
    if not link.is_symlink():
        return folder
    name = os.readlink(link)
    run = folder if name == os.pardir else folder / VERSIONS / name
    if not (run / RESULT).is_file():
        raise VersionError(
            f"{link} names {name}, which holds no {RESULT}: choose another version with "
            f"`x5-coordinator attend {folder} --use N`"
        )
    return run


class Versions:
    """The versions in a robot's folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def check_writable(self) -> None:
        """Check that new versions can be written; nothing is left behind.

        Raises:
            VersionError: they cannot.
        """
        folder = self.folder / VERSIONS
        try:
            with TemporaryFile(dir=folder if folder.exists() else self.folder):
                pass
        except OSError as error:
            raise VersionError(
                f"{folder}, where new models are kept, cannot be written: {error.strerror or error}"
            ) from error

    @property
    def current(self) -> Path:
        """The folder of the version that holds.

        Raises:
            VersionError: see `current_run`.
        """
        return current_run(self.folder)

    @property
    def current_number(self) -> int:
        """The number of the version that holds."""
        run = self.current
        return FIRST if run == self.folder else int(run.name)

    @property
    def history(self) -> tuple[HistoryEntry, ...]:
        """What has happened to the model since the first run.

        Raises:
            VersionError: the history cannot be read.
        """
        path = self.folder / VERSIONS / HISTORY
        if not path.is_file():
            return ()
        try:
            return _History.model_validate_json(path.read_bytes()).entries
        except ValidationError as error:
            raise VersionError(f"{path} is no history: {first_fault(error)}") from error

    def run_of(self, number: int) -> Path:
        """Return the folder of a version.

        Raises:
            VersionError: there is none, or it holds no result.
        """
        run = self.run_folder(number)
        if not (run / RESULT).is_file():
            raise VersionError(f"{self.folder} has no version {number}: {run / RESULT} is missing")
        return run

    def next_run(self) -> Path:
        """Return the folder for the next measurement; no earlier one had its number."""
        taken = [int(path.name) for path in (self.folder / VERSIONS).glob("[0-9]*") if path.name.isdecimal()]
        return self.folder / VERSIONS / f"{max([FIRST, *taken]) + 1:04d}"

    def replace(self, number: int, utc: str, why: Sequence[str], found: Sequence[str]) -> None:
        """Note a version, and make it the current one.

        Raises:
            VersionError: see `run_of`.
            OSError: the link or the history cannot be written.
        """
        self.run_of(number)
        # First, so that a version that cannot be noted does not hold either.
        self.note("replaced", number, utc, why, found)
        self._point(number)

    def choose(self, number: int, utc: str) -> None:
        """Make an earlier version the current one again; errors as of `replace`."""
        self._point(number)
        self.note("chosen", number, utc)

    def note(
        self, what: Change, number: int, utc: str, why: Sequence[str] = (), found: Sequence[str] = ()
    ) -> None:
        """Add a line to the history."""
        name = str(self.run_folder(number).relative_to(self.folder))
        entry = HistoryEntry(
            utc=utc, what=what, version=number, folder=name, why=tuple(why), found=tuple(found)
        )
        (self.folder / VERSIONS).mkdir(exist_ok=True)
        write_json(self.folder / VERSIONS / HISTORY, _History(entries=(*self.history, entry)))

    def run_folder(self, number: int) -> Path:
        """Return where a version is, or would be."""
        return self.folder if number == FIRST else self.folder / VERSIONS / f"{number:04d}"

    def _point(self, number: int) -> None:
        self.run_of(number)
        link = self.folder / VERSIONS / CURRENT
        link.parent.mkdir(exist_ok=True)
        with replacing(link) as temporary:
            temporary.unlink(missing_ok=True)
            temporary.symlink_to(os.pardir if number == FIRST else f"{number:04d}")


class _History(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    entries: tuple[HistoryEntry, ...]

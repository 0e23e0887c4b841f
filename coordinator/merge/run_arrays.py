"""Versioned npz files of runs: one way to write and to read them."""

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from module_agent.model.errors import DataError, UsageError
from module_agent.model.files import replacing

_Read = TypeVar("_Read")


class RunArraysError(UsageError):
    """A file of a run is missing, damaged or of another version; the message names it."""


def write_arrays(path: Path, version: int, arrays: Mapping[str, Any]) -> None:
    """Write arrays, whole or not at all."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, version=version, **arrays)


def read_arrays(
    path: Path, version: int, read: Callable[[dict[str, Any]], _Read], what: str, written_by: str
) -> _Read:
    """Return what `read` makes of the arrays of a file.

    Args:
        path, version: the file, and the version that is read here.
        read: may raise KeyError, ValueError or DataError where the arrays are not what they should be.
        what, written_by: the file's content and who writes it, for messages.

    Raises:
        RunArraysError: no such file, another version, or not what it should be.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            if int(file["version"]) != version:
                raise RunArraysError(
                    f"{path} is of version {file['version']}, {version} is read here: replay the run's "
                    "session.mcap, which writes it anew"
                )
            return read(dict(file))
    except OSError as error:
        raise RunArraysError(
            f"{path}: {error.strerror or error}; {written_by} writes it, and so does replaying one"
        ) from error
    except (KeyError, ValueError, DataError, zipfile.BadZipFile) as error:  # ValueError: numpy's parser
        raise RunArraysError(f"{path} is not {what}: {error}") from error

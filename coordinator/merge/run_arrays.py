"""The npz files of runs: one way to write those with versions, and to read all."""

import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Any, NamedTuple, TypeVar
from zipfile import BadZipFile, is_zipfile

import numpy as np

from module_agent.model.chain import Array
from module_agent.model.errors import DataError, UsageError
from module_agent.model.files import replacing

_Read = TypeVar("_Read")


class RunArraysError(UsageError):
    """A file of a run is missing, damaged or of another version; the message names it."""


# Of zipfile, zlib and numpy where bytes are damaged; a RuntimeError of an archive that seems to be encrypted,
# or of a version that there is not.
_DAMAGED = (KeyError, ValueError, EOFError, MemoryError, RuntimeError, BadZipFile, zlib.error, TokenError)


def write_arrays(path: Path, version: int, arrays: Mapping[str, Any]) -> None:
    """Write arrays, whole or not at all."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, version=version, **arrays)


def read_arrays(
    path: Path, version: int, read: Callable[[dict[str, Any]], _Read], what: str, written_by: str
) -> _Read:
    """Return what `read` makes of the arrays of a file with a version.

    Args:
        path, version: the file, and the version that is read here.
        read, what, written_by: see `read_unversioned`.

    Raises:
        RunArraysError: no such file, another version, or not what it should be.
    """

    def read_version(arrays: dict[str, Any]) -> _Read:
        if int(arrays["version"]) != version:
            raise RunArraysError(
                f"{path} is of version {arrays['version']}, {version} is read here: replay the run's "
                "session.mcap, which writes it anew"
            )
        return read(arrays)

    return read_unversioned(path, read_version, what, written_by)


def read_unversioned(
    path: Path, read: Callable[[dict[str, Any]], _Read], what: str, written_by: str
) -> _Read:
    """Return what `read` makes of the arrays of a file.

    Args:
        path: the file.
        read: may raise KeyError, ValueError or DataError where the arrays are not what they should be.
        what, written_by: the file's content and who writes it, for messages.

    Raises:
        RunArraysError: no such file, or not what it should be.
    """
    again = f"; {written_by} writes it, and so does replaying one"
    try:
        # Numpy reads other files too, and what is no archive by other errors.
        if path.is_file() and not is_zipfile(path):
            raise RunArraysError(f"{path} is not {what}: it is no npz file{again}")
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except OSError as error:
        raise RunArraysError(f"{path}: {error.strerror or error}{again}") from error
    except _DAMAGED as error:
        raise RunArraysError(f"{path} is not {what}: {error}{again}") from error
    try:
        return read(arrays)
    except KeyError as error:
        raise RunArraysError(f"{path} is not {what}: it has no {error}{again}") from error
    except (ValueError, DataError) as error:
        raise RunArraysError(f"{path} is not {what}: {error}{again}") from error


class HeldOutArrays(NamedTuple):
    """`held_out.npz`: instants (m,) [ns] of session time, positions and torques (m, n) in SI units."""

    serials: tuple[str, ...]
    session_ns: "np.ndarray[tuple[int], np.dtype[np.int64]]"
    q_rad: Array
    measured_nm: Array
    predicted_nm: Array


def read_held_out_arrays(path: Path) -> HeldOutArrays:
    """Read the torques of held-out motions.

    Raises:
        RunArraysError: no such file, or not what it should be.
    """

    def held_out(arrays: dict[str, Any]) -> HeldOutArrays:
        serials, session_ns = tuple(map(str, arrays["serials"])), arrays["session_ns"].astype(np.int64)
        shape = len(session_ns), len(serials)
        names = ("q_rad", "tau_measured_nm", "tau_predicted_nm")
        q_rad, measured_nm, predicted_nm = (arrays[name].astype(float) for name in names)
        if not len(session_ns) or any(one.shape != shape for one in (q_rad, measured_nm, predicted_nm)):
            raise DataError(f"its arrays do not have {shape[0]} instants of {shape[1]} modules")
        return HeldOutArrays(serials, session_ns, q_rad, measured_nm, predicted_nm)

    return read_unversioned(path, held_out, "the torques of held-out motions", "a run with dynamics")

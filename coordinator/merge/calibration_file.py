"""`imu_calibration.npz`: what one or more recordings tell of their modules' IMUs; versioned."""

import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coordinator.batch_estimation.imu_calibration import SIZE, CalibrationInformation
from module_agent.model.catalogue import ImuKind
from module_agent.model.errors import DataError, RobotError
from module_agent.model.files import replacing
from module_agent.model.read_only import frozen

VERSION = 1


class CalibrationFileError(RobotError):
    """What runs tell of IMUs is missing or damaged; the message names the file."""


def each_once(recordings: Iterable[CalibrationInformation]) -> tuple[CalibrationInformation, ...]:
    """Return recordings without those that occur again, by their trace hashes: their noise counts once."""
    return tuple({one.session: one for one in recordings}.values())


def write_calibration(path: Path, recordings: Sequence[CalibrationInformation]) -> None:
    """Write what recordings tell of IMUs, whole or not at all."""
    arrays: dict[str, Any] = {"version": VERSION, "sessions": np.array([one.session for one in recordings])}
    for k, one in enumerate(recordings):
        arrays[f"serials{k}"] = np.array(one.serials)
        arrays[f"matrix{k}"], arrays[f"vector{k}"], arrays[f"imu{k}"] = one.matrix, one.vector, one.imu
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_calibration(path: Path) -> tuple[CalibrationInformation, ...]:
    """Read what recordings tell of IMUs.

    Raises:
        CalibrationFileError: no such file, another version, or not what it should be.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            if int(file["version"]) != VERSION:
                raise CalibrationFileError(
                    f"{path} is of version {file['version']}, {VERSION} is read here: replay the run's "
                    "session.mcap, which writes it anew"
                )
            return tuple(_recording(dict(file), k) for k in range(len(file["sessions"])))
    except OSError as error:
        raise CalibrationFileError(
            f"{path}: {error.strerror or error}; every run writes it, and so does replaying one"
        ) from error
    except (KeyError, ValueError, DataError, zipfile.BadZipFile) as error:  # ValueError: numpy's parser
        raise CalibrationFileError(f"{path} is not what runs tell of IMUs: {error}") from error


def _recording(arrays: dict[str, Any], k: int) -> CalibrationInformation:
    serials, matrix, vector = (arrays[f"{name}{k}"] for name in ("serials", "matrix", "vector"))
    size = SIZE * len(serials)
    if matrix.shape != (size, size) or vector.shape != (size,):
        raise DataError(f"shapes {matrix.shape} and {vector.shape} do not fit {len(serials)} modules")
    if not (np.isfinite(matrix).all() and np.isfinite(vector).all()):
        raise DataError("a value is not finite")
    kind: ImuKind = "calibrated" if arrays[f"imu{k}"] == "calibrated" else "uncalibrated"
    session = str(arrays["sessions"][k])
    return CalibrationInformation(tuple(serials.tolist()), frozen(matrix), frozen(vector), session, kind)

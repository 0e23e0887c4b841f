"""`imu_calibration.npz`: what one or more recordings tell of their modules' IMUs; versioned."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coordinator.batch_estimation.imu_calibration import SIZE, CalibrationInformation
from coordinator.merge.run_arrays import read_arrays, write_arrays
from module_agent.model.catalogue import ImuKind
from module_agent.model.errors import DataError
from module_agent.model.read_only import frozen

VERSION = 1


def each_once(recordings: Iterable[CalibrationInformation]) -> tuple[CalibrationInformation, ...]:
    """Return recordings without those that occur again, by their trace hashes: their noise counts once.

    Suspicions of any copy are kept: one of an earlier version tells none, and the journal is in no hash.
    """
    once: dict[str, CalibrationInformation] = {}
    for one in recordings:
        earlier = once[one.session].suspicions if one.session in once else ()
        once[one.session] = one._replace(suspicions=tuple(dict.fromkeys((*earlier, *one.suspicions))))
    return tuple(once.values())


def write_calibration(path: Path, recordings: Sequence[CalibrationInformation]) -> None:
    """Write what recordings tell of IMUs, whole or not at all."""
    arrays: dict[str, Any] = {"sessions": np.array([one.session for one in recordings])}
    for k, one in enumerate(recordings):
        arrays[f"serials{k}"] = np.array(one.serials)
        arrays[f"matrix{k}"], arrays[f"vector{k}"], arrays[f"imu{k}"] = one.matrix, one.vector, one.imu
        arrays[f"suspicions{k}"] = np.array(one.suspicions, dtype=np.str_)
    write_arrays(path, VERSION, arrays)


def read_calibration(path: Path) -> tuple[CalibrationInformation, ...]:
    """Read what recordings tell of IMUs.

    Raises:
        RunArraysError: no such file, another version, or not what it should be.
    """

    def recordings(arrays: dict[str, Any]) -> tuple[CalibrationInformation, ...]:
        return tuple(_recording(arrays, k) for k in range(len(arrays["sessions"])))

    return read_arrays(path, VERSION, recordings, "what runs tell of IMUs", "every run")


def _recording(arrays: dict[str, Any], k: int) -> CalibrationInformation:
    serials, matrix, vector = (arrays[f"{name}{k}"] for name in ("serials", "matrix", "vector"))
    size = SIZE * len(serials)
    if matrix.shape != (size, size) or vector.shape != (size,):
        raise DataError(f"shapes {matrix.shape} and {vector.shape} do not fit {len(serials)} modules")
    if not (np.isfinite(matrix).all() and np.isfinite(vector).all()):
        raise DataError("a value is not finite")
    kind: ImuKind = "calibrated" if arrays[f"imu{k}"] == "calibrated" else "uncalibrated"
    session = str(arrays["sessions"][k])
    # Files of earlier versions have none.
    suspicions = tuple(np.asarray(arrays.get(f"suspicions{k}", ()), dtype=np.str_).tolist())
    return CalibrationInformation(
        tuple(serials.tolist()), frozen(matrix), frozen(vector), session, kind, suspicions
    )

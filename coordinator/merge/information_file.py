"""`information.npz`: the torque information of a run and the chain that it was computed with; versioned."""

import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError, RobotError
from module_agent.model.files import replacing
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only

VERSION = 2
_ARRAYS = ("sigma_nm", "independent_fraction", "phi_parts", "directions", "scale", "scale_sigma")


class RunInformation(NamedTuple):
    """The information in the torques of one run of a robot of n joints.

    name: of the run. session: the trace hash of its recording, which identifies the run. joints: (n,) in the
    columns of `torque_regressor`, without the further terms of the readings. sigma_nm: (n,) noise of the
    torques. independent_fraction: independent samples per sample.
    phi_parts: (20 n,) likely parts of the bodies (`module_parts.likely_parts`).
    directions: (6 n, j) perturbations of the chain, one standard deviation long; zero for errors of other
    kinds. effects: (k_i, j) of every joint: their effects on its rows in Nm, with the bodies fixed in the
    root frame (`systematic_errors`).
    scale: (n,) the torques are 1 + scale times the readings. scale_sigma: the prior's standard deviation; 0
    of calibrated sensors.
    """

    name: str
    session: str
    chain: Chain
    joints: tuple[JointInformation, ...]
    sigma_nm: Array
    independent_fraction: float
    phi_parts: Array
    directions: Array
    effects: tuple[Array, ...]
    scale: Array
    scale_sigma: float


class InformationFileError(RobotError):
    """The information of a run is missing or damaged; the message names the file."""


def write_information(path: Path, run: RunInformation) -> None:
    """Write the information of a run, whole or not at all."""
    arrays: dict[str, Any] = {
        "version": VERSION,
        "session": run.session,
        **{name: np.array(values) for name, values in run.chain.to_dict().items()},
        **{name: getattr(run, name) for name in _ARRAYS},
        "rest_nm2": np.array([joint.rest for joint in run.joints]),
        "samples": np.array([joint.samples for joint in run.joints], dtype=np.int64),
    }
    for k, joint in enumerate(run.joints):
        arrays[f"r{k}"], arrays[f"z{k}"], arrays[f"effects{k}"] = joint.r, joint.z, run.effects[k]
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_information(path: Path) -> RunInformation:
    """Read the information of a run; its name is that of the folder.

    Raises:
        InformationFileError: no such file, another version, or not what it should be.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            if int(file["version"]) != VERSION:
                raise InformationFileError(
                    f"{path} is of version {file['version']}, {VERSION} is read here: replay the run's "
                    f"session.mcap, which writes it anew"
                )
            return _run(path.parent.name, dict(file))
    except OSError as error:
        raise InformationFileError(
            f"{path}: {error.strerror or error}; a run with dynamics writes it, and so does replaying one"
        ) from error
    except (KeyError, ValueError, DataError, zipfile.BadZipFile) as error:  # ValueError: numpy's parser
        raise InformationFileError(f"{path} is not the information of a run: {error}") from error


def _run(name: str, arrays: dict[str, Any]) -> RunInformation:
    make_read_only(arrays.values())

    def finite(key: str, *shape: int) -> Array:
        array = arrays[key]
        if array.shape != shape or not np.isfinite(array).all():
            raise DataError(f"an array of shape {array.shape}, finite {shape} is needed")
        return np.asarray(array, dtype=float)

    joints, count = len(arrays["serials"]), arrays["directions"].shape[-1]
    rest, rows = finite("rest_nm2", joints), [len(arrays[f"z{k}"]) for k in range(joints)]
    return RunInformation(
        name=name,
        session=str(arrays["session"]),
        chain=Chain.from_dict(arrays),
        joints=tuple(
            JointInformation(
                finite(f"r{k}", size, 10 * joints),
                finite(f"z{k}", size),
                float(rest[k]),
                int(arrays["samples"][k]),
            )
            for k, size in enumerate(rows)
        ),
        sigma_nm=finite("sigma_nm", joints),
        independent_fraction=float(arrays["independent_fraction"]),
        phi_parts=finite("phi_parts", 20 * joints),
        directions=finite("directions", 6 * joints, count),
        effects=tuple(finite(f"effects{k}", size, count) for k, size in enumerate(rows)),
        scale=finite("scale", joints),
        scale_sigma=float(finite("scale_sigma")),
    )

"""`information.npz`: the torque information of a run and the chain that it was computed with; versioned."""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from coordinator.merge.run_arrays import read_arrays, write_arrays
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
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


def write_information(path: Path, run: RunInformation) -> None:
    """Write the information of a run, whole or not at all."""
    arrays: dict[str, Any] = {
        "session": run.session,
        **{name: np.array(values) for name, values in run.chain.to_dict().items()},
        **{name: getattr(run, name) for name in _ARRAYS},
        "rest_nm2": np.array([joint.rest for joint in run.joints]),
        "samples": np.array([joint.samples for joint in run.joints], dtype=np.int64),
    }
    for k, joint in enumerate(run.joints):
        arrays[f"r{k}"], arrays[f"z{k}"], arrays[f"effects{k}"] = joint.r, joint.z, run.effects[k]
    write_arrays(path, VERSION, arrays)


def read_information(path: Path) -> RunInformation:
    """Read the information of a run; its name is that of the folder.

    Raises:
        RunArraysError: no such file, another version, or not what it should be.
    """
    run = partial(_run, path.parent.name)
    return read_arrays(
        path, VERSION, run, "the information of a run", "a run with dynamics that does not end with code 5"
    )


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

"""Torques of a recording as measured and as predicted, and their file."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.arm_fit.cross_validation import fitted, halves
from coordinator.arm_fit.problem import Problem
from coordinator.parameter_fit.base_parameters import BaseParameters
from module_agent.model.chain import Array
from module_agent.model.files import replacing
from module_agent.model.read_only import make_read_only


class Predictions(NamedTuple):
    """Torques (m, n) of the kept samples [Nm], read-only.

    t_s: (m,) in the time of the file. piece: (m,) number of the piece between holes or recordings.
    tau_raw_nm, tau_nm: as recorded, and low-passed. fitted_nm: by the fit to the whole recording.
    held_out_nm: by the fit to the other half; NaN in the gap between the halves.
    """

    joints: tuple[str, ...]
    t_s: Array
    piece: NDArray[np.int64]
    tau_raw_nm: Array
    tau_nm: Array
    fitted_nm: Array
    held_out_nm: Array


def predictions(problem: Problem, parameters: Array) -> Predictions:
    """Return the torques by a fit to the whole recording (p,) and by fits to each half.

    Raises:
        DataError: too few samples for the halves.
    """
    log, held_out = problem.log, np.full_like(problem.log.tau_nm, np.nan)
    first, second = halves(len(log.tau_nm), log.settling)
    held_out[second], held_out[first] = fitted(problem)(first, second), fitted(problem)(second, first)
    result = Predictions(
        joints=problem.robot.chain.serials,
        t_s=log.t_s,
        piece=log.piece,
        tau_raw_nm=log.tau_raw_nm,
        tau_nm=log.tau_nm,
        fitted_nm=problem.predicted(parameters, slice(0, len(log.tau_nm))),
        held_out_nm=held_out,
    )
    make_read_only(result)
    return result


def write_predictions(path: Path, torques: Predictions) -> None:
    """Write CSV: `t_s`, `piece`, and per joint measured, filtered, fitted and held-out torque [Nm].

    Raises:
        OSError: the file cannot be written.
    """
    kinds = ("nm", "filtered_nm", "fitted_nm", "held_out_nm")
    header = ["t_s", "piece", *(f"tau_{joint}_{kind}" for joint in torques.joints for kind in kinds)]
    columns = np.stack(torques[3:], axis=2).reshape(len(torques.t_s), -1)
    with replacing(path) as temporary:
        table = np.column_stack([torques.t_s, torques.piece, columns])
        np.savetxt(temporary, table, fmt="%.9g", delimiter=",", header=",".join(header), comments="")


def write_matrices(path: Path, base: BaseParameters) -> None:
    """Write npz: `value` (r,), `covariance` (r, r), `grouping` (r, p), `summary` (r,), `parameters` (p,).

    The r base parameters are `grouping` times the p parameters: of the bodies in the frames of their links,
    then of the drives.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            value=base.value,
            covariance=base.covariance,
            grouping=base.grouping,
            summary=np.array([base.summary(i) for i in range(base.rank)]),
            parameters=np.array(base.columns.names),
        )

"""Torques of a recording as measured and as predicted: as a file, and as plots."""

from collections.abc import Sequence
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

# Width and heights of a plot [px]; so many samples are drawn.
_WIDTH, _HEIGHT, _RESIDUAL_HEIGHT, _DRAWN = 1000.0, 220.0, 80.0, 2000
# Room for the legend above a plot and for the times below it, and how many of these are written.
_LEGEND, _TIMES = 24.0, 6


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


def svg_plot(torques: Predictions, joint: int) -> str:
    """Return a drawing of a joint's torque, measured and held-out prediction, with the residual below."""
    step = max(1, len(torques.t_s) // _DRAWN)
    measured, predicted = (signal[::step, joint] for signal in (torques.tau_nm, torques.held_out_nm))
    residual = measured - predicted
    top = float(np.nanmax(np.abs([measured, predicted]))) or 1.0
    middle, below = _LEGEND + 0.5 * _HEIGHT, _LEGEND + _HEIGHT + 0.5 * _RESIDUAL_HEIGHT
    scale = 0.5 * _HEIGHT / top
    lines = [
        (measured, middle, "black", "measured"),
        (predicted, middle, "#d62728", "predicted"),
        (residual, below, "#1f77b4", "residual"),
    ]
    drawn = [
        f'<polyline fill="none" stroke="{colour}" points="{points}"/>'
        for signal, zero, colour, _ in lines
        for points in _polylines(zero - scale * np.clip(signal, -top, top))
    ]
    legend = [
        f'<text x="{10 + 110 * k}" y="14" fill="{colour}">{name}</text>'
        for k, (*_, colour, name) in enumerate(lines)
    ]
    bottom = _LEGEND + _HEIGHT + _RESIDUAL_HEIGHT
    shares = np.linspace(0.0, 1.0, _TIMES)
    times = [
        f'<text x="{share * _WIDTH:.0f}" y="{bottom + 12:.0f}" text-anchor="{anchor}" fill="#666">'
        f"{torques.t_s[round(share * (len(torques.t_s) - 1))]:.1f} s</text>"
        for share, anchor in zip(shares, ["start", *["middle"] * (_TIMES - 2), "end"], strict=True)
    ]
    return (
        f'<svg viewBox="0 0 {_WIDTH:.0f} {bottom + _LEGEND:.0f}" font-size="12">'
        f'<text x="350" y="14">{torques.joints[joint]}: -{top:.3g} to {top:.3g} Nm</text>'
        f'<path stroke="#bbb" d="M0 {middle}H{_WIDTH}M0 {below}H{_WIDTH}"/>'
        f"{''.join([*legend, *times, *drawn])}</svg>"
    )


def _polylines(heights: Array) -> Sequence[str]:
    """Return the points of a curve in parts between samples that are not numbers."""
    x = np.linspace(0.0, _WIDTH, len(heights))
    parts = np.split(np.arange(len(heights)), np.flatnonzero(np.diff(np.isnan(heights))) + 1)
    return [
        " ".join(f"{x[i]:.1f},{heights[i]:.1f}" for i in part)
        for part in parts
        if not np.isnan(heights[part[0]])
    ]

"""The low-pass of a recording, chosen by the error with which each half predicts the other's raw torques.

A low cut-off takes torque away that the model could explain, a high one lets the noise of differentiated
positions into the regressor. Both are in the raw error: raw^2 = noise^2 + filtered^2, because what the
low-pass takes away and the residual of what it leaves are in different bands.
"""

from typing import NamedTuple

import numpy as np

from coordinator.arm_fit.cross_validation import fit_part, halves
from coordinator.arm_fit.data_file import JointLog
from coordinator.arm_fit.filtered_log import filtered_log
from coordinator.arm_fit.problem import ModelChoice, Problem, problem
from coordinator.description.urdf_reader import UrdfRobot
from module_agent.model.errors import DataError, UsageError

# The lowest cut-off loses a tenth of the longest piece at both ends together; above the highest the spline
# that differentiates is more than 2 % short.
_LOWEST_PERIODS, _HIGHEST_OF_RATE = 40.0, 0.2
_STEP = np.sqrt(2.0)
# The ladder ends where the error is so many times the least: noise grows with the cube of the cut-off.
_BEYOND = 1.3
# Of the residual's power, for a cut-off below that of the least error.
_SPARED = 0.2
# Samples for a fit of the ladder.
_MAX_COUNT = 2000


class CutoffPoint(NamedTuple):
    """Relative errors of torques that were held out, both ways together, behind a low-pass."""

    cutoff_hz: float
    filtered: float
    raw: float


def cutoff_curve(robot: UrdfRobot, log: JointLog, choice: ModelChoice) -> tuple[CutoffPoint, ...]:
    """Return the held-out errors over a ladder of cut-offs, all on the same part of the recording.

    Raises:
        UsageError: a recording too short for any of them.
    """
    longest_s = max(piece.duration_s for piece in log.pieces())
    lowest = _LOWEST_PERIODS / longest_s
    count = int(np.log(_HIGHEST_OF_RATE * log.rate_hz / lowest) / np.log(_STEP)) + 1
    points: list[CutoffPoint] = []
    for cutoff_hz in lowest * _STEP ** np.arange(max(0, count)):
        try:
            filtered = filtered_log(log, float(cutoff_hz), _MAX_COUNT, settled_hz=lowest)
            points.append(_point(problem(robot, filtered, choice)))
        except DataError:
            # So few samples are left of a low cut-off that they do not determine the parameters.
            continue
        if points[-1].raw > _BEYOND * min(point.raw for point in points):
            break
    if not points:
        raise UsageError(
            f"the recording is too short: {longest_s:.2f} s at {log.rate_hz:.4g} Hz in one piece do not "
            "determine the parameters from a half; record at least ten periods of the slowest motion"
        )
    return tuple(points)


def chosen_cutoff_hz(curve: tuple[CutoffPoint, ...]) -> float:
    """Return the lowest cut-off that does about as well as the one of the least raw error.

    Near the least the curve is flat. A lower cut-off lets less noise through, and may cost a fifth of the
    residual's power.
    """
    best = min(curve, key=lambda point: point.raw)
    allowed = best.raw**2 + _SPARED * best.filtered**2
    return next(point.cutoff_hz for point in curve if point.raw**2 <= allowed)


def _point(some: Problem) -> CutoffPoint:
    log, (first, second) = some.log, halves(len(some.log.tau_nm), some.log.settling)
    fits = fit_part(some, first), fit_part(some, second)
    off = [
        log.tau_nm[tried] - some.predicted(fit.parameters, tried)
        for fit, tried in zip(fits, (second, first), strict=True)
    ]
    size = np.linalg.norm(np.concatenate([log.tau_nm[first], log.tau_nm[second]]))
    filtered = float(np.linalg.norm(np.concatenate(off)) / size)
    # The filtered torques have 1 - noise^2 of the power of the raw ones.
    raw = float(np.hypot(log.noise, filtered * np.sqrt(1.0 - log.noise**2)))
    return CutoffPoint(log.cutoff_hz, filtered, raw)

"""Lengths of an arm's trials by three methods, and the statistic that the thesis prints of repeated ones.

Lengths of the thesis' method are given with equation 16 as printed, and with gravity turned the other way,
which is right.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.report.document import Curve
from sim.thesis.experiment import Scope, Unit
from sim.thesis.kinematics.amplitude_sweep import AmplitudeTrial, repeat_series, run_series, sweep_series
from sim.thesis.published import AMPLITUDES_RAD, TRIALS, Alignment

Trials = list[AmplitudeTrial]
# What a trial takes on one core.
TRIAL_S = 1.1
_QUICK_AMPLITUDES_RAD, _QUICK_TRIALS = (0.04, 0.1, 0.2, 0.28), 3
# Chapter 6.2.4: single trials of the thesis vary by a few millimetres.
FEW_MM = 5.0


def sweep(alignment: Alignment, length_mm: int, scope: Scope) -> Unit:
    """Return the sweep over amplitudes on one arm."""
    amplitudes_rad = _QUICK_AMPLITUDES_RAD if scope.quick else AMPLITUDES_RAD
    series = sweep_series([length_mm], amplitudes_rad, 1, scope.seed, scope.noise)
    (own,) = (each for each in series if each.alignment == alignment)
    name = f"{length_mm} mm {alignment}: sweep over {len(amplitudes_rad)} amplitudes"
    return Unit(name, run_series, (own,), Trials, TRIAL_S * len(amplitudes_rad))


def repeats(alignment: Alignment, length_mm: int, scope: Scope) -> Unit:
    """Return the repeated trials on one arm, at the thesis' amplitude for it."""
    trials = _QUICK_TRIALS if scope.quick else TRIALS
    series = repeat_series([length_mm], trials, scope.seed, scope.noise)
    (own,) = (each for each in series if each.alignment == alignment)
    return Unit(f"{length_mm} mm {alignment}: {trials} trials", run_series, (own,), Trials, TRIAL_S * trials)


class Method(NamedTuple):
    """An estimate of every trial, in millimetres; None where there is none."""

    name: str
    of: Callable[[AmplitudeTrial], float | None]


PRINTED = Method("thesis, eq. 16 as printed", lambda trial: trial.printed_mm)
RIGHT = Method("thesis, gravity by -φ", lambda trial: trial.estimated_mm)
OURS = Method("ours", lambda trial: trial.ours_mm)
METHODS = (PRINTED, RIGHT, OURS)


def curve(method: Method, x: Sequence[float], trials: Trials) -> Curve:
    """Return a method's lengths over x, of the trials in which it has one."""
    known = [
        (at, value) for at, trial in zip(x, trials, strict=True) if (value := method.of(trial)) is not None
    ]
    return Curve(label=method.name, x=tuple(at for at, _ in known), y=tuple(value for _, value in known))


class Mean(NamedTuple):
    """The mean of repeated trials by one method, its error, and the scatter of one trial [mm]."""

    mean_mm: float
    error_mm: float
    scatter_mm: float


def mean_of(trials: Trials, method: Method) -> Mean | None:
    """Return the mean of repeated trials by a method; None if it has no estimate."""
    values = np.array([value for trial in trials if (value := method.of(trial)) is not None])
    if not values.size:
        return None
    mean = float(values.mean())
    return Mean(mean, mean - trials[0].true_mm, float(values.std(ddof=min(1, values.size - 1))))

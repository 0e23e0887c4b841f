"""Figures 23 to 26 and 29 to 32 of the thesis: estimated length over the amplitude of the windowed sine."""

from functools import partial

import numpy as np

from coordinator.report.document import Curve, Panel, Plot, Table
from sim.thesis.experiment import Check, Column, Experiment, Findings, Scope, Unit
from sim.thesis.kinematics.amplitude_sweep import AmplitudeTrial
from sim.thesis.kinematics.length_estimates import METHODS, PRINTED, Method, Trials, curve, sweep
from sim.thesis.published import ALIGNMENTS, LENGTHS_MM, Alignment, thesis_length


def _best(trials: Trials) -> AmplitudeTrial | None:
    """Return the trial whose length, by the thesis' method as printed, comes nearest to the truth."""
    known = [trial for trial in trials if trial.printed_mm is not None]
    return min(known, key=lambda trial: abs((trial.printed_mm or 0.0) - trial.true_mm), default=None)


def _errors_mm(trials: Trials, method: Method = PRINTED) -> list[float]:
    return [value - trial.true_mm for trial in trials if (value := method.of(trial)) is not None]


def _sweep_checks(alignment: Alignment, length_mm: int, own: Trials, compared: Trials) -> list[Check]:
    """Return what the thesis says of a sweep, checked; `compared` is the sweep its text compares it with."""
    best, other = _best(own), _best(compared)
    if best is None or other is None:
        return [Check("no amplitude gives an estimate", False)]
    printed = thesis_length(alignment, length_mm).amplitude_rad
    nearest = f"the nearest to the truth is at {best.amplitude_rad:g} rad"
    if alignment == "vertical":
        checks = [_smaller_is_nearer(own)]
        if length_mm == max(LENGTHS_MM):
            checks = [Check(f"{nearest}, printed {printed:g} rad", abs(best.amplitude_rad - printed) <= 0.04)]
        else:
            statement = f"{nearest}, for the horizontal arm at {other.amplitude_rad:g} rad: smaller"
            checks.append(Check(statement, best.amplitude_rad < other.amplitude_rad))
        return checks
    saturated = [trial for trial in own if trial.saturated]
    mean = float(np.mean(_errors_mm(saturated))) if saturated else 0.0
    checks = [Check(f"beyond the velocity's limit lengths are {mean:+.1f} mm wrong: too long", mean > 0.0)]
    if length_mm == max(LENGTHS_MM):
        checks.append(
            Check(f"{nearest}, printed {printed:g} and 0.1 rad", abs(best.amplitude_rad - 0.1) <= 0.02)
        )
    elif length_mm == min(LENGTHS_MM):
        small = _errors_mm([trial for trial in own if trial.amplitude_rad <= 0.04])
        mean = float(np.mean(small)) if small else 0.0
        checks.append(Check(f"at 0.04 rad and below lengths are {mean:+.1f} mm wrong: too long", mean > 0.0))
    else:
        statement = f"{nearest}, for 484 mm at {other.amplitude_rad:g} rad: the shorter, the larger"
        checks.append(Check(statement, best.amplitude_rad >= other.amplitude_rad))
    return checks


def _smaller_is_nearer(own: Trials) -> Check:
    middle = float(np.median([trial.amplitude_rad for trial in own]))
    below = np.abs(_errors_mm([trial for trial in own if trial.amplitude_rad <= middle]))
    above = np.abs(_errors_mm([trial for trial in own if trial.amplitude_rad > middle]))
    near, far = (float(errors.mean()) if errors.size else np.inf for errors in (below, above))
    statement = (
        f"errors are {near:.1f} mm up to {middle:.2g} rad and {far:.1f} mm beyond: smaller ones are nearer"
    )
    return Check(statement, near < far)


def _examine(alignment: Alignment, length_mm: int, measured: list[Trials]) -> Findings:
    own, compared = measured[0], measured[-1]
    published = thesis_length(alignment, length_mm)
    true_mm = own[0].true_mm
    table = Table(
        caption="Estimated length over the amplitude.",
        columns=(
            Column(name="amplitude", unit="rad", form=".2f"),
            *(Column(name=method.name, unit="mm") for method in METHODS),
            Column(name="ours, one sigma", unit="mm", form=".2f"),
            Column(name="speed commanded", unit="rad/s", form=".2f"),
            Column(name="cut off"),
        ),
        rows=tuple(
            (
                trial.amplitude_rad,
                *(method.of(trial) for method in METHODS),
                trial.ours_sigma_mm,
                trial.commanded_rad_s,
                "yes" if trial.saturated else "no",
            )
            for trial in own
        ),
    )
    span = (own[0].amplitude_rad, own[-1].amplitude_rad)
    curves = [curve(method, [trial.amplitude_rad for trial in own], own) for method in METHODS]
    curves.append(Curve(label="truth", x=span, y=(true_mm, true_mm), style="level"))
    curves.append(
        Curve(
            label="thesis, mean of 13 trials at its amplitude",
            x=(published.amplitude_rad,),
            y=(published.mean_mm,),
            style="points",
        )
    )
    panel = Panel(y_label="length [mm]", curves=tuple(curves))
    plot = Plot(
        caption=f"{length_mm} mm, {alignment}: estimated length over the amplitude.",
        x_label="amplitude [rad]",
        panels=(panel,),
    )
    reading = ["The thesis prints these estimates as a curve only; its mean of table 4 or 5 is the mark."]
    if (alignment, length_mm) == ("horizontal", 484):
        reading.append(
            "The text calls amplitudes 0.9 and 0.1 the best of a grid of 0.02 rad up to 0.28 rad: 0.9 is "
            "read as 0.09 of table 4, which the grid does not have."
        )
    return Findings(_sweep_checks(alignment, length_mm, own, compared), (table,), (plot,), tuple(reading))


def _sweep_units(alignment: Alignment, length_mm: int, scope: Scope) -> tuple[Unit, ...]:
    other: tuple[Alignment, int] = ("horizontal", length_mm if alignment == "vertical" else max(LENGTHS_MM))
    return tuple(sweep(*arm, scope) for arm in dict.fromkeys(((alignment, length_mm), other)))


_SWEEP_FINDINGS: dict[tuple[Alignment, int], str] = {
    (
        "horizontal",
        484,
    ): "The thesis found the best accuracy at 0.09 and 0.1 rad, and lengths too long beyond.",
    ("horizontal", 350): "The thesis found that a shorter link needs a larger amplitude (0.11 rad).",
    ("horizontal", 245): "The thesis found that a shorter link needs a larger amplitude (0.2 rad).",
    ("horizontal", 171): "The thesis found lengths too long at very small amplitudes too.",
    ("vertical", 484): "The thesis found the pattern it expected, best at 0.12 rad.",
    ("vertical", 350): "The thesis found smaller amplitudes nearer to the length, best at 0.08 rad.",
    ("vertical", 245): "The thesis found smaller amplitudes nearer to the length, best at 0.03 rad.",
    ("vertical", 171): "The thesis found smaller amplitudes nearer to the length, best at 0.04 rad.",
}


SWEEP_EXPERIMENTS: tuple[Experiment, ...] = tuple(
    Experiment(
        f"figure{first + k}",
        f"Figure {first + k}: amplitudes, {length} mm {alignment}",
        _SWEEP_FINDINGS[alignment, length],
        partial(_sweep_units, alignment, length),
        partial(_examine, alignment, length),
    )
    for alignment, first in zip(ALIGNMENTS, (23, 29), strict=True)
    for k, length in enumerate(LENGTHS_MM)
)

"""Figures 23 to 26 and 29 to 32 (sweeps), 36 to 43 and tables 4 and 5 (repeated trials), and equation 16.

The statistic on both sides is that of tables 4 and 5: the error of the mean of all trials. Lengths of the
thesis' method are given with equation 16 as printed, and with gravity turned the other way, which is right.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from coordinator.report.document import Cell, Table
from sim.thesis.experiment import (
    Check,
    Column,
    Curve,
    Experiment,
    Findings,
    Panel,
    Plot,
    Scope,
    Unit,
)
from sim.thesis.kinematics.amplitude_sweep import AmplitudeTrial, repeat_series, run_series, sweep_series
from sim.thesis.published import (
    ALIGNMENTS,
    AMPLITUDES_RAD,
    LENGTHS_MM,
    TRIALS,
    Alignment,
    thesis_length,
)

Trials = list[AmplitudeTrial]
_TRIAL_S = 1.1
_QUICK_AMPLITUDES_RAD, _QUICK_TRIALS = (0.04, 0.1, 0.2, 0.28), 3
# Chapter 6.2.4: single trials of the thesis vary by a few millimetres.
_FEW_MM = 5.0


def _sweep(alignment: Alignment, length_mm: int, scope: Scope) -> Unit:
    amplitudes_rad = _QUICK_AMPLITUDES_RAD if scope.quick else AMPLITUDES_RAD
    series = sweep_series([length_mm], amplitudes_rad, 1, scope.seed, scope.noise)
    (own,) = (each for each in series if each.alignment == alignment)
    name = f"{length_mm} mm {alignment}: sweep over {len(amplitudes_rad)} amplitudes"
    return Unit(name, run_series, (own,), Trials, _TRIAL_S * len(amplitudes_rad))


def _repeats(alignment: Alignment, length_mm: int, scope: Scope) -> Unit:
    trials = _QUICK_TRIALS if scope.quick else TRIALS
    series = repeat_series([length_mm], trials, scope.seed, scope.noise)
    (own,) = (each for each in series if each.alignment == alignment)
    return Unit(f"{length_mm} mm {alignment}: {trials} trials", run_series, (own,), Trials, _TRIAL_S * trials)


class _Method(NamedTuple):
    """An estimate of every trial, in millimetres; None where there is none."""

    name: str
    of: Callable[[AmplitudeTrial], float | None]


_PRINTED = _Method("thesis, eq. 16 as printed", lambda trial: trial.printed_mm)
_RIGHT = _Method("thesis, gravity by -φ", lambda trial: trial.estimated_mm)
_OURS = _Method("ours", lambda trial: trial.ours_mm)
_METHODS = (_PRINTED, _RIGHT, _OURS)


# ---------------------------------------------------------------------- sweeps over amplitudes


def _best(trials: Trials) -> AmplitudeTrial | None:
    """Return the trial whose length, by the thesis' method as printed, comes nearest to the truth."""
    known = [trial for trial in trials if trial.printed_mm is not None]
    return min(known, key=lambda trial: abs((trial.printed_mm or 0.0) - trial.true_mm), default=None)


def _errors_mm(trials: Trials, method: _Method = _PRINTED) -> list[float]:
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


def _examine_sweep(alignment: Alignment, length_mm: int, measured: list[Trials]) -> Findings:
    own, compared = measured[0], measured[-1]
    published = thesis_length(alignment, length_mm)
    true_mm = own[0].true_mm
    table = Table(
        caption="Estimated length over the amplitude.",
        columns=(
            Column(name="amplitude", unit="rad", form=".2f"),
            *(Column(name=method.name, unit="mm") for method in _METHODS),
            Column(name="ours, one sigma", unit="mm", form=".2f"),
            Column(name="speed commanded", unit="rad/s", form=".2f"),
            Column(name="cut off"),
        ),
        rows=tuple(
            (
                trial.amplitude_rad,
                *(method.of(trial) for method in _METHODS),
                trial.ours_sigma_mm,
                trial.commanded_rad_s,
                "yes" if trial.saturated else "no",
            )
            for trial in own
        ),
    )
    span = (own[0].amplitude_rad, own[-1].amplitude_rad)
    curves = [_curve(method, [trial.amplitude_rad for trial in own], own) for method in _METHODS]
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


def _curve(method: _Method, x: Sequence[float], trials: Trials) -> Curve:
    known = [
        (at, value) for at, trial in zip(x, trials, strict=True) if (value := method.of(trial)) is not None
    ]
    return Curve(label=method.name, x=tuple(at for at, _ in known), y=tuple(value for _, value in known))


def _sweep_units(alignment: Alignment, length_mm: int, scope: Scope) -> tuple[Unit, ...]:
    other: tuple[Alignment, int] = ("horizontal", length_mm if alignment == "vertical" else max(LENGTHS_MM))
    return tuple(_sweep(*arm, scope) for arm in dict.fromkeys(((alignment, length_mm), other)))


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


# ---------------------------------------------------------------------- thirteen trials


class _Mean(NamedTuple):
    """The mean of repeated trials by one method, its error, and the scatter of one trial [mm]."""

    mean_mm: float
    error_mm: float
    scatter_mm: float


def _mean(trials: Trials, method: _Method) -> _Mean | None:
    values = np.array([value for trial in trials if (value := method.of(trial)) is not None])
    if not values.size:
        return None
    mean = float(values.mean())
    return _Mean(mean, mean - trials[0].true_mm, float(values.std(ddof=min(1, values.size - 1))))


def _length_checks(alignment: Alignment, length_mm: int, trials: Trials) -> list[Check]:
    own = _mean(trials, _PRINTED)
    if own is None:
        return [Check(f"{length_mm} mm: no trial gives an estimate", False)]
    printed = thesis_length(alignment, length_mm).mean_mm - length_mm
    near = abs(own.error_mm - printed)
    both = f"{length_mm} mm: the mean is {own.error_mm:+.1f} mm wrong, printed {printed:+.1f} mm"
    percent = 100.0 * own.error_mm / trials[0].true_mm
    as_stated = Check(f"{length_mm} mm: that is {percent:+.1f} %: under 5 %", abs(percent) < 5.0)
    if alignment == "vertical":
        way = "long" if printed > 0.0 else "short"
        as_stated = Check(f"{length_mm} mm: too {way}, as printed", own.error_mm * printed > 0.0)
    return [
        as_stated,
        Check(f"{both}: alike within 5 mm", near <= _FEW_MM),
        Check(
            f"{length_mm} mm: one trial scatters by {own.scatter_mm:.1f} mm: a few", own.scatter_mm <= _FEW_MM
        ),
    ]


_STATISTIC = (
    "The error is that of the mean, as in the printed tables (484 - 479.6 = 4.4 mm); the scatter is one "
    "standard deviation of a single trial.",
)


def _trial_figure(alignment: Alignment, length_mm: int, measured: list[Trials]) -> Findings:
    (trials,) = measured
    published = thesis_length(alignment, length_mm)
    x = [float(trial.trial + 1) for trial in trials]
    ends = (x[0], max(x[-1], x[0] + 1.0))
    curves = [_curve(method, x, trials).model_copy(update={"style": "points"}) for method in _METHODS]
    curves.append(Curve(label="truth", x=ends, y=(trials[0].true_mm,) * 2, style="level"))
    curves.append(Curve(label="thesis, its mean", x=ends, y=(published.mean_mm,) * 2, style="level"))
    plot = Plot(
        caption=f"{length_mm} mm, {alignment}: {len(trials)} trials at {published.amplitude_rad:g} rad.",
        x_label="trial",
        panels=(Panel(y_label="length [mm]", curves=tuple(curves)),),
    )
    reading = list(_STATISTIC)
    if alignment == "horizontal":
        reading.append(
            "The text calls figures 36 to 39 vertical, captions and table 4 horizontal: horizontal is taken."
        )
    table = _length_table(alignment, {length_mm: trials})
    return Findings(_length_checks(alignment, length_mm, trials), (table,), (plot,), tuple(reading))


def _length_table(alignment: Alignment, trials: dict[int, Trials]) -> Table:
    columns = [
        Column(name="link", unit="mm", form="d"),
        Column(name="amplitude", unit="rad", form=".2f"),
        Column(name="truth", unit="mm"),
        Column(name="printed mean", unit="mm"),
        Column(name="printed error", unit="mm", form="+.1f"),
        Column(name="printed error", unit="%", form="+.2f"),
    ]
    for method in _METHODS:
        columns += [
            Column(name=f"{method.name}: mean", unit="mm"),
            Column(name="error", unit="mm", form="+.2f"),
            Column(name="error", unit="%", form="+.2f"),
            Column(name="scatter", unit="mm", form=".2f"),
        ]
    rows = []
    for length_mm, own in trials.items():
        published = thesis_length(alignment, length_mm)
        printed_error = published.mean_mm - length_mm
        row: list[Cell] = [
            length_mm,
            published.amplitude_rad,
            own[0].true_mm,
            published.mean_mm,
            printed_error,
        ]
        row.append(100 * printed_error / length_mm)
        for method in _METHODS:
            mean = _mean(own, method)
            row += [None] * 4 if mean is None else _mean_cells(mean, own[0].true_mm)
        rows.append(tuple(row))
    return Table(
        caption=f"Mean of {len(next(iter(trials.values())))} trials, {alignment}.",
        columns=tuple(columns),
        rows=tuple(rows),
    )


def _mean_cells(mean: _Mean, true_mm: float) -> list[Cell]:
    return [mean.mean_mm, mean.error_mm, 100 * mean.error_mm / true_mm, mean.scatter_mm]


def _length_summary(alignment: Alignment, measured: list[Trials]) -> Findings:
    trials = dict(zip(LENGTHS_MM, measured, strict=True))
    checks = [
        check for length_mm, own in trials.items() for check in _length_checks(alignment, length_mm, own)
    ]
    reading = list(_STATISTIC)
    if alignment == "vertical":
        reading.append("350 mm: the printed mean is 10 mm off, the printed error 10.6 mm; the mean is taken.")
    return Findings(
        checks, (_length_table(alignment, trials),), (_error_plot(alignment, trials),), tuple(reading)
    )


def _error_plot(alignment: Alignment, trials: dict[int, Trials]) -> Plot:
    printed = tuple(thesis_length(alignment, length_mm).mean_mm - length_mm for length_mm in trials)
    x = tuple(float(length_mm) for length_mm in trials)
    curves = [Curve(label="printed", x=x, y=printed, style="points")]
    for method in _METHODS:
        known = [
            (at, mean.error_mm) for at, own in trials.items() if (mean := _mean(own, method)) is not None
        ]
        places, errors = tuple(float(at) for at, _ in known), tuple(error for _, error in known)
        curves.append(Curve(label=method.name, x=places, y=errors, style="points"))
    curves.append(Curve(label="truth", x=(min(x), max(x)), y=(0.0, 0.0), style="level"))
    return Plot(
        caption=f"Error of the mean over the length, {alignment}.",
        x_label="length [mm]",
        panels=(Panel(y_label="error of the mean [mm]", curves=tuple(curves)),),
    )


# ---------------------------------------------------------------------- equation 16

# What the algebra may miss of the 15 to 45 mm that the sign adds.
_ALGEBRA_MM = 3.0
_EQUATION_16 = (
    "Algebra: with gravity turned by +φ in place of -φ, eq. 17 leaves α d n - 2 sin φ (j × g). For small "
    "angles and φ = -α / ω² that is α (d n + (2 / ω²) j × g), and the first singular vector has the length "
    "of the bracket: d' = sqrt(d² + (2 g / ω²)²).",
    "It holds where gravity is along the tangent in the middle of the motion, as for an arm stretched out "
    "about a horizontal axis, and the motion is a small sine. About a vertical axis d' = d; where the arm "
    "hangs or stands upright gravity is along the radius, and d' = d ± 2 g / ω². The column by algebra "
    "takes ω from the recorded motion, and gravity as the IMU measured it before.",
    "Shown, by the table: what the sign alone does to vertical arms, as both columns of the thesis' method "
    "are of the same recordings and differ in nothing else.",
    "Inferred: that the thesis' program turned gravity as its eq. 16 is printed, with angle and axis of the "
    "same sign. Neither program nor recordings are published; an axis or an angle of the other sign would "
    "make it right, and the thesis' vertical arms shook more, too.",
)


def _both_alignments(scope: Scope) -> tuple[Unit, ...]:
    return tuple(_repeats(alignment, length, scope) for length in LENGTHS_MM for alignment in ALIGNMENTS)


class _Difference(NamedTuple):
    """How much longer than horizontal an arm comes out vertical [mm], by what."""

    length_mm: int
    thesis_mm: float
    printed_mm: float
    right_mm: float
    ours_mm: float
    algebra_mm: float
    shift_mm: float


def _difference(length_mm: int, horizontal: Trials, vertical: Trials) -> _Difference | None:
    means = [(_mean(vertical, method), _mean(horizontal, method)) for method in _METHODS]
    differences = [up.error_mm - flat.error_mm for up, flat in means if up is not None and flat is not None]
    known = [trial for trial in vertical if trial.printed_by_algebra_mm is not None]
    if len(differences) < len(_METHODS) or not known:
        return None
    algebra = np.mean([(t.printed_by_algebra_mm or 0.0) - (t.estimated_mm or 0.0) for t in known])
    shift = np.mean([(t.printed_mm or 0.0) - (t.estimated_mm or 0.0) for t in known])
    published = [thesis_length(alignment, length_mm).mean_mm for alignment in ALIGNMENTS]
    printed_mm, right_mm, ours_mm = differences
    return _Difference(
        length_mm=length_mm,
        thesis_mm=published[1] - published[0],
        printed_mm=printed_mm,
        right_mm=right_mm,
        ours_mm=ours_mm,
        algebra_mm=float(algebra),
        shift_mm=float(shift),
    )


def _equation16(measured: list[Trials]) -> Findings:
    pairs = zip(LENGTHS_MM, measured[::2], measured[1::2], strict=True)
    rows = [row for each in pairs if (row := _difference(*each)) is not None]
    short = [row for row in rows if row.length_mm < max(LENGTHS_MM)]
    off = max((abs(row.shift_mm - row.algebra_mm) for row in rows), default=np.inf)
    longest = max((abs(row.right_mm) for row in rows), default=np.inf)
    text = ", ".join(f"{row.printed_mm:+.1f}" for row in rows)
    checks = (
        Check(
            f"as printed, vertical arms are longer by {text} mm: all", all(row.printed_mm > 0 for row in rows)
        ),
        Check(
            "the three shorter ones by 10 mm and more, as in the thesis",
            bool(short) and all(row.printed_mm > 10.0 for row in short),
        ),
        Check(f"with the right sign by at most {longest:.1f} mm: within 5 mm", longest <= _FEW_MM),
        Check(f"the algebra gives the shift within {off:.1f} mm", off <= _ALGEBRA_MM),
    )
    table = Table(
        caption="By how much vertical arms come out longer than horizontal ones; what the printed sign adds.",
        columns=(
            Column(name="link", unit="mm", form="d"),
            Column(name="thesis", unit="mm", form="+.1f"),
            *(Column(name=method.name, unit="mm", form="+.1f") for method in _METHODS),
            Column(name="shift by algebra", unit="mm", form="+.1f"),
            Column(name="shift measured", unit="mm", form="+.1f"),
        ),
        rows=tuple(tuple(row) for row in rows),
    )
    x = tuple(float(row.length_mm) for row in rows)
    curves = tuple(
        Curve(label=label, x=x, y=tuple(row[column] for row in rows), style="points")
        for column, label in enumerate(("thesis", *(method.name for method in _METHODS)), start=1)
    )
    panel = Panel(y_label="vertical less horizontal [mm]", curves=curves)
    plot = Plot(caption="Vertical less horizontal length.", x_label="length [mm]", panels=(panel,))
    return Findings(checks, (table,), (plot,), _EQUATION_16)


# ---------------------------------------------------------------------- the experiments


def _sweep_experiments() -> list[Experiment]:
    return [
        Experiment(
            f"figure{first + k}",
            f"Figure {first + k}: amplitudes, {length} mm {alignment}",
            _SWEEP_FINDINGS[alignment, length],
            partial(_sweep_units, alignment, length),
            partial(_examine_sweep, alignment, length),
        )
        for alignment, first in zip(ALIGNMENTS, (23, 29), strict=True)
        for k, length in enumerate(LENGTHS_MM)
    ]


def _repeat_experiments() -> list[Experiment]:
    experiments = []
    for alignment, first, table in zip(ALIGNMENTS, (36, 40), (4, 5), strict=True):
        for k, length in enumerate(LENGTHS_MM):
            published = thesis_length(alignment, length)
            finding = f"The mean of the thesis' thirteen trials was {published.mean_mm:g} mm for {length} mm."
            title = f"Figure {first + k}: thirteen trials, {length} mm {alignment}"
            units = partial(_arm_units, alignment, length)
            examine = partial(_trial_figure, alignment, length)
            experiments.append(Experiment(f"figure{first + k}", title, finding, units, examine))
        experiments.append(
            Experiment(
                f"table{table}",
                f"Table {table}: {alignment} lengths",
                _TABLE_FINDINGS[alignment],
                partial(_alignment_units, alignment),
                partial(_length_summary, alignment),
            )
        )
    return experiments


def _arm_units(alignment: Alignment, length_mm: int, scope: Scope) -> tuple[Unit, ...]:
    return (_repeats(alignment, length_mm, scope),)


def _alignment_units(alignment: Alignment, scope: Scope) -> tuple[Unit, ...]:
    return tuple(_repeats(alignment, length_mm, scope) for length_mm in LENGTHS_MM)


_TABLE_FINDINGS: dict[Alignment, str] = {
    "horizontal": "The thesis' horizontal links erred by less than 5 %, and trials by a few millimetres.",
    "vertical": "The thesis' vertical links came out too long but for the longest, the shortest by 10 %.",
}

LENGTH_EXPERIMENTS: tuple[Experiment, ...] = (
    *_sweep_experiments(),
    *_repeat_experiments(),
    Experiment(
        "equation16",
        "Equation 16: the sign with which gravity is turned",
        "The thesis left open (6.2.3, 6.2.4) why vertical links came out longer than horizontal ones.",
        _both_alignments,
        _equation16,
    ),
)

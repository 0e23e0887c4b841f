"""Figures 36 to 43 and tables 4 and 5 of the thesis: thirteen trials on each arm.

The statistic on both sides is that of tables 4 and 5: the error of the mean of all trials.
"""

from functools import partial

from coordinator.report.document import Cell, Curve, Panel, Plot, Table
from sim.thesis.experiment import Check, Column, Experiment, Findings, Scope, Unit
from sim.thesis.kinematics.length_estimates import (
    FEW_MM,
    METHODS,
    PRINTED,
    Mean,
    Trials,
    curve,
    mean_of,
    repeats,
)
from sim.thesis.published import ALIGNMENTS, LENGTHS_MM, Alignment, thesis_length


def _length_checks(alignment: Alignment, length_mm: int, trials: Trials) -> list[Check]:
    own = mean_of(trials, PRINTED)
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
        Check(f"{both}: alike within 5 mm", near <= FEW_MM),
        Check(
            f"{length_mm} mm: one trial scatters by {own.scatter_mm:.1f} mm: a few", own.scatter_mm <= FEW_MM
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
    curves = [curve(method, x, trials).model_copy(update={"style": "points"}) for method in METHODS]
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
    """Return the printed mean of every link and, below it, ours by all methods."""
    columns = (
        Column(name="link", unit="mm", form="d"),
        Column(name="amplitude", unit="rad", form=".2f"),
        Column(name="truth", unit="mm"),
        Column(name="by"),
        Column(name="mean", unit="mm"),
        Column(name="error", unit="mm", form="+.2f"),
        Column(name="error", unit="%", form="+.2f"),
        Column(name="scatter", unit="mm", form=".2f"),
    )
    rows: list[tuple[Cell, ...]] = []
    for length_mm, own in trials.items():
        published = thesis_length(alignment, length_mm)
        error_mm = published.mean_mm - length_mm
        printed = (published.mean_mm, error_mm, 100 * error_mm / length_mm, None)
        rows.append((length_mm, published.amplitude_rad, float(length_mm), "printed", *printed))
        arm = (length_mm, published.amplitude_rad, own[0].true_mm)
        rows += [(*arm, method.name, *_mean_cells(mean_of(own, method), arm[2])) for method in METHODS]
    count = len(next(iter(trials.values())))
    return Table(caption=f"Mean of {count} trials, {alignment}.", columns=columns, rows=tuple(rows))


def _mean_cells(mean: Mean | None, true_mm: float) -> tuple[Cell, ...]:
    if mean is None:
        return (None,) * 4
    return mean.mean_mm, mean.error_mm, 100 * mean.error_mm / true_mm, mean.scatter_mm


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
    for method in METHODS:
        known = [
            (at, mean.error_mm) for at, own in trials.items() if (mean := mean_of(own, method)) is not None
        ]
        places, errors = tuple(float(at) for at, _ in known), tuple(error for _, error in known)
        curves.append(Curve(label=method.name, x=places, y=errors, style="points"))
    curves.append(Curve(label="truth", x=(min(x), max(x)), y=(0.0, 0.0), style="level"))
    return Plot(
        caption=f"Error of the mean over the length, {alignment}.",
        x_label="length [mm]",
        panels=(Panel(y_label="error of the mean [mm]", curves=tuple(curves)),),
    )


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
    return (repeats(alignment, length_mm, scope),)


def _alignment_units(alignment: Alignment, scope: Scope) -> tuple[Unit, ...]:
    return tuple(repeats(alignment, length_mm, scope) for length_mm in LENGTHS_MM)


_TABLE_FINDINGS: dict[Alignment, str] = {
    "horizontal": "The thesis' horizontal links erred by less than 5 %, and trials by a few millimetres.",
    "vertical": "The thesis' vertical links came out too long but for the longest, the shortest by 10 %.",
}


REPEAT_EXPERIMENTS: tuple[Experiment, ...] = tuple(_repeat_experiments())

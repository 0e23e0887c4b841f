"""Results of the amplitude experiment: summaries next to the thesis' figures, files, and a picture.

The picture draws the estimated length over the amplitude, as the thesis' figures 23-26 and 29-32 do.
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from module_agent.model.errors import UsageError
from module_agent.model.files import replacing, write_json
from sim.thesis.kinematics.amplitude_sweep import AmplitudeTrial
from sim.thesis.published import ALIGNMENTS, Alignment, ThesisLength, thesis_length


class Repeats(NamedTuple):
    """Repeated trials on one arm at the thesis' amplitude; scatter is one standard deviation of a trial."""

    thesis: ThesisLength
    trials: int
    true_mm: float
    mean_mm: float
    scatter_mm: float

    @property
    def error_mm(self) -> float:
        """The mean's error, positive where it is too long."""
        return self.mean_mm - self.true_mm


def repeats(trials: Sequence[AmplitudeTrial], filtered: bool = True) -> list[Repeats]:
    """Summarise the repeated trials, arm by arm, in the order in which they come.

    An arm without any estimate is omitted.
    """
    arms: dict[tuple[Alignment, int], list[AmplitudeTrial]] = {}
    for trial in trials:
        if trial.purpose == "repeats":
            arms.setdefault((trial.alignment, trial.length_mm), []).append(trial)
    summaries = []
    for (alignment, length), own in arms.items():
        estimates = [t.estimated_mm if filtered else t.unfiltered_mm for t in own]
        known = np.array([e for e in estimates if e is not None])
        if known.size:
            mean, scatter = float(known.mean()), float(known.std(ddof=min(1, known.size - 1)))
            thesis = thesis_length(alignment, length)
            summaries.append(Repeats(thesis, known.size, own[0].true_mm, mean, scatter))
    return summaries


def write_results(folder: Path, settings: dict[str, object], trials: Sequence[AmplitudeTrial]) -> None:
    """Write `amplitudes.json` (settings, all trials, both summaries) and `amplitudes.csv` (all trials).

    Each file is the complete old or the complete new one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    document = {
        **settings,
        "trials": [trial._asdict() for trial in trials],
        "repeats": [_plain(row) for row in repeats(trials)],
        "repeats_unfiltered": [_plain(row) for row in repeats(trials, filtered=False)],
    }
    write_json(folder / "amplitudes.json", document)
    csv_file = folder / "amplitudes.csv"
    with replacing(csv_file) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(AmplitudeTrial._fields)
        writer.writerows(trials)


def _plain(row: Repeats) -> dict[str, object]:
    names = ("trials", "true_mm", "mean_mm", "error_mm", "scatter_mm")
    thesis = {**row.thesis._asdict(), "thesis_mean_mm": row.thesis.mean_mm}
    return thesis | {name: getattr(row, name) for name in names}


_THESIS, _TRUTH, _SATURATED = "#b0204a", "#404040", "#e9e4da"
_SERIES = {True: ("#1f5fa8", "o", "thesis' analysis"), False: ("#d07a1f", "s", "without its filter")}
# The same relative range in every panel, so that they can be compared; what is beyond is drawn at its edge.
_MIN_RANGE, _MAX_RANGE = 0.10, 0.30


def plot(trials: Sequence[AmplitudeTrial], path: Path, title: str) -> None:
    """Draw the sweep and save it (PNG, SVG or PDF by suffix): one row per alignment, one column per length.

    Raises:
        UsageError: no trial of a sweep, or a suffix that matplotlib cannot write.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    sweep = [trial for trial in trials if trial.purpose == "sweep"]
    if not sweep:
        raise UsageError("no trial of a sweep over amplitudes: nothing to draw")
    lengths = list(dict.fromkeys(trial.length_mm for trial in sweep))
    width = max(3.1 * len(lengths) + 0.9, 6.0)
    figure = Figure(figsize=(width, 7.0), dpi=150)
    grid: Any = figure.subplots(2, len(lengths), squeeze=False)
    half = float(np.clip(1.1 * _largest_error(sweep), _MIN_RANGE, _MAX_RANGE))
    for row, alignment in enumerate(ALIGNMENTS):
        for column, length in enumerate(lengths):
            own = [t for t in sweep if (t.alignment, t.length_mm) == (alignment, length)]
            axes = grid[row][column]
            _panel(axes, own, half)
            axes.set_title(f"{length} mm, {alignment}", fontsize=10)
            _thesis_mark(axes, alignment, length, half)
            if row == len(ALIGNMENTS) - 1:
                axes.set_xlabel("amplitude [rad]")
            if column == 0:
                axes.set_ylabel("estimated length [mm]")
            if column == len(lengths) - 1:
                axes.error_axis.set_ylabel("error [%]")
    figure.suptitle(title, fontsize=12, y=0.985)
    handles, _ = grid[0][0].get_legend_handles_labels()
    if _largest_error(sweep) >= half:
        beyond = Line2D([], [], marker="v", linestyle="none", color="#808080", markersize=4.0)
        beyond.set_label("beyond the scale")
        handles.append(beyond)
    figure.legend(
        handles=handles, loc="lower center", ncol=min(3, len(lengths) + 1), fontsize=9, frameon=False
    )
    figure.subplots_adjust(
        left=0.75 / width, right=1 - 0.75 / width, top=0.90, bottom=0.17, wspace=0.48, hspace=0.27
    )
    figure.savefig(path)


def _largest_error(sweep: Sequence[AmplitudeTrial]) -> float:
    """Return the size of the largest relative error, with the filter or without."""
    errors = [abs(e) for t in sweep for filtered in (True, False) if (e := t.error(filtered)) is not None]
    return max(errors, default=0.0)


def _panel(axes: Any, own: Sequence[AmplitudeTrial], half: float) -> None:
    """Draw one arm: the mean over rigs as a line, every rig as a point, and where the velocity saturates."""
    axes.grid(True, linewidth=0.4, color="#d5d5d5")
    axes.set_axisbelow(True)
    if not own:
        axes.error_axis = axes.twinx()
        return
    true = own[0].true_mm
    axes.axhline(true, color=_TRUTH, linewidth=1.0, label="true length")
    _shade(axes, own)
    _series(axes, own, True, half)
    _series(axes, own, False, half)
    axes.set_xlim(0.0, max(t.amplitude_rad for t in own) + 0.02)
    axes.set_ylim(true * (1 - half), true * (1 + half))
    axes.error_axis = axes.twinx()
    axes.error_axis.set_ylim(-100 * half, 100 * half)
    for each in (axes, axes.error_axis):
        each.tick_params(labelsize=8)


def _shade(axes: Any, own: Sequence[AmplitudeTrial]) -> None:
    amplitudes = sorted({t.amplitude_rad for t in own})
    saturated = [t.amplitude_rad for t in own if t.saturated]
    if saturated:
        first = amplitudes.index(min(saturated))
        start = amplitudes[0] / 2 if first == 0 else (amplitudes[first - 1] + amplitudes[first]) / 2
        axes.axvspan(
            start, amplitudes[-1] + 0.02, color=_SATURATED, zorder=0, label="commanded speed is cut off"
        )


def _series(axes: Any, own: Sequence[AmplitudeTrial], filtered: bool, half: float) -> None:
    colour, marker, label = _SERIES[filtered]
    true = own[0].true_mm
    low, high = true * (1 - half), true * (1 + half)
    points = [(t.amplitude_rad, true * (1 + e)) for t in own if (e := t.error(filtered)) is not None]
    inside = [(a, y) for a, y in points if low < y < high]
    outside = [(a, y) for a, y in points if not low < y < high]
    amplitudes = sorted({a for a, _ in points})
    means = [np.mean([y for a, y in points if a == amplitude]) for amplitude in amplitudes]
    face = colour if filtered else "white"
    style = {"color": colour, "markersize": 4.0, "markerfacecolor": face, "linestyle": "none"}
    axes.plot(amplitudes, means, color=colour, linewidth=1.3, linestyle="-" if filtered else "--")
    axes.plot([a for a, _ in inside], [y for _, y in inside], marker=marker, label=label, **style)
    for amplitude, y in outside:
        edge, arrow = (high, "^") if y >= high else (low, "v")
        axes.plot([amplitude], [edge], marker=arrow, clip_on=False, **style)


def _thesis_mark(axes: Any, alignment: Alignment, length_mm: int, half: float) -> None:
    published = thesis_length(alignment, length_mm)
    axes.plot(
        [published.amplitude_rad],
        [published.mean_mm],
        marker="*",
        markersize=10.0,
        linestyle="none",
        color=_THESIS,
        markeredgecolor="white",
        markeredgewidth=0.6,
        zorder=5,
        label="thesis: 13 trials on real modules",
    )

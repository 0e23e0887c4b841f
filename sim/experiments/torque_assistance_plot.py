"""How the thesis' arm follows in the three input modes, as a picture: its figures 52 to 61."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sim.experiments.thesis_gains import READINGS, SETTINGS
from sim.experiments.thesis_lengths import ALIGNMENTS
from sim.experiments.torque_assistance import ON_MODULE
from sim.experiments.torque_assistance_cases import Combination

_ASKED = "#202020"
_COLOURS = ("#d07a1f", "#1f5fa8", "#2c8a4b")
_LABELS = (
    "mode 1: position",
    "mode 2: position and velocity",
    "mode 3: position, velocity and calculated torque",
)
# The thesis' figures by alignment and setting; where it found nothing stable it has none.
_FIGURES = {("vertical", f"#{k}"): 51 + k for k in range(1, 7)} | {
    ("horizontal", f"#{k}"): 55 + k for k in range(4, 7)
}
_SAMPLE_S = 0.004
_COLUMNS = 3


def plot_assistance(found: Sequence[Combination], path: Path, title: str) -> None:
    """Draw the thesis' settings and save (PNG, SVG or PDF by suffix): a panel for each with all modes.

    Raises:
        ValueError: none of the combinations is one of the thesis', or matplotlib cannot write the suffix.
    """
    panels = [_first(found, alignment, each.name) for alignment in ALIGNMENTS[::-1] for each in SETTINGS]
    if not any(panels):
        raise ValueError("no combination of the thesis' arm and settings: nothing to draw")
    figure = Figure(figsize=(13.5, 12.0), dpi=120)
    FigureCanvasAgg(figure)
    grid: Any = figure.subplots(len(panels) // _COLUMNS, _COLUMNS, squeeze=False)
    for axes, one in zip(grid.flat, panels, strict=True):
        if one is None:
            axes.set_axis_off()
        else:
            _panel(axes, one)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    for row in grid:
        row[0].set_ylabel("position [rad]")
    figure.suptitle(title, fontsize=12, y=0.99)
    figure.legend(handles=_legend(), loc="lower center", ncol=4, fontsize=10, frameon=False)
    figure.subplots_adjust(left=0.06, right=0.985, top=0.94, bottom=0.075, wspace=0.18, hspace=0.33)
    figure.savefig(path)


def _legend() -> list[Line2D]:
    modes = [
        Line2D([], [], color=colour, label=label) for colour, label in zip(_COLOURS, _LABELS, strict=True)
    ]
    return [Line2D([], [], color=_ASKED, linewidth=1.0, linestyle="--", label="asked for"), *modes]


def _first(found: Sequence[Combination], alignment: str, setting: str) -> Combination | None:
    """Return the first combination of an alignment and a setting, on the module and in the first reading."""
    for each in found:
        gains = each.case.gains
        if (each.case.alignment, gains.setting) == (alignment, setting) and (
            gains.reading == READINGS[0] and each.case.delivery == ON_MODULE
        ):
            return each
    return None


def _panel(axes: Any, one: Combination) -> None:
    case = one.case
    axes.grid(True, linewidth=0.4, color="#d5d5d5")
    for each, colour in zip(one.follows, _COLOURS, strict=True):
        t_s = _SAMPLE_S * np.arange(len(each.done_rad))
        # What rings hides the others: it is drawn thin and pale.
        look = {"linewidth": 0.6, "alpha": 0.6} if each.unstable else {"linewidth": 1.3}
        axes.plot(t_s, each.done_rad[:, :1], color=colour, **look)
    longest = max(one.follows, key=lambda each: len(each.asked_rad))
    t_s = _SAMPLE_S * np.arange(len(longest.asked_rad))
    axes.plot(t_s, longest.asked_rad[:, :1], color=_ASKED, linewidth=1.0, linestyle="--")
    rms = " / ".join(
        f"{1e3 * each.rms_error_rad:.1f}" + ("*" if each.unstable else "") for each in one.follows
    )
    number = _FIGURES.get((case.alignment or "", case.gains.name))
    beside = f"figure {number}" if number is not None else "no figure"
    axes.set_title(
        f"{case.alignment}, strategy {case.gains.strategy}, {case.gains.name} ({beside})\n"
        f"{case.motion}, rms error {rms} mrad",
        fontsize=9,
    )

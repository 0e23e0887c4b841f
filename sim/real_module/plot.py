"""A picture of a log against its simulation: each signal recorded over simulated, the difference below it."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sim.real_module.comparison import Simulated, compare
from sim.real_module.real_log import RealLog

_RECORDED, _SIMULATED, _DIFFERENCE = "#808890", "#c8401a", "#2a6fb0"
# The beginning, drawn larger: the only transient of a log of sines.
_CLOSE_S = 1.0


class _Panel(NamedTuple):
    signal: str
    title: str
    axis: str


_PANELS = (
    _Panel("position_rad", "position", "rad"),
    _Panel("pwm", "PWM (duty of the bus voltage)", "1"),
    _Panel("winding_current_a", "winding current", "A"),
)


def plot(log: RealLog, simulated: Simulated, title: str, path: Path | None = None) -> Figure:
    """Draw position, PWM and current and return the figure; with a path also save it.

    Raises:
        ValueError: a suffix that matplotlib cannot write.
        OSError: the file cannot be written.
    """
    figure = Figure(figsize=(13.0, 11.0), dpi=110)
    FigureCanvasAgg(figure)
    ratios = {row.signal: row for row in compare(log, simulated)}
    margins = {"left": 0.07, "right": 0.985, "top": 0.905, "bottom": 0.05}
    grid = figure.add_gridspec(3, 2, width_ratios=(2.2, 1.0), hspace=0.27, wspace=0.16, **margins)
    for i, panel in enumerate(_PANELS):
        ratio, last = ratios[panel.signal].ratio, panel is _PANELS[-1]
        off = "" if ratio is None else f": rms difference {100.0 * ratio:.1f} % of the recorded rms"
        _signal(figure, grid[i, 0], log, simulated, panel, f"{panel.title}{off}", last)
        _signal(figure, grid[i, 1], log, simulated, panel, f"the first {_CLOSE_S:g} s", last, _CLOSE_S)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    more, names = figure.axes[1].get_legend_handles_labels()
    figure.legend(
        handles + more,
        labels + names,
        loc="upper right",
        bbox_to_anchor=(0.985, 0.99),
        ncols=3,
        frameon=False,
        fontsize=11,
    )
    figure.text(0.07, 0.965, title, fontsize=14, weight="bold")
    if path is not None:
        figure.savefig(path)
    return figure


def _signal(
    figure: Figure,
    place: Any,
    log: RealLog,
    simulated: Simulated,
    panel: _Panel,
    heading: str,
    last: bool,
    until_s: float | None = None,
) -> None:
    grid = place.subgridspec(2, 1, height_ratios=(3.0, 1.0), hspace=0.06)
    both = figure.add_subplot(grid[0])
    below = figure.add_subplot(grid[1], sharex=both)
    t_s = log.t_s - log.t_s[0]
    chosen = t_s <= (t_s[-1] if until_s is None else until_s)
    recorded, ours = getattr(log, panel.signal)[chosen], getattr(simulated, panel.signal)[chosen]
    t_s = t_s[chosen]
    both.plot(t_s, recorded, color=_RECORDED, linewidth=2.4, label="recorded")
    both.plot(t_s, ours, color=_SIMULATED, linewidth=1.0, label="simulated")
    below.plot(t_s, recorded - ours, color=_DIFFERENCE, linewidth=0.8, label="recorded - simulated")
    below.axhline(0.0, color="#909090", linewidth=0.6)
    reach = 1.1 * max(float(np.abs(recorded - ours).max()), 1e-9)
    below.set_ylim(-reach, reach)
    below.yaxis.set_major_locator(MaxNLocator(nbins=4, symmetric=True))
    both.set_title(heading, fontsize=10, loc="left")
    unit = "" if panel.axis == "1" else f" [{panel.axis}]"
    if until_s is None:
        both.set_ylabel(f"{panel.title.split(' (')[0]}{unit}")
        below.set_ylabel(f"diff.{unit}", fontsize=8)
    both.tick_params(labelbottom=False)
    both.margins(x=0.01)
    if last:
        below.set_xlabel("time [s]")
    for axes in (both, below):
        axes.grid(color="#e0e0e0", linewidth=0.5)
        axes.tick_params(labelsize=8)
        axes.get_yaxis().set_label_coords(-0.06, 0.5)

"""Drawings of reports by matplotlib as SVG text, in the light colours of `pages.PALETTE`.

Text stays text, so that it can be searched and copied. Drawings have no background: that of the page is seen.
The same data gives the same bytes.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from io import StringIO
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.report.document import Curve, Figure, Plot
from coordinator.report.pages import PALETTE
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

WIDTH_IN = 9.6
# More points than this are not told apart at the width of a page.
MAX_DRAWN = 1200
# Pauses between motions are drawn this short.
PAUSE_S = 0.5
_COLOURS = {name: light for name, (light, _) in PALETTE.items()}
_INK, _MUTED, _GRID = _COLOURS["ink"], _COLOURS["muted"], _COLOURS["grid"]
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "report",
    "font.size": 9.0,
    "font.family": "sans-serif",
    "text.color": _INK,
    "axes.labelcolor": _MUTED,
    "axes.edgecolor": _GRID,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "xtick.color": _GRID,
    "ytick.color": _GRID,
    "xtick.labelcolor": _MUTED,
    "ytick.labelcolor": _MUTED,
    "grid.color": _GRID,
    "grid.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.1,
    "legend.frameon": False,
}
_NO_METADATA = dict.fromkeys(("Date", "Creator", "Format", "Type"))


class Bar(NamedTuple):
    """A stretch of time with its name, in seconds."""

    name: str
    start_s: float
    end_s: float
    failed: bool = False


class MissingPlots(UsageError):
    """Drawings need matplotlib, which is not installed."""


def check_plots() -> None:
    """Check before the work that drawings can be made.

    Raises:
        MissingPlots: matplotlib is not installed.
    """
    if find_spec("matplotlib") is None:
        raise MissingPlots(
            "a report needs matplotlib, which is not installed: pip install 'x5-self-model[report]'"
        )


@contextmanager
def _drawing(height_in: float) -> Iterator[tuple["Canvas", StringIO]]:
    """Yield an empty figure, and the text that holds it as SVG after the block."""
    check_plots()
    # Imported on use: half a second, which a program without a report does not pay.
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure as Canvas

    out = StringIO()
    with rc_context(_STYLE):
        figure = Canvas(figsize=(WIDTH_IN, height_in))
        FigureCanvasSVG(figure)
        yield figure, out
        figure.savefig(out, format="svg", metadata=_NO_METADATA, transparent=True)


# ---------------------------------------------------------------------- torques


def torque_plot(t_s: ArrayLike, measured_nm: ArrayLike, predicted_nm: ArrayLike) -> str:
    """Draw a joint's torque, measured and predicted, and the residual below; (m,), NaN where there is none.

    Pauses are cut to `PAUSE_S`.
    """
    measured, predicted = (np.asarray(one, dtype=float) for one in (measured_nm, predicted_nm))
    time_s, parts = without_pauses(np.asarray(t_s, dtype=float))
    with _drawing(3.2) as (figure, out):
        above, below = figure.subplots(
            2, 1, sharex=True, height_ratios=(1.7, 1.0), gridspec_kw={"hspace": 0.16}
        )
        figure.subplots_adjust(left=0.1, right=0.99, top=0.9, bottom=0.14)
        curves = (
            (above, measured, "measured", "measured", "-"),
            (above, predicted, "predicted", "predicted", "--"),
            (below, measured - predicted, "residual", "measured - predicted", "-"),
        )
        for axes, values, colour, label, dashes in curves:
            for k, part in enumerate(parts):
                thin = part[:: max(1, len(time_s) // MAX_DRAWN)]
                name = label if k == 0 else None
                axes.plot(time_s[thin], values[thin], dashes, color=_COLOURS[colour], label=name)
        above.set_ylabel("torque [Nm]")
        below.set_ylabel("residual [Nm]", fontsize=8)
        below.set_xlabel("time, pauses left out [s]")
        handles = [*above.get_lines()[: len(parts) + 1 : max(1, len(parts))], below.get_lines()[0]]
        figure.legend(
            handles,
            [str(h.get_label()) for h in handles],
            loc="upper left",
            ncols=3,
            bbox_to_anchor=(0.06, 1.01),
        )
        figure.align_ylabels()
    return out.getvalue()


def without_pauses(t_s: Array) -> tuple[Array, list[Any]]:
    """Return times from zero (m,) with pauses cut to `PAUSE_S`, and the indices of every part between."""
    steps = np.diff(t_s, prepend=t_s[:1])
    cuts = np.flatnonzero(np.abs(steps) > PAUSE_S)
    steps[cuts] = PAUSE_S
    return np.cumsum(steps), np.split(np.arange(len(t_s)), cuts)


# ---------------------------------------------------------------------- the robot


def robot_plot(chain: Chain) -> str:
    """Draw a robot at q = 0 in two projections: joints with their axes, links, IMUs, names of modules.

    A joint is drawn where its axis is nearest to its IMU: where it sits along its axis is not observable.
    """
    joints, imus, axes = _upright(chain)
    extent = np.ptp(np.vstack([joints, imus]), axis=0)
    wide = extent[0] > extent[2]
    views = (
        ("from the side", (0, 2)),
        ("from above", (0, 1)) if wide else ("along the widest side", (1, 2)),
    )
    with _drawing(4.0) as (figure, out):
        for k, (title, pair) in enumerate(views):
            panel = figure.add_axes((0.085 + 0.5 * k, 0.12, 0.3, 0.74))
            _view(panel, chain, joints[:, pair], imus[:, pair], axes[:, pair])
            panel.set_title(title, loc="left", color=_MUTED, fontsize=9)
            panel.set_xlabel("horizontal [mm]")
            panel.set_ylabel("up [mm]" if pair[1] == 2 else "horizontal [mm]")
        _robot_legend(figure)
    return out.getvalue()


def _upright(chain: Chain) -> tuple[Array, Array, Array]:
    """Return joints, IMUs (n, 3) [mm] and axes (n, 3), z up, x along the largest horizontal extent."""
    imus = chain.imu_home[:, :3, 3]
    along = np.sum((imus - chain.point) * chain.axis, axis=1, keepdims=True)
    joints = chain.point + along * chain.axis
    up = chain.gravity / np.linalg.norm(chain.gravity)
    points = np.vstack([joints, imus]) - joints[0]
    flat = points - np.outer(points @ up, up)
    x = np.linalg.svd(flat)[2][0]
    x = x - (x @ up) * up
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    x /= np.linalg.norm(x)
    # The farther end to the right.
    x = x if flat[np.argmax(np.abs(flat @ x))] @ x >= 0.0 else -x
    frame = np.array([x, np.cross(up, x), up])
    origin = joints[0]
    return 1e3 * (joints - origin) @ frame.T, 1e3 * (imus - origin) @ frame.T, chain.axis @ frame.T


def _view(panel: "Axes", chain: Chain, joints: Array, imus: Array, axes: Array) -> None:
    from matplotlib.ticker import MaxNLocator

    points = np.vstack([joints, imus])
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.5 * max(float((high - low).max()), 100.0) * 1.25
    middle = 0.5 * (low + high)
    for k, parent in enumerate(chain.parent):
        if parent != BASE:
            ends = np.array([joints[parent], joints[k]])
            panel.plot(*ends.T, color=_COLOURS["body"], linewidth=6, solid_capstyle="round", zorder=1)
        panel.plot(*np.array([joints[k], imus[k]]).T, color=_MUTED, linewidth=0.8, zorder=2)
        reach = 0.16 * half * axes[k]
        if np.linalg.norm(axes[k]) > 0.2:
            panel.annotate(
                "",
                tuple(joints[k] + reach),
                tuple(joints[k] - reach),
                arrowprops={"arrowstyle": "-|>", "color": _COLOURS["axis"], "linewidth": 1.3},
                zorder=3,
            )
        else:
            panel.plot(
                *joints[k],
                "o",
                markersize=11,
                markerfacecolor="none",
                markeredgecolor=_COLOURS["axis"],
                zorder=3,
            )
    for root in chain.roots:
        panel.plot(*joints[root], marker="s", markersize=15, color=_COLOURS["body"], zorder=0)
    panel.plot(*joints.T, "o", markersize=5, color=_INK, zorder=4)
    panel.plot(*imus.T, "D", markersize=4, color=_COLOURS["measured"], zorder=4)
    panel.set_xlim(middle[0] - half, middle[0] + half)
    panel.set_ylim(middle[1] - half, middle[1] + half)
    panel.xaxis.set_major_locator(MaxNLocator(4))
    panel.yaxis.set_major_locator(MaxNLocator(6))
    panel.set_box_aspect(1.0)
    _names(panel, chain.serials, joints, middle, half)


def _names(panel: "Axes", serials: Sequence[str], joints: Array, middle: Array, half: float) -> None:
    """Write the names to the right of a panel in the order of height, each with a line to its joint."""
    order = np.argsort(joints[:, 1], kind="stable")
    step = min(0.17 * half, 2.0 * half / len(serials))
    heights = joints[order, 1].copy()
    for _ in range(50):  # push neighbouring names apart until they are a line's height away
        close = np.maximum(0.0, step - np.diff(heights))
        heights[1:] += 0.5 * close
        heights[:-1] -= 0.5 * close
    x = middle[0] + 1.08 * half
    for k, height in zip(order, heights, strict=True):
        panel.annotate(
            _short(serials[k]),
            tuple(joints[k]),
            (x, float(height)),
            va="center",
            fontsize=8,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": _GRID, "linewidth": 0.7, "relpos": (0, 0.5)},
        )


def _short(name: str, longest: int = 16) -> str:
    return name if len(name) <= longest else f"{name[: longest - 1]}…"


def _robot_legend(figure: "Canvas") -> None:
    from matplotlib.lines import Line2D

    entries = [
        Line2D([], [], color=_INK, marker="o", markersize=5, linestyle="", label="joint"),
        Line2D([], [], color=_COLOURS["axis"], label="its axis, circle: seen from its end"),
        Line2D([], [], color=_COLOURS["body"], linewidth=6, label="link"),
        Line2D([], [], color=_COLOURS["measured"], marker="D", markersize=4, linestyle="", label="IMU"),
        Line2D([], [], color=_COLOURS["body"], marker="s", markersize=11, linestyle="", label="on the base"),
    ]
    figure.legend(handles=entries, loc="upper left", ncols=5, bbox_to_anchor=(0.05, 1.01), fontsize=8)


# ---------------------------------------------------------------------- time and network


def time_line_plot(bars: Sequence[Bar]) -> str:
    """Draw what a run did as bars over time, one row a step, the first at the top."""
    with _drawing(0.75 + 0.2 * len(bars)) as (figure, out):
        height = 0.75 + 0.2 * len(bars)
        panel = figure.add_axes((0.24, 0.5 / height, 0.74, 1.0 - 0.62 / height))
        for k, bar in enumerate(bars):
            colour = _COLOURS["predicted" if bar.failed else "measured"]
            panel.barh(k, max(bar.end_s - bar.start_s, 0.05), left=bar.start_s, height=0.62, color=colour)
        panel.set_yticks(range(len(bars)), [_short(bar.name, 30) for bar in bars], fontsize=8)
        panel.set_ylim(len(bars) - 0.4, -0.6)
        panel.grid(axis="y", visible=False)
        panel.tick_params(axis="y", length=0)
        panel.set_xlim(left=0.0)
        panel.set_xlabel("time since the beginning [s]")
    return out.getvalue()


def delay_plot(trips_ms: Mapping[str, Array]) -> str:
    """Draw the round trips of every module [ms]: shortest to 95th percentile, median, longest."""
    height = 0.85 + 0.22 * len(trips_ms)
    with _drawing(height) as (figure, out):
        panel = figure.add_axes((0.17, 0.5 / height, 0.81, 1.0 - 0.8 / height))
        rows = np.arange(len(trips_ms))
        low, median, most, longest = np.array(
            [np.percentile(trips, (0, 50, 95, 100)) for trips in trips_ms.values()]
        ).T
        panel.hlines(
            rows, low, most, color=_COLOURS["measured"], linewidth=5, label="shortest to 95th percentile"
        )
        panel.plot(median, rows, "o", color=_INK, markersize=5, label="median")
        panel.plot(longest, rows, "|", color=_COLOURS["predicted"], markersize=9, label="longest")
        panel.set_yticks(rows, [_short(name) for name in trips_ms], fontsize=8)
        panel.set_ylim(len(trips_ms) - 0.5, -0.5)
        panel.set_xlim(left=0.0)
        panel.tick_params(axis="y", length=0)
        panel.set_xlabel("round trip [ms]")
        figure.legend(loc="upper left", ncols=3, bbox_to_anchor=(0.15, 1.0), fontsize=8)
    return out.getvalue()


# ---------------------------------------------------------------------- panels

# Colours and marks of curves in their order. Larger marks first: they show under equal values of later ones.
_CURVE_COLOURS = ("measured", "predicted", "residual", "ink", "axis", "muted")
_MARKS = (("o", 8.0), ("s", 6.0), ("^", 5.0), ("D", 4.0), ("P", 7.0), ("v", 6.0))
# Curves of fewer points show them.
_FEW_POINTS = 50
_PANEL_IN, _SINGLE_IN, _LABELS_IN, _TITLE_IN = 1.9, 2.7, 0.55, 0.25
_LEGEND_ROW_IN, _LEGEND_COLUMNS = 0.22, 3


def panel_figure(plot: Plot) -> Figure:
    """Return a plot as a figure of its caption.

    Raises:
        MissingPlots: matplotlib is not installed.
        ValueError: a panel or a curve without data.
    """
    alt = f"{plot.caption.removesuffix('.')}: {'; '.join(labels(plot))}, over {plot.x_label}"
    return Figure(caption=plot.caption, alt=alt, svg=panel_plot(plot))


def labels(plot: Plot) -> list[str]:
    """Return the labels of all curves, each once."""
    return list(dict.fromkeys(curve.label for panel in plot.panels for curve in panel.curves))


def panel_plot(plot: Plot) -> str:
    """Draw panels below each other over one x axis, with one legend: a label looks the same in all of them.

    Raises:
        MissingPlots: matplotlib is not installed.
        ValueError: a panel or a curve without data.
    """
    for panel in plot.panels:
        if not panel.curves or not all(len(curve.x) == len(curve.y) > 0 for curve in panel.curves):
            raise ValueError(f"{plot.caption} The panel {panel.y_label} has a curve without data.")
    names, count = labels(plot), len(plot.panels)
    titles_in = _TITLE_IN * sum(bool(panel.title) for panel in plot.panels)
    legend_in = _LEGEND_ROW_IN * -(-len(names) // _LEGEND_COLUMNS) + 0.1
    height = (_SINGLE_IN if count == 1 else _PANEL_IN * count) + titles_in + legend_in + _LABELS_IN
    with _drawing(height) as (figure, out):
        grid: Any = figure.subplots(count, 1, sharex=True, squeeze=False, gridspec_kw={"hspace": 0.2})
        figure.subplots_adjust(
            left=0.09, right=0.985, top=1.0 - (legend_in + titles_in / count) / height, bottom=0.5 / height
        )
        for axes, panel in zip(grid[:, 0], plot.panels, strict=True):
            for curve in panel.curves:
                _curve(axes, curve, names.index(curve.label))
            axes.set_ylabel(panel.y_label)
            if panel.log:
                axes.set_yscale("log")
            if panel.title:
                axes.set_title(panel.title, loc="left", color=_MUTED, fontsize=9)
        _few_ticks(grid[:, 0], plot)
        grid[-1, 0].set_xlabel(plot.x_label)
        drawn = [pair for axes in grid[:, 0] for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
        handles = {label: handle for handle, label in drawn}
        figure.legend(
            [handles[name] for name in names],
            names,
            loc="upper left",
            ncols=min(_LEGEND_COLUMNS, len(names)),
            bbox_to_anchor=(0.075, 1.0),
        )
        figure.align_ylabels()
    return out.getvalue()


def _few_ticks(panels: Sequence["Axes"], plot: Plot) -> None:
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    places = [at for panel in plot.panels for curve in panel.curves for at in curve.x]
    if all(float(at).is_integer() for at in places):
        panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes, panel in zip(panels, plot.panels, strict=True):
        if panel.log:
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        else:
            axes.yaxis.set_major_locator(MaxNLocator(5))
            axes.ticklabel_format(axis="y", useOffset=False)


def _curve(axes: "Axes", curve: Curve, number: int) -> None:
    """Draw a curve with the look of its number in the legend."""
    look: dict[str, Any] = {"color": _COLOURS[_CURVE_COLOURS[number % len(_CURVE_COLOURS)]]}
    if curve.style == "level":
        look |= {"linewidth": 1.4, "linestyle": "--" if number % 2 else "-."}
    else:
        marked = curve.style == "points" or len(curve.x) < _FEW_POINTS
        mark, size = _MARKS[number % len(_MARKS)]
        look |= {"marker": mark, "markersize": size} if marked else {}
        look |= {"linewidth": max(2.0 - 0.5 * number, 1.0) if marked else 1.1}
        look |= {"linestyle": "none"} if curve.style == "points" else {}
    thin = slice(None, None, max(1, len(curve.x) // MAX_DRAWN))
    axes.plot(curve.x[thin], curve.y[thin], label=curve.label, **look)

"""The results of a benchmark as a JSON file and as a picture.

The picture has a panel for every figure, with the thesis' value, ours, the bound and the bar in one line for
each case. matplotlib is imported where it draws, since everything else here works without it.
"""

import platform
from collections.abc import Sequence
from importlib.metadata import version
from math import ceil, floor, isfinite, log10
from pathlib import Path
from typing import Any, NamedTuple

from module_agent.model.errors import UsageError
from module_agent.model.files import write_json
from sim.benchmark.case import CaseResult
from sim.benchmark.row import Row

SCHEMA = 1
_MEASURED_WITH = ("x5-self-model", "numpy", "scipy", "numba", "pybullet")


class Results(NamedTuple):
    """The results of a benchmark: its cases, the rows over all of them, settings and wall time."""

    benchmark: str
    settings: dict[str, object]
    cases: Sequence[CaseResult]
    over_all: Sequence[Row]
    wall_time_s: float

    @property
    def rows(self) -> list[Row]:
        """The rows of all cases, those over all of them last."""
        return [row for case in self.cases for row in case.summary.rows] + list(self.over_all)

    @property
    def failures(self) -> list[str]:
        """What failed, with the case that it belongs to."""
        return [f"{case.case}: {text}" for case in self.cases for text in case.failures]

    @property
    def cpu_time_s(self) -> float:
        """Processor time of all trials."""
        return sum(case.cpu_s for case in self.cases)

    @property
    def missed(self) -> list[Row]:
        """The rows whose bar is not met."""
        return [row for row in self.rows if row.holds is False]


def write_results(path: Path, results: Results) -> None:
    """Write the results as JSON; the file is the complete old or the complete new one."""
    write_json(path, document(results))


def document(results: Results) -> dict[str, object]:
    """Return the results as plain data, with the versions that they were measured with."""
    costs = [
        {"case": case.case, "trials": case.trials, "cpu_time_s": round(case.cpu_s, 2)}
        for case in results.cases
    ]
    return {
        "schema": SCHEMA,
        "benchmark": results.benchmark,
        "settings": results.settings,
        "versions": {"python": platform.python_version()} | {name: version(name) for name in _MEASURED_WITH},
        "rows": [row.plain() for row in results.rows],
        "failures": results.failures,
        "costs": costs,
        "wall_time_s": results.wall_time_s,
    }


_OURS, _MISSED, _THESIS, _BOUND, _BAR = "#1f5fa8", "#c0261c", "#d07a1f", "#606060", "#2f7d32"
_ROW_INCH, _PANEL_INCH, _WIDTH_INCH = 0.19, 0.85, 15.0
_MARKS = (("thesis", _THESIS, "*", 8.0), ("bound", _BOUND, "|", 9.0), ("ours", _OURS, "o", 5.0))


class _Panel(NamedTuple):
    """One figure of all cases that have a bar for it."""

    figure: str
    rows: list[Row]

    @property
    def height_inch(self) -> float:
        return _PANEL_INCH + _ROW_INCH * len(self.rows)


def plot(rows: Sequence[Row], path: Path) -> None:
    """Draw the rows that have a bar and save them (PNG, SVG or PDF by suffix), one panel for every figure.

    Raises:
        UsageError: no row has a bar, or a suffix that matplotlib cannot write.
    """
    from matplotlib.figure import Figure

    panels = _panels(rows)
    if not panels:
        raise UsageError("no row has a bar: nothing to draw")
    columns = _columns(panels)
    height = max(sum(panel.height_inch for panel in column) for column in columns) + 0.7
    figure = Figure(figsize=(_WIDTH_INCH, height), dpi=110)
    for number, column in enumerate(columns):
        top = height - 0.75
        for panel in column:
            size = _ROW_INCH * len(panel.rows)
            left = (number + 0.43) / len(columns)
            place = (left, (top - size) / height, 0.53 / len(columns), size / height)
            _draw(figure.add_axes(place), panel)
            top -= panel.height_inch
    figure.legend(handles=_legend(), loc="upper center", ncol=5, fontsize=9, frameon=False)
    figure.savefig(path)


def _panels(rows: Sequence[Row]) -> list[_Panel]:
    """Group the rows with a bar by their figure, without the number that a count is out of."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        if row.limit is not None:
            groups.setdefault(row.figure.partition(", of ")[0], []).append(row)
    return [_Panel(figure, own) for figure, own in groups.items()]


def _columns(panels: Sequence[_Panel]) -> list[list[_Panel]]:
    """Share the panels out to two columns, in their order, the first one no higher than the second."""
    half = 0.5 * sum(panel.height_inch for panel in panels)
    first: list[_Panel] = []
    for panel in panels:
        if first and sum(each.height_inch for each in first) + 0.5 * panel.height_inch > half:
            break
        first.append(panel)
    rest = list(panels[len(first) :])
    return [first, rest] if rest else [first]


def _draw(axes: Any, panel: _Panel) -> None:
    axes.set_title(panel.figure, fontsize=9, loc="left", pad=4.0)
    axes.set_ylim(len(panel.rows) - 0.5, -0.5)
    axes.set_yticks(range(len(panel.rows)), [row.case for row in panel.rows], fontsize=7)
    axes.tick_params(axis="x", labelsize=7, pad=1.5)
    axes.grid(True, axis="x", linewidth=0.4, color="#dddddd")
    axes.set_axisbelow(True)
    # Sizes are compared on a logarithmic scale, counts and shares on a plain one.
    logarithmic = all(isinstance(row.limit, float) and row.limit > 0.0 for row in panel.rows)
    for place, row in enumerate(panel.rows):
        span = [place - 0.45, place + 0.45]
        for edge in row.limit if isinstance(row.limit, tuple) else (row.limit,):
            axes.plot([edge, edge], span, color=_BAR, linewidth=2.0, solid_capstyle="butt")
        for name, colour, marker, size in _MARKS:
            value = getattr(row, name)
            if value is None or not isfinite(value) or (logarithmic and value <= 0.0):
                continue
            shown = _MISSED if name == "ours" and not row.holds else colour
            axes.plot([value], [place], marker=marker, markersize=size, color=shown, markeredgewidth=1.2)
    if logarithmic:
        _decades(axes)
    elif panel.rows[0].limit == 0.0:
        axes.set_xlim(left=-0.5, right=max([1.0, *(row.ours or 0.0 for row in panel.rows)]) + 0.5)


def _decades(axes: Any) -> None:
    """Make the scale logarithmic, over whole decades, so that there are always numbers at it."""
    from matplotlib.ticker import NullFormatter, StrMethodFormatter

    axes.set_xscale("log")
    low, high = axes.dataLim.intervalx
    axes.set_xlim(10.0 ** floor(log10(0.9 * low)), 10.0 ** ceil(log10(1.1 * high)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _legend() -> list[Any]:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], marker=marker, linestyle="none", color=colour, markersize=size, label=name)
        for name, colour, marker, size in (*_MARKS, ("ours, missed", _MISSED, "o", 5.0))
    ]
    return [*handles, Line2D([], [], color=_BAR, linewidth=2.0, label="bar")]

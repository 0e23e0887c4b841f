"""The results of a benchmark as a JSON file and as a picture.

The picture has a panel for every figure, with the thesis' value, ours, the bound and the bar in one line for
each case. matplotlib is imported where it draws, since everything else here works without it.
"""

import platform
from collections.abc import Sequence
from importlib.metadata import version
from math import ceil, floor, isfinite, log10
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from module_agent.model.errors import UsageError
from module_agent.model.files import write_json
from sim.benchmark.case import CaseResult
from sim.benchmark.row import Row

if TYPE_CHECKING:
    from matplotlib.lines import Line2D

SCHEMA = 1
_MEASURED_WITH = ("x5-self-model", "numpy", "scipy", "numba", "pybullet")


class Cost(NamedTuple):
    """The processor time of a case's trials."""

    case: str
    trials: int
    cpu_time_s: float


class Results(NamedTuple):
    """The rows of a benchmark, its failures, settings, processor and wall time."""

    benchmark: str
    settings: dict[str, object]
    rows: tuple[Row, ...]
    failures: tuple[str, ...]
    costs: tuple[Cost, ...]
    wall_time_s: float

    @property
    def cpu_time_s(self) -> float:
        """Processor time of all trials."""
        return sum(cost.cpu_time_s for cost in self.costs)

    @property
    def missed(self) -> tuple[Row, ...]:
        """The rows whose bar is not met."""
        return tuple(row for row in self.rows if row.holds is False)


def gathered(
    benchmark: str,
    settings: dict[str, object],
    cases: Sequence[CaseResult],
    over_all: Sequence[Row],
    wall_time_s: float,
) -> Results:
    """Put the rows of all cases together, those over all of them last."""
    rows = [row for case in cases for row in case.summary.rows]
    failures = tuple(f"{case.case}: {text}" for case in cases for text in case.failures)
    costs = tuple(Cost(case.case, case.trials, round(case.cpu_s, 2)) for case in cases)
    return Results(benchmark, settings, (*rows, *over_all), failures, costs, wall_time_s)


def write_results(path: Path, results: Results) -> None:
    """Write the results as JSON; the file is the complete old or the complete new one."""
    document = {
        "schema": SCHEMA,
        "benchmark": results.benchmark,
        "settings": results.settings,
        "versions": {"python": platform.python_version()} | {name: version(name) for name in _MEASURED_WITH},
        "rows": [row.plain() for row in results.rows],
        "failures": list(results.failures),
        "costs": [cost._asdict() for cost in results.costs],
        "wall_time_s": results.wall_time_s,
    }
    write_json(path, document)


_OURS, _MISSED, _THESIS, _BOUND, _BAR = "#1f5fa8", "#c0261c", "#d07a1f", "#606060", "#2f7d32"
_ROW_INCH, _PANEL_INCH, _WIDTH_INCH = 0.19, 0.85, 15.0
_MARKS = (
    ("thesis", _THESIS, "*", 8.0),
    ("bound", _BOUND, "|", 9.0),
    ("ours", _OURS, "o", 5.0),
)


class _Panel(NamedTuple):
    """One figure of all cases that have a bar for it."""

    figure: str
    rows: tuple[Row, ...]

    @property
    def height_inch(self) -> float:
        return _PANEL_INCH + _ROW_INCH * len(self.rows)

    @property
    def logarithmic(self) -> bool:
        """Whether sizes are compared; counts and shares are on a plain scale."""
        return all(isinstance(row.limit, float) and row.limit > 0.0 for row in self.rows)


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
    return [_Panel(figure, tuple(own)) for figure, own in groups.items()]


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
    for place, row in enumerate(panel.rows):
        _draw_bar(axes, row, place)
        for name, colour, marker, size in _MARKS:
            value = getattr(row, name)
            if value is None or not isfinite(value) or (panel.logarithmic and value <= 0.0):
                continue
            shown = _MISSED if name == "ours" and not row.holds else colour
            axes.plot([value], [place], marker=marker, markersize=size, color=shown, markeredgewidth=1.2)
    if panel.logarithmic:
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


def _draw_bar(axes: Any, row: Row, place: int) -> None:
    for edge in row.limit if isinstance(row.limit, tuple) else (row.limit,):
        axes.plot(
            [edge, edge], [place - 0.45, place + 0.45], color=_BAR, linewidth=2.0, solid_capstyle="butt"
        )


def _legend() -> list["Line2D"]:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], marker=marker, linestyle="none", color=colour, markersize=size, label=name)
        for name, colour, marker, size in _MARKS
    ]
    missed = Line2D([], [], marker="o", linestyle="none", color=_MISSED, markersize=5.0, label="ours, missed")
    return [*handles, missed, Line2D([], [], color=_BAR, linewidth=2.0, label="bar")]

"""Results of the thesis' experiments as files: `thesis.json`, and `report.md` with a picture of each plot."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coordinator.report.document import Table
from module_agent.model.files import replacing, write_json, write_text
from sim.thesis.experiment import Curve, ExperimentResult, Plot, ThesisResults

# Distinct for colour-blind readers too (Okabe and Ito), in the order of the curves.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#404040", "#cc79a7")
# Larger ones first: they are seen under equal values of later ones.
_MARKERS = (("o", 8.5), ("s", 6.5), ("^", 5.5), ("D", 4.0), ("*", 12.0))
_FEW_POINTS = 50
_WIDTH_IN, _PANEL_IN, _MARGIN_IN = 8.0, 2.4, 1.0


def write_results(folder: Path, outcome: ThesisResults) -> None:
    """Write `thesis.json`, `report.md` and the pictures into a folder.

    Raises:
        OSError: a file cannot be written.
    """
    pictures = folder / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    for one in outcome.experiments:
        for path, plot in zip(_pictures(one), one.plots, strict=True):
            draw(plot, folder / path)
    write_text(folder / "report.md", markdown(outcome))
    write_json(folder / "thesis.json", outcome)


def markdown(outcome: ThesisResults) -> str:
    """Return the report as Markdown; pictures are linked by their path in the report's folder."""
    settings = ", ".join(f"{name} {_setting(value)}" for name, value in outcome.settings.items())
    lines = ["# The thesis' experiments on simulated modules", "", f"Settings: {settings}.", ""]
    lines += ["| experiment | outcome |", "| --- | --- |"]
    lines += [f"| {one.title} | {one.outcome} |" for one in outcome.experiments]
    for one in outcome.experiments:
        lines += ["", *_section(one)]
    return "\n".join(lines) + "\n"


def _setting(value: object) -> str:
    return " ".join(value) or "none" if isinstance(value, tuple) else str(value)


def _section(one: ExperimentResult) -> list[str]:
    lines = [f"## {one.title}", "", one.finding, ""]
    for table in one.tables:
        lines += [*_table(table), ""]
    for path, plot in zip(_pictures(one), one.plots, strict=True):
        lines += [f"![{plot.caption}]({path})", ""]
    lines += [f"- {text}" for text in one.reading]
    return [*lines, *([""] if one.reading else []), f"**{one.outcome.capitalize()}.** {one.reason}"]


def _table(table: Table) -> list[str]:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cells) + " |"

    columns = table.columns
    rows = [[column.shown(cell) for column, cell in zip(columns, row, strict=True)] for row in table.rows]
    heads = [line([column.heading for column in columns]), line(["---"] * len(columns))]
    return [table.caption, "", *heads, *map(line, rows)]


def _pictures(one: ExperimentResult) -> list[str]:
    return [f"pictures/{one.id}_{number}.png" for number in range(1, len(one.plots) + 1)]


def draw(plot: Plot, path: Path) -> None:
    """Draw a plot and save it as PNG.

    Raises:
        OSError: the file cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    height_in = _PANEL_IN * len(plot.panels) + _MARGIN_IN + (0.8 if len(plot.panels) == 1 else 0.0)
    figure = Figure(figsize=(_WIDTH_IN, height_in), dpi=110, layout="constrained")
    grid: Any = figure.subplots(len(plot.panels), 1, sharex=True, squeeze=False)
    # A label has the same look in all panels, as they share a legend.
    labels = list(dict.fromkeys(curve.label for panel in plot.panels for curve in panel.curves))
    for axes, panel in zip(grid[:, 0], plot.panels, strict=True):
        for curve in panel.curves:
            _draw_curve(axes, curve, labels.index(curve.label))
        axes.grid(True, linewidth=0.4, color="#d5d5d5")
        axes.set_axisbelow(True)
        axes.set_ylabel(panel.y_label)
    places = [at for panel in plot.panels for curve in panel.curves for at in curve.x]
    if all(at.is_integer() for at in places):
        grid[-1, 0].xaxis.set_major_locator(MaxNLocator(integer=True))
    grid[-1, 0].set_xlabel(plot.x_label)
    drawn = [pair for axes in grid[:, 0] for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in drawn}
    columns = 2 if len(handles) > 3 else 3
    figure.legend(
        list(handles.values()),
        list(handles),
        loc="outside lower center",
        ncol=columns,
        fontsize=9,
        frameon=False,
    )
    figure.suptitle(plot.caption.removesuffix("."), fontsize=11)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def _draw_curve(axes: Any, curve: Curve, number: int) -> None:
    look: dict[str, Any] = {"color": _COLOURS[number % len(_COLOURS)], "label": curve.label}
    if curve.style == "level":
        look |= {"linewidth": 1.0, "linestyle": "--" if number % 2 else ":"}
    else:
        marked = curve.style == "points" or len(curve.x) < _FEW_POINTS
        marker, size = _MARKERS[number % len(_MARKERS)]
        look |= {"marker": marker, "markersize": size} if marked else {}
        look |= {"linewidth": max(2.2 - 0.6 * number, 1.0) if marked else 1.1}
        look |= {"linestyle": "none"} if curve.style == "points" else {}
    axes.plot(curve.x, curve.y, **look)

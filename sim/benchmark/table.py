"""A benchmark's rows as a table to read; what a colour says, a word says too."""

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sim.benchmark.row import Limit, Row

# A pipe has no width; a table cut short in it would be of no use.
_LEAST_WIDTH = 150


def table(rows: Sequence[Row], title: str) -> Table:
    """Return the rows, every case with its name once."""
    shown = Table(title=title, title_justify="left")
    for name in ("case", "figure", "thesis", "ours", "bound", "bar", ""):
        shown.add_column(name, justify="left" if name in ("case", "figure", "") else "right")
    before = ""
    for row in rows:
        if before and row.case != before:
            shown.add_section()
        cells = (_number(row.thesis), _number(row.ours), _number(row.bound), _bar(row.limit))
        # Units stand in brackets, which are markup to rich.
        name = escape(row.case) if row.case != before else ""
        shown.add_row(name, escape(row.figure), *cells, _verdict(row.holds))
        before = row.case
    return shown


def print_rows(rows: Sequence[Row], title: str) -> None:
    """Print the table on standard output; with FORCE_COLOR set the colours go through a pipe too."""
    console = Console(highlight=False)
    if not sys.stdout.isatty():
        console.width = max(console.width, _LEAST_WIDTH)
    console.print(table(rows, title))


def _verdict(holds: bool | None) -> str:
    return "" if holds is None else "[green]holds[/]" if holds else "[bold red]MISSED[/]"


def _bar(limit: Limit) -> str:
    if limit is None:
        return ""
    return f"{limit[0]:.4g} to {limit[1]:.4g}" if isinstance(limit, tuple) else f"<= {limit:.4g}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if abs(value) < 100.0 else f"{value:.0f}"

"""Terminal output: tables, and a progress line with notes above it; plain lines in a pipe."""

import sys
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

_MIN_PIPE_WIDTH = 150


def new_table(title: str | None, columns: str, **appearance: Any) -> Table:
    """Return a table without rows; `columns` are separated by bars, `>` aligns one to the right.

    Units may stand in brackets, which are markup to rich.
    """
    table = Table(title=escape(title) if title else None, **appearance)
    for name in columns.split(" | "):
        table.add_column(escape(name.lstrip(">")), justify="right" if name.startswith(">") else "left")
    return table


def figure(value: float | None, form: str, unit: str = "") -> str:
    """Return a figure with its unit; a dash if there is none."""
    return "-" if value is None else f"{value:{form}}{unit}"


def print_table(table: Table) -> None:
    """Print a command's result on standard output; with FORCE_COLOR set the colours go through a pipe too."""
    console = Console(highlight=False)
    if not sys.stdout.isatty():
        # A pipe has no width; truncated cells could not be searched.
        console.width = max(console.width, _MIN_PIPE_WIDTH)
    console.print(table)


class Displayed:
    """Has a live display during a `with` block, if its console is a terminal."""

    def __init__(self, console: Console, display: Live | Progress | None):
        self.console = console
        self._display = display if console.is_terminal and not console.quiet else None

    def __enter__(self) -> Self:
        if self._display is not None:
            self._display.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._display is not None:
            self._display.stop()

    def note(self, text: str) -> None:
        """Show a line of text."""
        self.console.print(f"  {text}", markup=False, soft_wrap=True)


class Terminal(Displayed):
    """Progress and notes on standard error, so that standard output stays for results."""

    def __init__(self, quiet: bool = False):
        console = Console(stderr=True, highlight=False, quiet=quiet)
        self._progress = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
        )
        self._task = self._progress.add_task("starting", total=None)
        super().__init__(console, self._progress)

    def progress(self, done: int, total: int, text: str) -> None:
        """Show how much of a step is done; in a pipe nothing is shown."""
        if self._display is not None:
            self._progress.update(self._task, description=text, completed=done, total=total)

    def step(self, index: int, total: int, text: str) -> None:
        """Show that a step begins."""
        if self._display is not None:
            self._progress.update(self._task, description=text, completed=index - 1, total=total)
        else:
            self.console.print(f"[{index}/{total}] {text}", markup=False, soft_wrap=True)

"""Terminal output of a run: a progress line with notes above it; plain lines in a pipe."""

import time
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

_PIPE_WIDTH = 140


def new_table(title: str | None, columns: str, **appearance: Any) -> Table:
    """Return a table without rows; `columns` are separated by bars, `>` aligns one to the right.

    Units may stand in brackets, which are markup to rich.
    """
    table = Table(title=escape(title) if title else None, **appearance)
    for name in columns.split(" | "):
        table.add_column(escape(name.lstrip(">")), justify="right" if name.startswith(">") else "left")
    return table


def print_table(table: Table) -> None:
    """Print a command's result on standard output, with colours where it is a terminal."""
    console = Console(highlight=False)
    # A pipe has no width; truncated cells could not be searched.
    console.width = console.width if console.is_terminal else _PIPE_WIDTH
    console.print(table)


class Terminal:
    """Progress and notes on standard error, so that standard output stays for results."""

    def __init__(self, quiet: bool = False):
        self.console = Console(stderr=True, highlight=False, quiet=quiet)
        self._live = self.console.is_terminal and not quiet
        self._progress = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=self.console,
            transient=True,
        )
        self._task = self._progress.add_task("starting", total=None)
        self._start_s = time.monotonic()

    def __enter__(self) -> "Terminal":
        if self._live:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._progress.stop()

    def step(self, index: int, total: int, text: str) -> None:
        """Show that a step begins."""
        if self._live:
            self._progress.update(self._task, description=text, completed=index - 1, total=total)
        else:
            self.console.print(f"[{index}/{total}] {text}", markup=False, soft_wrap=True)

    def note(self, text: str) -> None:
        """Show a line of text."""
        self.console.print(f"  {text}", markup=False, soft_wrap=True)

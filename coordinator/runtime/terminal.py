"""Terminal output: tables, and a progress line with notes above it; plain lines in a pipe."""

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, Self

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from module_agent.model.errors import EXIT_FAILED, FileError, UsageError
from module_agent.model.files import json_text, write_json

_MIN_PIPE_WIDTH = 150


def new_table(title: str | None, columns: str, **appearance: Any) -> Table:
    """Return a table without rows; `columns` are separated by bars, `>` aligns one to the right.

    Units may stand in brackets, which are markup to rich. In a narrow terminal the first column, which names
    things, stays whole, and the others are folded.
    """
    table = Table(title=escape(title) if title else None, **appearance)
    for place, name in enumerate(columns.split(" | ")):
        side: Literal["left", "right"] = "right" if name.startswith(">") else "left"
        table.add_column(escape(name.lstrip(">")), justify=side, overflow="fold", no_wrap=place == 0)
    return table


STANDARD_OUTPUT = Path("-")


def write_result(file: Path | None, document: object) -> bool:
    """Write a command's result as JSON to a file, or to standard output; return whether people see it there.

    Without a file nothing is written. The document is a pydantic model, or plain data without NaN.

    Raises:
        OSError: the file cannot be written.
    """
    if file == STANDARD_OUTPUT:
        sys.stdout.write(json_text(document))
        sys.stdout.flush()
    elif file is not None:
        write_json(file, document)
    return file != STANDARD_OUTPUT


class JsonLines:
    """Writes one JSON object a line as it comes, to a file or to standard output; nothing without a file.

    Raises:
        UsageError: the file cannot be written.
    """

    def __init__(self, file: Path | None):
        self.to_standard_output = file == STANDARD_OUTPUT
        try:
            opened = None if file is None or self.to_standard_output else file.open("w", encoding="utf-8")
        except OSError as error:
            raise UsageError(f"{file}: {error.strerror or error}") from error
        self._file = opened

    def write(self, what: Mapping[str, object]) -> None:
        """Write a line."""
        stream = sys.stdout if self.to_standard_output else self._file
        if stream is None:
            return
        try:
            stream.write(json.dumps(what) + "\n")
            stream.flush()
        except BrokenPipeError:
            # The reader has gone, which is no fault of a file.
            raise
        except OSError as error:
            raise FileError(OSError(error.errno, error.strerror, stream.name)) from error

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


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

    @property
    def is_live(self) -> bool:
        """Whether there is a live display: the console is a terminal, and not quiet."""
        return self._display is not None

    def note(self, text: str) -> None:
        """Show a line of text."""
        self.console.print(f"  {text}", markup=False, soft_wrap=True)


class _StandardError(Console):
    """Standard error; that nothing reads it any more (`2>&1 | head`) is taken as a closed terminal."""

    def on_broken_pipe(self) -> None:
        """End the program as by SIGHUP: what it moves is stopped first, and its recording is kept.

        Raises:
            SystemExit: it does not handle the signal, since it has nothing to stop.
        """
        self.quiet = True
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), sys.stderr.fileno())
        if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
            raise SystemExit(EXIT_FAILED)
        signal.raise_signal(signal.SIGHUP)


class TimeLeft(ProgressColumn):
    """Time left to the task's `end_s`, which was expected; without one as the steps so far tell."""

    max_refresh = 0.5

    def __init__(self, now_s: Callable[[], float]) -> None:
        super().__init__()
        self._now_s = now_s
        self._by_steps = TimeRemainingColumn()

    def render(self, task: Task) -> Text:
        """Return the time left, of which nothing is known any more once it is over."""
        end_s = task.fields.get("end_s")
        if end_s is None:
            return self._by_steps.render(task)
        minutes, seconds = divmod(round(end_s - self._now_s()), 60)
        return Text("-:--" if minutes < 0 else f"{minutes}:{seconds:02}", style="progress.remaining")


class Terminal(Displayed):
    """Progress and notes on standard error, so that standard output stays for results."""

    def __init__(self, quiet: bool = False):
        console = _StandardError(stderr=True, highlight=False, quiet=quiet)
        self._progress = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeLeft(time.monotonic),
            console=console,
            transient=True,
        )
        self._task = self._progress.add_task("starting", total=None)
        super().__init__(console, self._progress)

    def progress(self, done: int, total: int, text: str) -> None:
        """Show how much of a step is done; in a pipe nothing is shown."""
        if self._display is not None:
            self._progress.update(self._task, description=text, completed=done, total=total)

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        """Show that a step begins, and how long all that is left is expected to take."""
        if self._display is not None:
            end_s = None if left_s is None else time.monotonic() + left_s
            self._progress.update(self._task, description=text, completed=index - 1, total=total, end_s=end_s)
        else:
            left = f" ({left_s:.0f} s left)" if left_s else ""
            self.console.print(f"[{index}/{total}] {text}{left}", markup=False, soft_wrap=True)

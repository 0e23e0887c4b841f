r"""Recorded traces of a network: delay and loss over time, replayed in a circle.

A trace is a CSV file with the header `time_s,delay_ms,lost` and one row for each probe: when it was sent or
came back [s, from any origin, never decreasing], how long it took one way [ms, may be empty if it was lost],
and 1 if it was lost, 0 if not. A row holds until the next one; the last holds as long as the one before it.

`ping` records one, if half the round trip is taken for one way. Short intervals see short stalls:

    ping -D -O -i 0.02 -w 60 HOST | awk -f ping_to_trace.awk > trace.csv

with `ping_to_trace.awk`:

    BEGIN { print "time_s,delay_ms,lost" }
    { at = substr($1, 2, length($1) - 2) }
    /bytes from/ { split($0, part, "time="); printf "%s,%.4f,0\n", at, part[2] / 2 }
    /no answer yet/ { printf "%s,,1\n", at }
"""

import csv
from bisect import bisect_right
from functools import cached_property
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict

from module_agent.model.errors import UsageError

HEADER = ["time_s", "delay_ms", "lost"]
MAX_DELAY_MS = 10_000.0


class TraceError(UsageError):
    """A file that is no trace; the message names file, line and column."""


class TraceRow(NamedTuple):
    """One probe: its time from the start of the trace, its delay one way, whether it was lost."""

    time_s: float
    delay_ms: float
    lost: bool


class NetworkTrace(BaseModel):
    """A recorded trace, its first row at time 0; made by `read_trace`."""

    model_config = ConfigDict(frozen=True)

    rows: tuple[TraceRow, ...]

    @cached_property
    def _times_s(self) -> list[float]:
        return [row.time_s for row in self.rows]

    @cached_property
    def period_s(self) -> float:
        """How long one round of the trace takes [s]; infinite with a single row."""
        return 2.0 * self.rows[-1].time_s - self.rows[-2].time_s if len(self.rows) > 1 else float("inf")

    def at(self, t_s: float) -> TraceRow:
        """Return the row that holds at a time from the start of the replay [s]."""
        return self.rows[max(0, bisect_right(self._times_s, t_s % self.period_s) - 1)]


def read_trace(path: Path) -> NetworkTrace:
    """Read a trace from its CSV file.

    Raises:
        TraceError: the file cannot be read, or is no trace; the message names file, line and column.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TraceError(f"{path}: cannot be read: {error}") from error
    return parse_trace(text, str(path))


def parse_trace(text: str, name: str) -> NetworkTrace:
    """Parse the text of a trace file; `name` is what errors call it.

    Raises:
        TraceError: as `read_trace`.
    """
    lines = csv.reader(text.splitlines())
    header = next(lines, [])
    if [cell.strip() for cell in header] != HEADER:
        raise TraceError(f"{name}:1: the first line must be {','.join(HEADER)}")
    rows: list[TraceRow] = []
    for cells in lines:
        if not cells:
            continue
        try:
            rows.append(_row(cells, rows[-1].time_s if rows else None))
        except TraceError as error:
            raise TraceError(f"{name}:{lines.line_num}: {error}") from error
    if not rows:
        raise TraceError(f"{name}:1: no rows after the header")
    if len(rows) > 1 and rows[0].time_s == rows[-1].time_s:
        raise TraceError(f"{name}:{lines.line_num}: time_s: all rows have the same time")
    return NetworkTrace(rows=tuple(row._replace(time_s=row.time_s - rows[0].time_s) for row in rows))


def _row(cells: list[str], last_s: float | None) -> TraceRow:
    if len(cells) != len(HEADER):
        raise TraceError(f"{len(cells)} values, there must be {len(HEADER)}: {','.join(HEADER)}")
    time_text, delay_text, lost_text = (cell.strip() for cell in cells)
    if lost_text not in ("0", "1"):
        raise TraceError(f"lost: {lost_text!r} must be 0 or 1")
    lost = lost_text == "1"
    time_s = _number("time_s", time_text)
    if last_s is not None and time_s < last_s:
        raise TraceError(f"time_s: {time_text} is before the row above")
    delay_ms = 0.0 if lost and not delay_text else _number("delay_ms", delay_text)
    if not 0.0 <= delay_ms <= MAX_DELAY_MS:
        raise TraceError(f"delay_ms: {delay_text} must be from 0 to {MAX_DELAY_MS:g}")
    return TraceRow(time_s, delay_ms, lost)


def _number(column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise TraceError(f"{column}: {text!r} is not a number") from None
    if not isfinite(value):
        raise TraceError(f"{column}: {text} is not finite")
    return value

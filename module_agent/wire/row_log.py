"""The feedback rows of one module as they arrive: in any order, with gaps, some of them twice.

Rows are numbered since the module's boot, so that a listener knows which are missing and can request them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.wire.feedback_rows import ROW, Rows, unpack
from module_agent.wire.messages import Feedback
from module_agent.wire.refusal import Refusal, WireError

_GROWTH = 4096
# Four hours at 250 Hz, or one at 1 kHz: a row number farther off is not of this session.
MAX_ROWS = 4_000_000


class _Index(NamedTuple):
    """Where rows have arrived, and their module times, as of a number of changes."""

    changes: int
    arrived: NDArray[np.intp]
    t_ns: NDArray[np.int64]
    ascending: bool


class RowLog:
    """Rows of one boot of one module, by row number."""

    def __init__(self, boot: int):
        self.boot = boot
        self._base: int | None = None
        self._end = 0
        self._rows = np.zeros(0, dtype=ROW)
        self._have = np.zeros(0, dtype=bool)
        # Counts changes of the rows; other threads read while rows arrive.
        self._changes = 0
        self._index = _Index(-1, np.zeros(0, np.intp), np.zeros(0, np.int64), True)

    def copied(self) -> "RowLog":
        """Return a log with the rows so far, to which later rows are not added."""
        log = RowLog(self.boot)
        log._base, log._end = self._base, self._end
        used = slice(self._end - self.first_row)
        log._rows, log._have = self._rows[used].copy(), self._have[used].copy()
        return log

    @property
    def first_row(self) -> int:
        """The oldest row number so far, 0 before any."""
        return self._base or 0

    @property
    def end_row(self) -> int:
        """One past the newest row, 0 before any."""
        return self._end

    def add(self, feedback: Feedback) -> Rows:
        """Keep the rows of a message; return them.

        Raises:
            WireError: the block does not hold what the message announces, or is far from all others.
        """
        rows = unpack(feedback)
        if not len(rows):
            return rows
        first, end = feedback.first_row, feedback.first_row + feedback.count
        if self._base is None:
            self._base = first
        if first < self._base or end > self._base + len(self._have):
            self._reserve(first, end, self._base)
        span = slice(first - self._base, end - self._base)
        self._rows[span] = rows
        self._have[span] = True
        self._end = max(self._end, end)
        self._changes += 1
        return rows

    def _reserve(self, first: int, end: int, base: int) -> None:
        if max(end, self._end) - min(first, base) > MAX_ROWS:
            raise WireError(
                Refusal.RANGE, f"row {first} is too far from rows {base} to {self._end} to be of this boot"
            )
        before = max(0, base - first)
        after = max(0, end - base - len(self._have))
        after = max(after, _GROWTH, len(self._have) // 2) if after else 0
        self._rows = np.concatenate((np.zeros(before, ROW), self._rows, np.zeros(after, ROW)))
        self._have = np.concatenate((np.zeros(before, bool), self._have, np.zeros(after, bool)))
        self._base = base - before

    def missing(self, first: int, end: int) -> list[tuple[int, int]]:
        """Return the ranges within rows `first` up to and without `end` that have not arrived."""
        base, have = self.first_row, np.zeros(max(0, end - first), dtype=bool)
        low, high = max(first, base), min(end, base + len(self._have))
        if high > low:
            have[low - first : high - first] = self._have[low - base : high - base]
        edges = np.flatnonzero(np.diff(np.concatenate(([True], have, [True])).astype(np.int8)))
        return [(first + int(a), first + int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]

    def rows(self, first: int, end: int) -> Rows:
        """Return the rows of a range that have arrived, in order, as a copy."""
        base = self.first_row
        span = slice(max(first - base, 0), max(end - base, 0))
        return self._rows[span][self._have[span]]

    def between(self, start_ns: int, end_ns: int) -> Rows:
        """Return the rows that have arrived of a span of module time, both ends included, as a copy."""
        return self._rows[self._within(start_ns, end_ns)]

    def range_between(self, start_ns: int, end_ns: int) -> tuple[int, int]:
        """Return the row numbers, first and one past the last, of a span of module time; (0, 0) if none came.

        Rows within it that have not arrived are counted.
        """
        within = self._within(start_ns, end_ns)
        if not len(within):
            return 0, 0
        return self.first_row + int(within[0]), self.first_row + int(within[-1]) + 1

    def _within(self, start_ns: int, end_ns: int) -> NDArray[np.intp]:
        index = self._times()
        if index.ascending:
            return index.arrived[slice(*np.searchsorted(index.t_ns, [start_ns, end_ns + 1]))]
        return index.arrived[(index.t_ns >= start_ns) & (index.t_ns <= end_ns)]

    def _times(self) -> "_Index":
        """Return where rows have arrived and their times; searched for again when more have."""
        changes, index = self._changes, self._index
        if index.changes != changes:
            arrived = np.flatnonzero(self._have)
            t_ns = self._rows["t_ns"][arrived].astype(np.int64)
            self._index = index = _Index(changes, arrived, t_ns, bool((np.diff(t_ns) >= 0).all()))
        return index

    def forget_before(self, row: int) -> None:
        """Drop rows below `row`, for listeners with little memory."""
        if self._base is None or row <= self._base:
            return
        cut = min(row - self._base, len(self._have))
        self._rows, self._have = self._rows[cut:].copy(), self._have[cut:].copy()
        self._base += cut
        self._changes += 1

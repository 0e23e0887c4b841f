"""The feedback rows of one module as they arrive: in any order, with gaps, some of them twice.

Rows are numbered since the module's boot, so that a listener knows which are missing and can request them.
They are kept as bytes in pages by their number: a row far from all others takes one page, not the memory
between them, and nothing that is kept moves when earlier rows arrive. One thread adds rows and forgets them;
others may read and copy meanwhile, and see a row once it is whole.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.wire.feedback_rows import ROW, Rows, unpack
from module_agent.wire.messages import MAX_BATCH_ROWS, Feedback
from module_agent.wire.refusal import Refusal, WireError

# Four hours at 250 Hz, or one at 1 kHz: a row number farther off is not of this session.
MAX_ROWS = 4_000_000
PAGE_ROWS = 256
# No network loses seven rows of eight where it delivers any: who needs more pages makes row numbers up.
_MIN_FILLED = 8
_FREE_PAGES = 64
_RECORD = np.dtype((np.void, ROW.itemsize))


class _Page:
    """Rows of `PAGE_ROWS` successive numbers, and whether each has arrived."""

    __slots__ = ("arrived", "rows")

    def __init__(self) -> None:
        self.rows = bytearray(PAGE_ROWS * ROW.itemsize)
        self.arrived = bytearray(PAGE_ROWS)

    def records(self) -> NDArray[np.void]:
        """Return its rows, arrived or not, as opaque records: numpy copies those ten times as fast."""
        return np.frombuffer(self.rows, _RECORD)

    def between(self, first: int, end: int) -> memoryview | bytes:
        """Return the bytes of those from place `first` up to and without `end` that have arrived."""
        arrived = bytes(self.arrived[first:end])
        if arrived.count(1) == end - first:
            return memoryview(self.rows)[first * ROW.itemsize : end * ROW.itemsize]
        kept: bytes = self.records()[first:end][np.frombuffer(arrived, bool)].tobytes()
        return kept


class _Index(NamedTuple):
    """The rows that had arrived after a number of changes: their pages, numbers and module times."""

    changes: int
    pages: dict[int, _Page]
    numbers: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    ascending: bool


_NO_ROWS = np.zeros(0, np.int64)


class RowLog:
    """Rows of one boot of one module, by row number."""

    def __init__(self, boot: int):
        self.boot = boot
        self._first: int | None = None
        self._end = 0
        self._count = 0
        # Rows below were forgotten: they are neither kept nor missing. How many of them had never arrived.
        self._forgotten = 0
        self._lost = 0
        self._pages: dict[int, _Page] = {}
        # Counts changes of the rows; other threads read while rows arrive.
        self._changes = 0
        self._index = _Index(-1, {}, _NO_ROWS, _NO_ROWS, True)

    def copied(self) -> "RowLog":
        """Return a log with the rows so far, to which later rows are not added."""
        log = RowLog(self.boot)
        log._first, log._end, log._forgotten = self._first, self._end, self._forgotten
        for number, page in dict(self._pages).items():
            copy = log._pages[number] = _Page()
            # In this order: a row is whole before it is marked.
            copy.arrived[:] = page.arrived
            copy.rows[:] = page.rows
            log._count += copy.arrived.count(1)
            if (place := copy.arrived.find(1)) >= 0:
                # Rows may have come since the ends were read.
                begin = number * PAGE_ROWS
                log._first = begin + place if log._first is None else min(log._first, begin + place)
                log._end = max(log._end, begin + copy.arrived.rfind(1) + 1)
        # Or some may have been forgotten: their mark is set before they are dropped.
        log.forget_before(self._forgotten)
        log._lost = self._lost
        return log

    @property
    def first_row(self) -> int:
        """The oldest row number so far, 0 before any."""
        return self._first or 0

    @property
    def end_row(self) -> int:
        """One past the newest row, 0 before any."""
        return self._end

    @property
    def count(self) -> int:
        """How many rows are kept."""
        return self._count

    @property
    def lost(self) -> int:
        """How many of the rows that were forgotten had never arrived."""
        return self._lost

    @property
    def is_full(self) -> bool:
        """Whether the next message may have no room, for the rows that came, and not for numbers made up."""
        return (
            self._end - self.first_row > MAX_ROWS - MAX_BATCH_ROWS and _MIN_FILLED * self._count >= MAX_ROWS
        )

    def has(self, row: int) -> bool:
        """Return whether a row has arrived, or was forgotten."""
        page = self._pages.get(row // PAGE_ROWS)
        return row < self._forgotten or (page is not None and bool(page.arrived[row % PAGE_ROWS]))

    def add(self, feedback: Feedback) -> Rows:
        """Keep the rows of a message, but for those that were forgotten; return them.

        Raises:
            WireError: the block does not hold what the message announces, or is far from all others.
        """
        rows = unpack(feedback)
        if not len(rows):
            return rows
        first, end = max(feedback.first_row, self._forgotten), feedback.first_row + feedback.count
        if first >= end:
            return rows
        self._check_number(first, end)
        size = ROW.itemsize
        block = memoryview(feedback.rows)[(first - feedback.first_row) * size :]
        at = first
        while at < end:
            number, place = divmod(at, PAGE_ROWS)
            upto = min(end, at - place + PAGE_ROWS)
            page = self._pages.get(number) or self._new_page(number)
            stop = place + upto - at
            page.rows[place * size : stop * size] = block[(at - first) * size : (upto - first) * size]
            # Last: a reader takes what is marked as arrived.
            before = page.arrived.count(1, place, stop)
            page.arrived[place:stop] = b"\1" * (stop - place)
            self._count += stop - place - before
            at = upto
        self._first = first if self._first is None else min(self._first, first)
        self._end = max(self._end, end)
        self._changes += 1
        return rows

    def _check_number(self, first: int, end: int) -> None:
        if self._first is not None and max(end, self._end) - min(first, self._first) > MAX_ROWS:
            raise WireError(
                Refusal.RANGE,
                f"row {first} is too far from rows {self._first} to {self._end} to be of this boot",
            )

    def _new_page(self, number: int) -> _Page:
        if (len(self._pages) - _FREE_PAGES) * PAGE_ROWS > _MIN_FILLED * self._count:
            raise WireError(
                Refusal.RANGE, f"{self._count} rows are scattered over {len(self._pages)} pages of memory"
            )
        page = self._pages[number] = _Page()
        return page

    def missing(self, first: int, end: int) -> list[tuple[int, int]]:
        """Return the ranges within rows `first` up to and without `end` that have not arrived.

        What was forgotten is not missing: see `lost`.
        """
        first = max(first, self._forgotten)
        low, high = max(first, self.first_row), min(end, self._end)
        if high <= low:
            return [(first, end)] if end > first else []
        pages = range(low // PAGE_ROWS, (high - 1) // PAGE_ROWS + 1)
        nothing = bytes(PAGE_ROWS)
        flags = b"".join(page.arrived if (page := self._pages.get(n)) else nothing for n in pages)
        offset = pages.start * PAGE_ROWS
        have = np.frombuffer(flags, np.int8)[low - offset : high - offset]
        edges = np.flatnonzero(np.diff(have, prepend=np.int8(1), append=np.int8(1))) + low
        holes = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        return _joined([(first, low), *holes, (high, end)])

    def rows(self, first: int, end: int) -> Rows:
        """Return the rows of a range that have arrived, in order, as a copy."""
        low, high = max(first, self.first_row), min(end, self._end)
        parts: list[memoryview | bytes] = []
        for number in range(low // PAGE_ROWS, (high - 1) // PAGE_ROWS + 1) if high > low else ():
            page = self._pages.get(number)
            if page is not None:
                begin = number * PAGE_ROWS
                parts.append(page.between(max(low - begin, 0), min(high - begin, PAGE_ROWS)))
        return np.frombuffer(bytearray().join(parts), ROW)

    def between(self, start_ns: int, end_ns: int) -> Rows:
        """Return the rows that have arrived of a span of module time, both ends included, as a copy."""
        index = self._times()
        numbers = index.numbers[_within(index, start_ns, end_ns)]
        if not len(numbers):
            return np.zeros(0, ROW)
        found = np.zeros(len(numbers), _RECORD)
        pages, places = np.divmod(numbers, PAGE_ROWS)
        starts = np.flatnonzero(np.diff(pages, prepend=-1))
        for begin, stop in zip(starts, [*starts[1:], len(numbers)], strict=True):
            found[begin:stop] = index.pages[int(pages[begin])].records()[places[begin:stop]]
        return found.view(ROW)

    def range_between(self, start_ns: int, end_ns: int) -> tuple[int, int]:
        """Return the row numbers, first and one past the last, of a span of module time; (0, 0) if none came.

        Rows within it that have not arrived are counted.
        """
        index = self._times()
        numbers = index.numbers[_within(index, start_ns, end_ns)]
        return (int(numbers[0]), int(numbers[-1]) + 1) if len(numbers) else (0, 0)

    def _times(self) -> _Index:
        """Return which rows have arrived and their times; searched for again when more have."""
        changes, index = self._changes, self._index
        if index.changes != changes:
            pages = dict(self._pages)
            order = sorted(pages)
            arrived = np.flatnonzero(np.frombuffer(b"".join(pages[n].arrived for n in order), bool))
            page, place = np.divmod(arrived, PAGE_ROWS)
            numbers = np.array(order, np.int64)[page] * PAGE_ROWS + place
            kept = [np.frombuffer(pages[n].rows, ROW)["t_ns"] for n in order]
            t_ns = np.concatenate(kept)[arrived] if kept else _NO_ROWS
            ascending = bool((np.diff(t_ns) >= 0).all())
            self._index = index = _Index(changes, pages, numbers, t_ns, ascending)
        return index

    def forget_before(self, row: int) -> None:
        """Drop rows below `row`, for listeners with little memory; those that come later are dropped, too."""
        if self._first is None or row <= self._first:
            return
        edge, place = divmod(row, PAGE_ROWS)
        old, last = [number for number in self._pages if number < edge], self._pages.get(edge)
        dropped = sum(self._pages[number].arrived.count(1) for number in old)
        dropped += last.arrived.count(1, 0, place) if last is not None else 0
        self._lost += min(row, self._end) - self._first - dropped
        # First: who copies the log meanwhile sees what is no longer whole.
        self._first = self._forgotten = row
        self._count -= dropped
        for number in old:
            del self._pages[number]
        if last is not None:
            last.arrived[:place] = bytes(place)
        self._changes += 1


def _within(index: _Index, start_ns: int, end_ns: int) -> slice | NDArray[np.bool_]:
    if index.ascending:
        return slice(*np.searchsorted(index.t_ns, [start_ns, end_ns + 1]))
    return (index.t_ns >= start_ns) & (index.t_ns <= end_ns)


def _joined(ranges: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return ascending ranges without empty ones, and with those that touch as one."""
    joined: list[tuple[int, int]] = []
    for first, end in ranges:
        if joined and joined[-1][1] == first and end > first:
            joined[-1] = joined[-1][0], end
        elif end > first:
            joined.append((first, end))
    return joined

"""The last minute of feedback rows, so that nothing that a network drops is lost."""

import numpy as np

from module_agent.wire.feedback_rows import ROW, Rows, pack_row
from module_agent.wire.refusal import Refusal, WireError

MAX_ROWS_PER_ANSWER = 256


class History:
    """A ring of feedback rows, numbered from 0 since boot."""

    def __init__(self, capacity: int):
        self._bytes = bytearray(capacity * ROW.itemsize)
        # The same memory: rows are written one by one as bytes and read in bulk as records.
        self._ring: Rows = np.frombuffer(self._bytes, dtype=ROW)
        self.capacity = capacity
        self.next_row = 0

    @property
    def first_row(self) -> int:
        """The oldest row still kept."""
        return max(0, self.next_row - self.capacity)

    def append(self, values: tuple[float, ...]) -> None:
        """Add one row: its values in the order of `feedback_rows.ROW`, vectors element by element."""
        pack_row(self._bytes, self.next_row % self.capacity, values)
        self.next_row += 1

    def rows(self, first: int, end: int) -> Rows:
        """Return a copy of rows `first` up to and without `end`, shape (end - first,).

        Raises:
            WireError: GONE (overwritten or not yet there), saying which rows are kept.
        """
        return np.frombuffer(self.block(first, end), dtype=ROW)

    def block(self, first: int, end: int) -> bytes:
        """Return the bytes of rows `first` up to and without `end`.

        Raises:
            WireError: GONE (overwritten or not yet there), saying which rows are kept.
        """
        if first > end or first < self.first_row or end > self.next_row:
            raise WireError(
                Refusal.GONE,
                f"rows {first} to {end} are not kept; kept are {self.first_row} to {self.next_row}",
            )
        start = first % self.capacity * ROW.itemsize
        stop = start + (end - first) * ROW.itemsize
        ring = memoryview(self._bytes)
        if stop <= len(ring):
            return bytes(ring[start:stop])
        return bytes(ring[start:]) + bytes(ring[: stop - len(ring)])

    def between(self, start_ns: int, end_ns: int) -> Rows:
        """Return a copy of the rows kept whose module time is within a span, both ends included."""
        first, end = self._row_from(start_ns), self._row_from(end_ns + 1)
        return self.rows(first, max(first, end))

    def _row_from(self, t_ns: int) -> int:
        """Return the first row kept at or after a module time; rows are in the order of their time."""
        low, high = self.first_row, self.next_row
        stamps = self._ring["t_ns"]
        while low < high:
            middle = (low + high) // 2
            if stamps[middle % self.capacity] < t_ns:
                low = middle + 1
            else:
                high = middle
        return low

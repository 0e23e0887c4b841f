"""The last minute of feedback rows, so that nothing that a network drops is lost."""

import numpy as np

from module_agent.wire.feedback_rows import ROW, Rows
from module_agent.wire.refusal import Refusal, WireError

MAX_ROWS_PER_ANSWER = 256


class History:
    """A ring of feedback rows, numbered from 0 since boot."""

    def __init__(self, capacity: int):
        self._ring = np.zeros(capacity, dtype=ROW)
        self.capacity = capacity
        self.next_row = 0

    @property
    def first_row(self) -> int:
        """The oldest row still kept."""
        return max(0, self.next_row - self.capacity)

    def append(self, row: tuple[object, ...]) -> None:
        """Add one row, in the field order of `feedback_rows.ROW`."""
        self._ring[self.next_row % self.capacity] = row
        self.next_row += 1

    def rows(self, first: int, end: int) -> Rows:
        """Return a copy of rows `first` up to and without `end`, shape (end - first,).

        Raises:
            WireError: GONE (overwritten or not yet there), saying which rows are kept.
        """
        if first > end or first < self.first_row or end > self.next_row:
            raise WireError(
                Refusal.GONE,
                f"rows {first} to {end} are not kept; kept are {self.first_row} to {self.next_row}",
            )
        start, stop = first % self.capacity, first % self.capacity + (end - first)
        if stop <= self.capacity:
            return self._ring[start:stop].copy()
        return np.concatenate((self._ring[start:], self._ring[: stop - self.capacity]))

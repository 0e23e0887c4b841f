"""Messages in order: each waits for its own time and for those before it, as on a TCP link."""

from collections import deque
from collections.abc import Callable


class OrderedFlow:
    """The messages of one key that are under way."""

    def __init__(self) -> None:
        self._queue: deque[list[object]] = deque()

    def enter(self) -> list[object]:
        """Return the place of one more message, behind all others."""
        entry: list[object] = [None]
        self._queue.append(entry)
        return entry

    def ripen(self, entry: list[object], deliver: Callable[[], None]) -> list[Callable[[], None]]:
        """Mark an entry's time as come; return what may be delivered now, in order."""
        entry[0] = deliver
        ready: list[Callable[[], None]] = []
        while self._queue and callable(first := self._queue[0][0]):
            self._queue.popleft()
            ready.append(first)
        return ready

    @property
    def is_empty(self) -> bool:
        """Whether nothing is under way."""
        return not self._queue

"""A bounded queue between a transport's threads and the cyclic executive."""

from collections import deque

from module_agent.transport.transport import Event


class Inbox:
    """Events in order of arrival. When it is full, what arrives is dropped and counted.

    `waiting` is the queue itself, true while there are events: the cheapest test in a tick.
    """

    __slots__ = ("_capacity", "dropped", "waiting")

    def __init__(self, capacity: int = 256):
        self.waiting: deque[Event] = deque()
        self._capacity = capacity
        self.dropped = 0

    def put(self, event: Event) -> None:
        """Enqueue from any thread; never blocks."""
        if len(self.waiting) >= self._capacity:
            self.dropped += 1
        else:
            self.waiting.append(event)

    def drain(self, limit: int = 64) -> list[Event]:
        """Take up to `limit` events, oldest first."""
        events: list[Event] = []
        while self.waiting and len(events) < limit:
            events.append(self.waiting.popleft())
        return events

    def __len__(self) -> int:
        return len(self.waiting)

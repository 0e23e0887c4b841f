"""The bounded queue between the threads of a transport and the one that works."""

import threading
from collections import deque
from itertools import islice

from module_agent.transport.transport import Event, Liveness, Reply

# What an event takes besides its key and payload: short messages must not be free.
EVENT_BYTES = 200
_KIB = 1024

Name = tuple[type[Event], str]


def _size(event: Event) -> int:
    payload = b"" if isinstance(event, Liveness) else event.payload
    return EVENT_BYTES + len(event.key) + len(payload or b"")


class _Lane:
    """The events of one kind on one key, numbered in the order of arrival of all."""

    __slots__ = ("bytes", "events")

    def __init__(self) -> None:
        self.events: deque[tuple[int, int, Event]] = deque()
        self.bytes = 0


class Inbox:
    """Events in order of arrival, bounded in bytes for each kind and key, so that no key pushes out another.

    A full lane drops and counts what arrives; when all together are full, the fullest gives way. Replies are
    kept always, since who asked waits for one, and are as many as the questions. A payload longer than any
    message is cut to one byte more than `longest`, and so refused as too long by its reader.

    Args:
        lane_bytes: of the events of one kind on one key.
        total_bytes: of all.
        longest: the most bytes of a payload that are read.
        bell: memory whose first element becomes 1 with every event, for those who wait for several inboxes.

    `waiting` is true while there may be events: the cheapest test in a tick.
    """

    def __init__(
        self,
        longest: int,
        lane_bytes: int = 256 * _KIB,
        total_bytes: int = 8192 * _KIB,
        bell: memoryview | None = None,
    ):
        self.waiting = False
        self._bell = memoryview(bytearray(1)) if bell is None else bell
        self.dropped = 0
        self._longest = longest
        self._lane_bytes = lane_bytes
        self._total_bytes = total_bytes
        self._lanes: dict[Name, _Lane] = {}
        self._bytes = 0
        self._number = 0
        self._lock = threading.Lock()

    def put(self, event: Event, stamp: int = 0) -> None:
        """Enqueue from any thread, with a stamp that comes out with it; never blocks for long."""
        if not isinstance(event, Liveness) and event.payload and len(event.payload) > self._longest:
            event = event._replace(payload=event.payload[: self._longest + 1])
        size = _size(event)
        name = type(event), event.key
        with self._lock:
            lane = self._lanes.get(name)
            if lane is None:
                lane = self._lanes[name] = _Lane()
            if not (isinstance(event, Reply) or self._has_room(lane, size)):
                self.dropped += 1
                return
            self._number += 1
            lane.events.append((self._number, stamp, event))
            lane.bytes += size
            self._bytes += size
        self.waiting = True
        self._bell[0] = 1

    def _has_room(self, lane: _Lane, size: int) -> bool:
        if lane.bytes + size > self._lane_bytes:
            return False
        while self._bytes + size > self._total_bytes:
            others = [each for (kind, _), each in self._lanes.items() if kind is not Reply]
            fullest = max(others, key=lambda each: each.bytes)
            if fullest.bytes <= lane.bytes + size:
                return False
            self._take(fullest, newest=True)
            self.dropped += 1
        return True

    def _take(self, lane: _Lane, newest: bool = False) -> tuple[int, int, Event]:
        item = lane.events.pop() if newest else lane.events.popleft()
        size = _size(item[2])
        lane.bytes -= size
        self._bytes -= size
        return item

    def drain_stamped(self, limit: int) -> list[tuple[int, Event]]:
        """Take at most `limit` events with their stamps in order of arrival, of every key its share."""
        # Before the look: what arrives after it sets it again.
        self.waiting = False
        taken: list[tuple[int, int, Event]] = []
        with self._lock:
            share = max(1, limit // max(1, len(self._lanes)))
            # Those that were taken from go to the end, so that many keys have their turns.
            for name in list(islice(self._lanes, limit)):
                lane = self._lanes.pop(name)
                taken += [self._take(lane) for _ in range(min(share, len(lane.events)))]
                if lane.events:
                    self._lanes[name] = lane
            if self._lanes:
                self.waiting = True
        taken.sort(key=lambda item: item[0])
        return [(stamp, event) for _, stamp, event in taken]

    def drain(self, limit: int = 64) -> list[Event]:
        """Take at most `limit` events in order of arrival, of every key its share."""
        return [event for _, event in self.drain_stamped(limit)]

    def __len__(self) -> int:
        with self._lock:
            return sum(len(lane.events) for lane in self._lanes.values())

"""The bounded queue between the threads of a transport and the one that works."""

import threading
from collections import deque
from itertools import islice

from module_agent.transport.transport import Event, Liveness, Reply

# What an event takes besides its key and payload, and what a key takes besides its events: neither short
# messages nor many keys must be free. Measured with Python 3.11: 190 and 880 bytes.
EVENT_BYTES = 200
LANE_BYTES = 1024
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

    A full lane drops and counts what arrives; when all together are full, the fullest gives way. A key has a
    lane while events wait in it, and the lane counts too, so that invented keys cannot fill the memory.
    Replies are kept always, since who asked waits for one, and are as many as the questions. A payload longer
    than any message is cut to one byte more than `longest`, and so refused as too long by its reader.

    Args:
        lane_bytes: of the events of one kind on one key.
        total_bytes: of all, with `LANE_BYTES` for each lane.
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
        self._count = 0
        # No lane but those of replies has more: what no lane gives way to is refused without a search.
        self._fullest_bytes = 0
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
            is_reply = isinstance(event, Reply)
            if not (is_reply or self._has_room(lane, size)):
                self.dropped += 1
                return
            if lane is None:
                lane = self._add(name, _Lane())
            self._number += 1
            self._count += 1
            lane.events.append((self._number, stamp, event))
            lane.bytes += size
            self._bytes += size
            if not is_reply:
                self._fullest_bytes = max(self._fullest_bytes, lane.bytes)
        self.waiting = True
        self._bell[0] = 1

    def _has_room(self, lane: _Lane | None, size: int) -> bool:
        """Return whether an event can be added to a lane, None for a new one; the fullest gives way to it."""
        filled = size + (lane.bytes if lane else 0)
        if filled > self._lane_bytes:
            return False
        free = self._total_bytes - size - (0 if lane else LANE_BYTES)
        while self._bytes > free:
            if self._fullest_bytes <= filled:
                return False
            others = {name: each for name, each in self._lanes.items() if name[0] is not Reply}
            fullest = max(others, key=lambda name: others[name].bytes, default=None)
            if fullest is not None:
                self._give_way(fullest, filled, free)
            self._fullest_bytes = max((each.bytes for each in others.values()), default=0)
        return True

    def _give_way(self, name: Name, filled: int, free: int) -> None:
        """Drop the newest of a lane until all have `free` bytes at most, or it no more than `filled`."""
        lane = self._lanes[name]
        while self._bytes > free and lane.bytes > filled:
            self._take(lane, newest=True)
            self.dropped += 1
        if not lane.events:
            self._remove(name)

    def _add(self, name: Name, lane: _Lane) -> _Lane:
        self._lanes[name] = lane
        self._bytes += LANE_BYTES
        return lane

    def _remove(self, name: Name) -> None:
        del self._lanes[name]
        self._bytes -= LANE_BYTES

    def _take(self, lane: _Lane, newest: bool = False) -> tuple[int, int, Event]:
        item = lane.events.pop() if newest else lane.events.popleft()
        size = _size(item[2])
        lane.bytes -= size
        self._bytes -= size
        self._count -= 1
        return item

    def drain_stamped(self, limit: int) -> list[tuple[int, Event]]:
        """Take at most `limit` events with their stamps in order of arrival, of every key its share."""
        # Before the look: what arrives after it sets it again.
        self.waiting = False
        taken: list[tuple[int, int, Event]] = []
        with self._lock:
            if self._count <= limit:
                # Nearly always: all of them.
                taken = [item for lane in self._lanes.values() for item in lane.events]
                self._lanes.clear()
                self._bytes = self._count = 0
            share = max(1, limit // max(1, len(self._lanes)))
            # Those that were taken from go to the end, so that many keys have their turns.
            for name in list(islice(self._lanes, limit)):
                lane = self._lanes[name]
                taken += [self._take(lane) for _ in range(min(share, len(lane.events)))]
                self._remove(name)
                if lane.events:
                    self._add(name, lane)
            if self._lanes:
                self.waiting = True
        taken.sort(key=lambda item: item[0])
        return [(stamp, event) for _, stamp, event in taken]

    def drain(self, limit: int = 64) -> list[Event]:
        """Take at most `limit` events in order of arrival, of every key its share."""
        return [event for _, event in self.drain_stamped(limit)]

    @property
    def lanes(self) -> int:
        """How many kinds of events on keys are waiting."""
        with self._lock:
            return len(self._lanes)

    def __len__(self) -> int:
        with self._lock:
            return self._count

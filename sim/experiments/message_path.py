"""One direction of a network for messages that keep their order, asked tick by tick."""

import heapq
from typing import Generic, TypeVar

import numpy as np

from module_agent.wire.channel import Channel
from module_agent.wire.network_profile import PathProfile

T = TypeVar("T")


class MessagePath(Generic[T]):
    """What is sent comes out late, twice or not at all, as a path's profile has it (see `PathProfile`)."""

    def __init__(self, path: PathProfile, rng: np.random.Generator):
        self._channel = Channel(path, rng)
        self._under_way: list[tuple[int, int, T]] = []
        self._count = 0
        self._newest_ns = 0

    def send(self, t_ns: int, message: T) -> None:
        """Send a message; times must not decrease."""
        fate = self._channel.fate(t_ns * 1e-9)
        if fate.lost:
            return
        at_ns = t_ns + round(fate.delay_s * 1e9)
        if not fate.reordered:
            # It waits for all that was sent before it, as on one connection.
            at_ns = self._newest_ns = max(self._newest_ns, at_ns)
        self._put(at_ns, message)
        if fate.copy_delay_s is not None:
            self._put(t_ns + round(fate.copy_delay_s * 1e9), message)

    def arrived(self, t_ns: int) -> list[T]:
        """Return what has come since the last call, in the order in which it came."""
        found = []
        while self._under_way and self._under_way[0][0] <= t_ns:
            found.append(heapq.heappop(self._under_way)[2])
        return found

    def _put(self, at_ns: int, message: T) -> None:
        # The count keeps messages that come at the same time in order, and from being compared themselves.
        self._count += 1
        heapq.heappush(self._under_way, (at_ns, self._count, message))

"""IP packets between hosts under a network profile: delayed, lost, stalled, reordered or duplicated."""

import heapq
import itertools
from collections.abc import Sequence
from ipaddress import IPv4Address
from typing import NamedTuple

import numpy as np

from module_agent.network_emulation.channel import Channel
from module_agent.network_emulation.profile import NetworkProfile

_COORDINATOR = 0
_IPV4 = 4
_DESTINATION = slice(16, 20)
_MIN_HEADER_BYTES = 20


class LinkCounts(NamedTuple):
    """The counts of packets of one direction; `delay_s` is the sum over those that were forwarded."""

    taken: int = 0
    lost: int = 0
    sent: int = 0
    reordered: int = 0
    delay_s: float = 0.0


class _Link:
    """One direction between two hosts."""

    def __init__(self, channel: Channel):
        self.channel = channel
        self.last_due_s = 0.0
        self.counts = LinkCounts()


class PacketSwitch:
    """Takes packets from hosts and forwards them at the times that the profile gives.

    The first host is the coordinator's, the others are modules'. Every direction between two hosts is a
    separate link, with the profile's path to its receiver and separate draws, as if every module had a radio.
    Packets of a link keep their order but for the fraction `reorder`. In the profile's partitions nothing
    passes to or from the coordinator.
    Packets with another destination are dropped without a count, as are those that are not IPv4.
    """

    def __init__(self, hosts: Sequence[IPv4Address], profile: NetworkProfile, seed: int):
        self._host_of = {address.packed: index for index, address in enumerate(hosts)}
        self._partitions = profile.partitions
        pairs = [(a, b) for a in range(len(hosts)) for b in range(len(hosts)) if a != b]
        seeds = np.random.SeedSequence(seed).spawn(len(pairs))
        paths = profile.path("module"), profile.path("coordinator")
        self._links = {
            pair: _Link(Channel(paths[pair[1] == _COORDINATOR], np.random.default_rng(each)))
            for pair, each in zip(pairs, seeds, strict=True)
        }
        self._heap: list[tuple[float, int, int, bytes]] = []
        self._numbers = itertools.count()

    @property
    def next_s(self) -> float | None:
        """When the next packet is due, None if none is under way."""
        return self._heap[0][0] if self._heap else None

    @property
    def counts(self) -> dict[tuple[int, int], LinkCounts]:
        """The counts of packets so far, by the indices of the sending and the receiving host."""
        return {pair: link.counts for pair, link in self._links.items()}

    def take(self, t_s: float, source: int, packet: bytes) -> None:
        """Take a packet from a host at a time from the start [s], never decreasing."""
        if len(packet) < _MIN_HEADER_BYTES or packet[0] >> 4 != _IPV4:
            return
        destination = self._host_of.get(packet[_DESTINATION])
        if destination is None or destination == source:
            return
        link = self._links[source, destination]
        fate = link.channel.fate(t_s)
        counts = link.counts._replace(taken=link.counts.taken + 1)
        if fate.lost or (_COORDINATOR in (source, destination) and self._is_parted(t_s)):
            link.counts = counts._replace(lost=counts.lost + 1)
            return
        due_s = t_s + fate.delay_s
        if not fate.reordered:
            due_s = link.last_due_s = max(due_s, link.last_due_s)
        link.counts = counts._replace(
            sent=counts.sent + 1,
            reordered=counts.reordered + fate.reordered,
            delay_s=counts.delay_s + due_s - t_s,
        )
        self._push(due_s, destination, packet)
        if fate.copy_delay_s is not None:
            self._push(max(due_s, t_s + fate.copy_delay_s), destination, packet)

    def due(self, t_s: float) -> list[tuple[int, bytes]]:
        """Return the packets whose time has come, in its order, each with its destination."""
        ready = []
        while self._heap and self._heap[0][0] <= t_s:
            _, _, destination, packet = heapq.heappop(self._heap)
            ready.append((destination, packet))
        return ready

    def _is_parted(self, t_s: float) -> bool:
        return any(start_s <= t_s < end_s for start_s, end_s in self._partitions)

    def _push(self, due_s: float, destination: int, packet: bytes) -> None:
        heapq.heappush(self._heap, (due_s, next(self._numbers), destination, packet))

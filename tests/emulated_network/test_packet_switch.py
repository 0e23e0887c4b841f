"""What the link emulator does to packets, without any packets of the machine's."""

from ipaddress import IPv4Address
from itertools import pairwise

import numpy as np
import pytest

from module_agent.model.errors import UsageError
from module_agent.network_emulation.profile import PROFILES, NetworkProfile, PathProfile
from tests.emulated_network.link_emulator import counts_by_address, host
from tests.emulated_network.packet_switch import PacketSwitch

HOSTS = [IPv4Address(f"10.77.0.{i}") for i in (1, 2, 3)]
HUB, ONE, TWO = range(3)


def packet(source: int, destination: IPv4Address, body: bytes = b"") -> bytes:
    head = bytearray(20)
    head[0] = 0x45
    head[12:16], head[16:20] = HOSTS[source].packed, destination.packed
    return bytes(head) + body


def passed(switch: PacketSwitch) -> list[tuple[float, int, bytes]]:
    found = []
    while (t_s := switch.next_s) is not None:
        found += [(t_s, destination, each[20:]) for destination, each in switch.due(t_s)]
    return found


def test_a_packet_goes_to_the_host_that_it_is_for_and_nowhere_else() -> None:
    switch = PacketSwitch(HOSTS, PROFILES["none"], 0)
    switch.take(1.0, HUB, packet(HUB, HOSTS[TWO], b"a"))
    switch.take(1.0, TWO, packet(TWO, HOSTS[ONE], b"b"))
    assert passed(switch) == [(1.0, TWO, b"a"), (1.0, ONE, b"b")]


def test_what_is_for_nobody_or_is_no_ipv4_is_dropped() -> None:
    switch = PacketSwitch(HOSTS, PROFILES["none"], 0)
    multicast_v6 = b"\x60" + bytes(39)
    for each in (packet(HUB, IPv4Address("10.77.0.9")), packet(HUB, HOSTS[HUB]), multicast_v6, b"", b"\x45"):
        switch.take(1.0, HUB, each)
    assert passed(switch) == []
    assert all(counts.taken == 0 for counts in switch.counts.values())


def test_the_way_to_the_coordinator_is_another_than_the_way_to_modules() -> None:
    found = NetworkProfile(
        name="t", to_modules=PathProfile(delay_ms=2.0), to_coordinator=PathProfile(delay_ms=7.0)
    )
    switch = PacketSwitch(HOSTS, found, 0)
    switch.take(0.0, HUB, packet(HUB, HOSTS[ONE], b"down"))
    switch.take(0.0, ONE, packet(ONE, HOSTS[TWO], b"across"))
    switch.take(0.0, ONE, packet(ONE, HOSTS[HUB], b"up"))
    assert passed(switch) == [(0.002, ONE, b"down"), (0.002, TWO, b"across"), (0.007, HUB, b"up")]


def test_packets_of_a_link_are_late_lost_and_in_order_as_the_profile_says_and_counted() -> None:
    number = 5000
    found = NetworkProfile(name="t", delay_ms=2.0, jitter_ms=4.0, loss=0.1)
    switch = PacketSwitch(HOSTS, found, 3)
    for i in range(number):
        switch.take(1e-3 * i, ONE, packet(ONE, HOSTS[HUB], i.to_bytes(4, "big")))
    arrivals = [(t_s, int.from_bytes(body, "big")) for t_s, _, body in passed(switch)]
    counts = switch.counts[ONE, HUB]
    assert (counts.taken, counts.sent) == (number, len(arrivals))
    assert counts.lost == number - counts.sent
    assert abs(counts.lost / number - 0.1) < 5 * np.sqrt(0.1 * 0.9 / number)
    assert [i for _, i in arrivals] == sorted(i for _, i in arrivals)
    delays_s = [t_s - 1e-3 * i for t_s, i in arrivals]
    assert min(delays_s) >= 2e-3 - 1e-9
    assert counts.delay_s == pytest.approx(sum(delays_s))
    # Waiting for those before it makes it longer than the mean of base and jitter alone.
    assert counts.delay_s / counts.sent > 6e-3


def test_the_fraction_to_be_reordered_overtakes_and_duplicates_come_behind() -> None:
    found = NetworkProfile(name="t", jitter_ms=10.0, reorder=0.3, duplicate=0.2)
    switch = PacketSwitch(HOSTS, found, 4)
    for i in range(1000):
        switch.take(1e-3 * i, ONE, packet(ONE, HOSTS[TWO], i.to_bytes(4, "big")))
    order = [int.from_bytes(body, "big") for _, _, body in passed(switch)]
    assert set(order) == set(range(1000))
    assert any(b < a for a, b in pairwise(order))
    assert 100 < len(order) - 1000 < 300
    assert 200 < switch.counts[ONE, TWO].reordered < 400


def test_in_a_partition_nothing_passes_to_or_from_the_coordinator() -> None:
    switch = PacketSwitch(HOSTS, NetworkProfile(name="t", partitions=((1.0, 2.0),)), 0)
    for t_s in (0.5, 1.0, 1.5, 2.0):
        switch.take(t_s, ONE, packet(ONE, HOSTS[HUB]))
        switch.take(t_s, HUB, packet(HUB, HOSTS[TWO]))
        switch.take(t_s, ONE, packet(ONE, HOSTS[TWO], b"across"))
    assert [(t_s, to) for t_s, to, body in passed(switch) if not body] == [
        (0.5, HUB),
        (0.5, TWO),
        (2.0, HUB),
        (2.0, TWO),
    ]
    assert switch.counts[ONE, TWO].lost == 0


def test_links_have_draws_of_their_own_and_the_seed_decides_them() -> None:
    def arrivals(seed: int) -> dict[int, list[float]]:
        switch = PacketSwitch(HOSTS, PROFILES["wifi"], seed)
        found: dict[int, list[float]] = {ONE: [], TWO: []}
        for source in (ONE, TWO):
            for i in range(100):
                switch.take(1e-2 * i, source, packet(source, HOSTS[HUB], bytes([source])))
        for t_s, _, body in passed(switch):
            found[body[0]].append(t_s)
        return found

    assert arrivals(1) == arrivals(1)
    assert arrivals(1) != arrivals(2)
    assert arrivals(1)[ONE] != arrivals(1)[TWO]


def test_counts_are_told_by_the_addresses() -> None:
    switch = PacketSwitch(HOSTS[:2], PROFILES["none"], 0)
    switch.take(0.0, ONE, packet(ONE, HOSTS[HUB]))
    told = counts_by_address(switch.counts, HOSTS)
    assert set(told) == {"10.77.0.1 > 10.77.0.2", "10.77.0.2 > 10.77.0.1"}
    assert told["10.77.0.2 > 10.77.0.1"] == {"taken": 1, "lost": 0, "sent": 1, "reordered": 0, "delay_s": 0.0}


def test_a_host_is_a_namespace_and_an_address_with_its_network() -> None:
    found = host("/proc/4711/ns/net=10.77.0.1/24")
    assert str(found.namespace) == "/proc/4711/ns/net"
    assert str(found.interface) == "10.77.0.1/24"
    for wrong in ("10.77.0.1", "/proc/1/ns/net=here"):
        with pytest.raises(UsageError, match=r"it must look like /proc/4711/ns/net=10\.77\.0\.1/24"):
            host(wrong)

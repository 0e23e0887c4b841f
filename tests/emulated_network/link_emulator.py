"""`python -m tests.emulated_network.link_emulator`: a network in user space between network namespaces.

Every host is a namespace with a TUN interface. Its packets are read here and written to their destination
with the delay, loss and reordering of the profile. So TCP itself is impaired, and no queueing discipline of
the kernel is needed.
"""

import argparse
import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from ipaddress import IPv4Address, IPv4Interface
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from module_agent.model.errors import EXIT_LOST, EXIT_USAGE, RobotError, UsageError
from module_agent.network_emulation.profile_file import network as network_named
from tests.emulated_network.interfaces import open_tun
from tests.emulated_network.packet_switch import LinkCounts, PacketSwitch

# Printed when packets pass.
UP = "the links are up"
_MAX_PACKET_BYTES = 65_535
# How often the loop checks whether it has been ended.
_POLL_S = 0.1


class Host(NamedTuple):
    """A namespace's file, and the address and network of the interface that it gets."""

    namespace: Path
    interface: IPv4Interface


def host(text: str) -> Host:
    """Read a host as it is given on the command line, such as `/proc/4711/ns/net=10.77.0.1/24`.

    Raises:
        UsageError: the text has another form; the message shows an example.
    """
    namespace, _, address = text.rpartition("=")
    try:
        interface = IPv4Interface(address)
    except ValueError:
        namespace = ""
    if not namespace:
        raise UsageError(f"host {text!r}: it must look like /proc/4711/ns/net=10.77.0.1/24")
    return Host(Path(namespace), interface)


def forward(tuns: Sequence[int], switch: PacketSwitch, ended: Callable[[], bool]) -> None:
    """Pass packets between the hosts' descriptors until it is ended.

    Raises:
        OSError: the interface of a host has been closed.
    """
    index_of = {tun: index for index, tun in enumerate(tuns)}
    start_s = time.monotonic()
    while not ended():
        now_s = time.monotonic() - start_s
        for destination, packet in switch.due(now_s):
            with suppress(BlockingIOError):  # a full queue drops, as any link's does
                os.write(tuns[destination], packet)
        wait_s = _POLL_S if switch.next_s is None else min(_POLL_S, max(0.0, switch.next_s - now_s))
        readable, _, _ = select.select(tuns, (), (), wait_s)
        now_s = time.monotonic() - start_s
        for tun in readable:
            with suppress(BlockingIOError):
                switch.take(now_s, index_of[tun], os.read(tun, _MAX_PACKET_BYTES))


def counts_by_address(
    counts: dict[tuple[int, int], LinkCounts], addresses: Sequence[IPv4Address]
) -> dict[str, dict[str, float]]:
    """Return the counts of every direction, called `FROM > TO`, ready for JSON."""
    return {f"{addresses[a]} > {addresses[b]}": each._asdict() for (a, b), each in counts.items()}


def main() -> int:
    """Connect network namespaces by links that delay and lose packets, until a signal arrives."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.emulated_network.link_emulator", description=main.__doc__
    )
    parser.add_argument(
        "hosts", nargs="+", metavar="NAMESPACE=ADDRESS/PREFIX", help="Hosts, the coordinator's first."
    )
    parser.add_argument("--network", required=True, help="Network profile, or a TOML file.")
    parser.add_argument("--seed", type=int, default=0, help="Seed of the network.")
    parser.add_argument("--counts", type=Path, help="JSON file for the counts of packets.")
    asked = parser.parse_args()
    ended: list[int] = []

    def end(number: int, _frame: FrameType | None) -> None:
        ended.append(number)

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    try:
        hosts = [host(text) for text in asked.hosts]
        addresses = [each.interface.ip for each in hosts]
        switch = PacketSwitch(addresses, network_named(asked.network), asked.seed)
        tuns = [open_tun(*each) for each in hosts]
    except (RobotError, OSError) as error:
        print(f"link emulator: {error}", file=sys.stderr)
        return EXIT_USAGE
    print(UP, file=sys.stderr, flush=True)
    try:
        forward(tuns, switch, lambda: bool(ended))
    except OSError as error:
        print(f"link emulator: the interface of a host has been closed: {error}", file=sys.stderr)
        return EXIT_LOST
    finally:
        if asked.counts is not None:
            asked.counts.write_text(json.dumps(counts_by_address(switch.counts, addresses), indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Network namespaces and the way into them; skipped where the machine does not allow any."""

import os
import select
import subprocess
import sys
from collections.abc import Iterator
from ipaddress import IPv4Interface
from pathlib import Path

import pytest

from tests.emulated_network.interfaces import INTERFACE, NamespaceError, open_tun
from tests.emulated_network.network_namespace import NetworkNamespace

ADDRESS = IPv4Interface("10.77.0.1/24")
SEND = "import socket; socket.socket(type=socket.SOCK_DGRAM).sendto(b'hello', ('10.77.0.2', 9))"


@pytest.fixture
def namespace() -> Iterator[NetworkNamespace]:
    try:
        made = NetworkNamespace()
    except NamespaceError as reason:
        pytest.skip(f"this machine makes no network namespaces: {reason}")
    yield made
    made.close()


def tun_of(namespace: NetworkNamespace) -> int:
    try:
        return open_tun(namespace.path, ADDRESS)
    except NamespaceError as reason:
        pytest.skip(f"this machine makes no TUN interfaces: {reason}")


def within(namespace: NetworkNamespace, *words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([*namespace.prefix, *words], capture_output=True, text=True, check=True, timeout=30)


def test_a_namespace_has_no_connection_and_ends_with_its_holder(namespace: NetworkNamespace) -> None:
    assert os.readlink(namespace.path) != os.readlink("/proc/self/ns/net")
    shown = within(namespace, "ip", "-brief", "link").stdout.splitlines()
    assert [line.split()[0] for line in shown] == ["lo"]
    assert within(namespace, "ip", "route").stdout == ""
    namespace.close()
    namespace.close()
    assert not Path(f"/proc/{namespace.pid}").exists()


def test_what_is_sent_in_the_namespace_is_read_outside_of_it(namespace: NetworkNamespace) -> None:
    own = os.readlink("/proc/self/ns/net")
    tun = tun_of(namespace)
    assert os.readlink("/proc/self/ns/net") == own
    assert INTERFACE in within(namespace, "ip", "-brief", "link").stdout
    within(namespace, sys.executable, "-c", SEND)
    packets = []
    while select.select([tun], (), (), 1.0 if not packets else 0.0)[0]:
        packets.append(os.read(tun, 65_535))
    # The kernel itself sends as well, to find IPv6 neighbours.
    (said,) = [packet for packet in packets if packet[0] >> 4 == 4]
    assert said[12:16] == ADDRESS.ip.packed
    assert said[28:] == b"hello"
    os.close(tun)
    assert INTERFACE not in within(namespace, "ip", "-brief", "link").stdout


def test_missing_tools_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(NamespaceError, match="not installed: ip, nsenter, unshare"):
        NetworkNamespace()


def test_a_namespace_that_is_not_there_gets_no_interface(tmp_path: Path) -> None:
    with pytest.raises(NamespaceError, match=r"no TUN interface: .*No such file"):
        open_tun(tmp_path / "net", ADDRESS)


def test_a_namespace_has_one_interface_at_a_time(namespace: NetworkNamespace) -> None:
    tun = tun_of(namespace)
    with pytest.raises(NamespaceError, match=r"no TUN interface: .*busy"):
        open_tun(namespace.path, ADDRESS)
    os.close(tun)

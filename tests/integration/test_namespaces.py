"""The demo over hosts of their own: network namespaces, and links between them that lose packets."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from ipaddress import IPv4Interface
from pathlib import Path
from typing import NamedTuple

import pytest

from coordinator.recording.run_folder import load_recording
from sim.processes.launcher import Child, LaunchConfig, Launcher, stop_child
from sim.robot.robot_file import load_robot
from sim.scoring.score import score
from tests.emulated_network.interfaces import NamespaceError, open_tun
from tests.emulated_network.link_emulator import UP
from tests.emulated_network.network_namespace import NetworkNamespace

ROBOT = "thesis_245_horizontal"
HUB = "10.77.0.1"
PORT = 7447
# An uplink as of a busy radio: six milliseconds longer than the way down, and losing in bursts.
NETWORK = """
delay_ms = 2.0
jitter_ms = 0.5
loss = 0.005

[to_coordinator]
delay_ms = 8.0
jitter_ms = 1.5
loss_burst = { apart_s = 1.0, mean_ms = 10.0, loss = 0.5 }
"""
DOWN_S, UP_S = 2e-3, 8e-3


class Hosts(NamedTuple):
    """The coordinator's namespace, one for every module, and the network between them."""

    namespaces: tuple[NetworkNamespace, ...]
    addresses: tuple[str, ...]
    emulator: Child
    counts: Path

    def retransmitted(self, host: int) -> int:
        """How many segments the TCP of a host has sent again so far."""
        lines = Path(f"/proc/{self.namespaces[host].pid}/net/snmp").read_text().splitlines()
        names, values = (line.split() for line in lines if line.startswith("Tcp:"))
        return int(values[names.index("RetransSegs")])


@pytest.fixture
def hosts(tmp_path: Path, programs) -> Iterator[Hosts]:
    serials = load_robot(ROBOT).serials
    addresses = tuple(f"10.77.0.{i + 1}" for i in range(1 + len(serials)))
    network, counts, log = tmp_path / "network.toml", tmp_path / "counts.json", tmp_path / "emulator.log"
    network.write_text(NETWORK)
    with ExitStack() as opened:
        try:
            namespaces = tuple(opened.enter_context(NetworkNamespace()) for _ in addresses)
        except NamespaceError as reason:
            pytest.skip(f"this machine makes no network namespaces: {reason}")
        try:
            os.close(open_tun(namespaces[0].path, IPv4Interface(f"{HUB}/24")))
        except NamespaceError as reason:
            pytest.skip(f"this machine makes no TUN interfaces: {reason}")
        named = [f"{space.path}={at}/24" for space, at in zip(namespaces, addresses, strict=True)]
        options = ("--network", str(network), "--seed", "5", "--counts", str(counts))
        with open(log, "wb") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "tests.emulated_network.link_emulator", *named, *options],
                stdout=output,
                stderr=output,
            )
        emulator = Child("link emulator", process, log)
        opened.callback(stop_child, emulator)
        programs.until(lambda: UP in programs.words(emulator), "the links", emulator)
        yield Hosts(namespaces, addresses, emulator, counts)


def test_a_robot_whose_modules_are_hosts_of_their_own_recognises_itself_over_links_that_lose(
    hosts: Hosts, programs, plan: Path, tmp_path: Path
) -> None:
    serials = load_robot(ROBOT).serials
    prefix_of = {"coordinator": hosts.namespaces[0].prefix} | {
        f"agent {serial}": space.prefix for serial, space in zip(serials, hosts.namespaces[1:], strict=True)
    }
    config = LaunchConfig(
        robot_file=ROBOT,
        robot_name=ROBOT,
        serials=serials,
        out=tmp_path / "run",
        network="none",
        endpoint=f"tcp/{HUB}:{PORT}",
        # As in the other tests, for a busy machine; and a segment lost twice waits for TCP's timer of 0.2 s.
        agent_options=("--lifetime-ms", "800"),
        coordinator_options=("--plan", str(plan), "--no-dynamics", "--no-report"),
        # The world is on no network: its bus is a socket in the file system, which all hosts share.
        within=lambda process: prefix_of.get(process, ()),
    )
    with Launcher(config, lambda text: None) as launcher:
        launcher.start_world()
        launcher.start_agents()
        coordinator = launcher.start_coordinator(quiet=True)
        code, said = programs.ended(coordinator)
        assert code == 0, said
    again = [hosts.retransmitted(host) for host in range(len(hosts.namespaces))]
    stop_child(hosts.emulator)
    assert hosts.emulator.process.returncode == 0, programs.words(hosts.emulator)

    found = score(config.out)
    assert found.topology_correct
    # The bound of the other tests over real processes.
    assert abs(found.links[0].link_length_error_mm) <= 0.05 * found.links[0].link_length_true_mm

    counts = json.loads(hosts.counts.read_text())
    for address in hosts.addresses[1:]:
        up, down = counts[f"{address} > {HUB}"], counts[f"{HUB} > {address}"]
        # 13 s at 50 messages a second and module, not all in packets of their own, and acknowledgements.
        assert min(up["sent"], down["sent"]) > 200
        assert up["delay_s"] / up["sent"] >= UP_S
        assert DOWN_S <= down["delay_s"] / down["sent"] < UP_S
        # At least 0.5 % of more than a thousand packets; which of them is decided by the seed.
        assert up["lost"] > 0
    # Between modules nobody sends: all goes through the hub.
    assert counts[f"{hosts.addresses[1]} > {hosts.addresses[2]}"]["taken"] == 0
    # It was TCP that had to mend it.
    assert sum(again[1:]) > 0

    for module in load_recording(config.out / "session.mcap").modules.values():
        trips_s = [1e-9 * (trip.received_ns - trip.sent_ns) for trip in module.round_trips]
        assert len(trips_s) > 20
        assert min(trips_s) >= DOWN_S + UP_S

"""What `x5-agent` says when it cannot work; only a hub that is not there yet is waited for."""

import ctypes
import io
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from module_agent import main as agent_program
from module_agent.hardware import hebi_network
from module_agent.hardware.hardware import HardwareLost
from module_agent.main import app
from module_agent.model.errors import EXIT_LOST, UsageError
from module_agent.network_emulation.impaired_transport import ImpairedTransport, inject
from module_agent.network_emulation.profile import PROFILES, NetworkProfile, PathProfile
from module_agent.transport.endpoint import check_endpoint
from module_agent.worker import ThreadWorker
from sim.hebi_stand_in import on_bus
from sim.robot.robot_file import load_robot
from sim.world.bus_server import BusServer
from sim.world.world import World


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--network", "pigeons"), "known are none, lan, lossy, wifi, bad, asymmetric"),
        (("--robot", "a/b"), "robot 'a/b' cannot be part of a key"),
        (("--expiry", "later"), "it must be motor_off, hold or damping"),
        (("--seed", "-1"), "greater than or equal to 0"),
        (("--lifetime-ms", "5000"), "less than or equal to 1000"),
        (("--feedback-rate", "0"), "greater than or equal to 1"),
        (("--connect", "nonsense"), "endpoint 'nonsense': it must look like tcp/127.0.0.1:7447"),
        (("--connect", "tcp/127.0.0.1"), "an address of tcp is HOST:PORT"),
        (("--connect", "carrier/pigeon:1"), "unknown protocol 'carrier'"),
        (("--listen", "tcp/127.0.0.1:99999"), "with a port of 1 to 65535"),
        (("--safety", "none.toml"), "none.toml: cannot be read"),
    ],
)
def test_wrong_usage_is_answered_at_once_with_what_is_right(arguments: tuple[str, ...], message: str) -> None:
    done = CliRunner().invoke(app, ["--serial", "A-1", "--bus", "no-bus", *arguments])
    assert done.exit_code == 2, done.output
    assert message in done.output


STAND_IN = ("--hebi", "--library", "sim.hebi_stand_in.on_bus")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "give --serial and --bus for simulated modules, or --hebi for real ones"),
        ((*STAND_IN, "--expiry", "damping"), "it must be motor_off or hold with --hebi"),
        (STAND_IN, "the environment has no X5_STAND_IN_BUS and no X5_STAND_IN_SERIALS"),
        ((*STAND_IN, "--list"), "the environment has no X5_STAND_IN_BUS"),
        (
            (*STAND_IN, "--serial", "A"),
            "--serial chooses simulated modules; real ones are chosen by --family",
        ),
        ((*STAND_IN, "--bus", "runs/bus"), "--bus chooses simulated modules"),
        (("--list",), "--list chooses real modules: add --hebi"),
        (
            ("--serial", "A", "--bus", "b", "--family", "Arm", "--rate", "500"),
            "--family, --rate chooses real",
        ),
        (("--serial", "A", "--bus", "b", "--name", "elbow"), "--name chooses real modules: add --hebi"),
        (("--hebi", "--library", "no_such_library"), "pip install --no-deps hebi-py==2"),
    ],
)
def test_real_modules_that_cannot_be_run_are_refused_at_once(
    arguments: tuple[str, ...], message: str
) -> None:
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 2, done.output
    assert message in " ".join(done.output.split())


def test_modules_on_hebis_network_are_listed_by_family_and_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(load_robot("thesis_171_vertical"), seed=1, noise="ideal")
    server, ended = BusServer(str(tmp_path / "bus"), world, bound_s=20.0), threading.Event()
    thread = threading.Thread(target=server.run, args=(None, ended.is_set))
    thread.start()
    monkeypatch.setenv(on_bus.BUS, str(tmp_path / "bus"))
    monkeypatch.setenv(on_bus.SERIALS, "X-00009,X-00010")
    monkeypatch.setattr(hebi_network, "LOOKUP_S", 0.0)
    try:
        done = CliRunner().invoke(app, (*STAND_IN, "--list"))
    finally:
        ended.set()
        thread.join(20.0)
        world.close()
    assert done.exit_code == 0, done.output
    rows = [line.split() for line in done.output.splitlines()]
    assert rows[0] == ["family", "name", "serial", "type", "firmware", "address"]
    assert [row[:4] for row in rows[1:]] == [
        ["simulated", module.serial, module.serial, module.module_type] for module in world.modules
    ]


def test_modules_that_do_not_answer_at_the_start_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(options: object, note: object) -> None:
        raise HardwareLost("a module does not tell its settings within 1000 ms")

    monkeypatch.setattr("module_agent.main.open_modules", silent)
    done = CliRunner().invoke(app, ["--hebi", "--family", "arm"])
    assert done.exit_code == EXIT_LOST
    assert "does not tell its settings" in done.output


def test_a_port_that_somebody_else_has_is_named_and_not_waited_for() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        done = CliRunner().invoke(app, ["--serial", "A-1", "--bus", "no-bus", "--listen", endpoint])
    assert done.exit_code == 2
    assert f"cannot listen on {endpoint}: the address is in use" in done.output


def test_an_agent_waits_for_its_hub_until_it_is_told_to_stop(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        unused = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    command = [sys.executable, "-m", "module_agent.main", "--serial", "A-1", "--bus", str(tmp_path / "bus")]
    with subprocess.Popen([*command, "--connect", unused], stderr=subprocess.PIPE, text=True) as agent:
        assert agent.stderr is not None
        assert f"waiting for the network: no hub answers on {unused}" in agent.stderr.readline()
        agent.send_signal(signal.SIGTERM)
        assert agent.wait(30.0) == 0
        assert agent.stderr.read() == ""


def test_a_signal_that_comes_while_machine_code_is_loaded_ends_the_agent_after_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is raised in a callback from C to Python, as the compiler has, is lost."""
    lost: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", lost.append)
    signals = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    before = {number: signal.getsignal(number) for number in signals}
    loaded: list[bool] = []
    closed: list[str] = []

    class Host:
        def __init__(self, *_: object) -> None:
            ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), signal.SIGTERM))()
            loaded.append(True)

    modules = SimpleNamespace(information=(), close=lambda: closed.append("modules"))
    transport: Any = SimpleNamespace(close=lambda: closed.append("transport"))
    monkeypatch.setattr("module_agent.host.AgentHost", Host)
    monkeypatch.setattr(agent_program, "BusClient", lambda *_: None)
    monkeypatch.setattr(agent_program, "LoopInside", lambda *_: modules)
    for target, name in ((agent_program, "leave_out_imports"), (sys, "setswitchinterval")):
        monkeypatch.setattr(target, name, lambda *_: None)

    try:
        with pytest.raises(agent_program.Stopped) as stopped:
            agent_program._run("arm", agent_program._OnBus("bus", ("A",), {}), lambda _: transport, {})
        assert {signal.getsignal(number) for number in signals} == {signal.SIG_IGN}
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert loaded
    assert stopped.value.code == 0
    assert not lost
    # The world waits for nobody who has gone.
    assert closed == ["modules", "transport"]


@pytest.mark.parametrize(
    "good",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tls/robot.example:443#root_ca=a.pem",
        "udp/0.0.0.0:1?rel=0",
        "unixsock-stream/tmp/robot.sock",
    ],
)
def test_what_zenoh_can_listen_on_is_an_endpoint(good: str) -> None:
    assert check_endpoint(good) == good


@pytest.mark.parametrize(
    "bad",
    ["", "tcp", "tcp/", "tcp/:7447", "tcp/host:", "tcp/host:0", "tcp/host:65536", "tcp/host:x", "a/b:1"],
)
def test_an_endpoint_that_can_never_be_used_is_refused(bad: str) -> None:
    with pytest.raises(UsageError, match="endpoint"):
        check_endpoint(bad)


def test_no_network_is_injected_where_none_is_asked_for() -> None:
    class Nothing:
        """A transport that is not used."""

    transport = Nothing()
    assert inject(transport, PROFILES["none"], 0, "module") is transport  # type: ignore[arg-type]
    injected = inject(transport, PROFILES["wifi"], 0, "module")  # type: ignore[arg-type]
    assert isinstance(injected, ImpairedTransport)
    only_parted = NetworkProfile(name="parted", partitions=((1.0, 2.0),))
    assert inject(transport, only_parted, 0, "module") is transport  # type: ignore[arg-type]
    injected = inject(transport, only_parted, 0, "coordinator")  # type: ignore[arg-type]
    assert isinstance(injected, ImpairedTransport)
    one_way = NetworkProfile(name="one way", to_coordinator=PathProfile(delay_ms=1.0))
    assert inject(transport, one_way, 0, "module") is transport  # type: ignore[arg-type]
    injected = inject(transport, one_way, 0, "coordinator")  # type: ignore[arg-type]
    assert isinstance(injected, ImpairedTransport)


class _ClosesUnderSignal:
    """A host whose world is gone, and that is told to stop while it closes."""

    modules = ()
    closed = False

    def __init__(self, number: signal.Signals):
        self._number = number

    def cycle(self) -> None:
        raise HardwareLost("the world closed it")

    def close(self) -> None:
        os.kill(os.getpid(), self._number)
        self.closed = True


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_in_the_middle_of_closing_does_not_leave_an_agent_half_closed(
    number: signal.Signals,
) -> None:
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    host: Any = _ClosesUnderSignal(number)
    signal.signal(number, agent_program._stop)
    try:
        with pytest.raises(typer.Exit) as ended:
            agent_program._serve(host, ThreadWorker())
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
    assert host.closed
    assert ended.value.exit_code == EXIT_LOST


def test_an_agent_runs_on_where_nothing_can_be_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard error is a log on a full disk."""
    done: list[str] = []

    def cycle() -> None:
        done.append("cycle")
        if done.count("cycle") == 3:
            raise HardwareLost("the world has ended")

    host: Any = SimpleNamespace(
        modules=[SimpleNamespace(serial="A")], cycle=cycle, close=lambda: done.append("close")
    )
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    # Line by line, as standard error is, so that a flush at its end has nothing left to write.
    disk = io.TextIOWrapper(io.FileIO("/dev/full", "w"), write_through=True)
    try:
        with monkeypatch.context() as full:
            full.setattr(sys, "stderr", disk)
            with pytest.raises(typer.Exit) as ended:
                agent_program._serve(host, ThreadWorker())
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
    assert done == ["cycle", "cycle", "cycle", "close"]
    assert ended.value.exit_code == EXIT_LOST

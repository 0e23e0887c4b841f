"""The physics bus with real client processes: lock-step, death, frost and thaw, and its socket file."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.hardware.bus_client import BusClient, BusRefused
from module_agent.hardware.bus_frames import (
    FrameError,
    TickFrames,
    Welcome,
    pack_hello,
    pack_refusal,
    pack_welcome,
    unpack_hello,
    unpack_welcome,
)
from module_agent.hardware.hardware import HardwareLost, Readings, SensorSample, WiredModule
from module_agent.model.errors import UsageError
from sim.world import bus_server
from sim.world.bus_server import BusInUse, BusServer

ROOT = Path(__file__).parents[3]
LIMIT_S = 20.0

# Sends a PWM that grows with every exchange; tells how many samples did not echo it, and every jump in time.
AGENT = """
import sys
from module_agent.hardware.bus_client import BusClient
from module_agent.hardware.hardware import HardwareLost
path, serials = sys.argv[1], sys.argv[2].split(",")
client = BusClient(path, serials)
last_ns = None
number, mismatches = 0, 0
try:
    while True:
        number += 1
        pwm = [1e-6 * (number % 1000 + 1) + 0.1 * i for i in range(len(serials))]
        samples = client.exchange(pwm)
        if last_ns is not None and samples[0].t_ns != last_ns + 1:
            print("jump", last_ns, samples[0].t_ns, flush=True)
        if [s.position_rad for s in samples] != pwm:
            mismatches += 1
        last_ns = samples[0].t_ns
except HardwareLost as error:
    print("lost", mismatches, flush=True)
"""


def module(serial: str) -> WiredModule:
    return WiredModule(serial, "X5-1", 1_000_000, 1_000_000)


class EchoWorld:
    """Its modules' position is the PWM that they got, their time the number of the step."""

    def __init__(self, serials: Sequence[str]):
        self.modules = tuple(module(serial) for serial in serials)
        self.steps = 0
        self.pwm: Sequence[float] = ()

    def exchange(self, pwm: Sequence[float]) -> Readings:
        self.steps += 1
        self.pwm = pwm
        samples = [SensorSample(self.steps, slot, value, *(0.0,) * 13) for slot, value in enumerate(pwm)]
        return Readings.of(samples)


@pytest.fixture
def path(tmp_path: Path) -> str:
    return str(tmp_path / "bus")


@pytest.fixture
def start(path: str) -> Iterator[Callable[[str], "subprocess.Popen[str]"]]:
    started: list[subprocess.Popen[str]] = []

    def run(serials: str) -> "subprocess.Popen[str]":
        child = subprocess.Popen(
            [sys.executable, "-c", AGENT, path, serials], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        started.append(child)
        return child

    yield run
    for child in started:
        if child.poll() is None:
            child.send_signal(signal.SIGCONT)
            child.kill()
        child.communicate(timeout=LIMIT_S)


def tick_until(server: BusServer, condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s, "did not come about"
        server.tick()


@contextmanager
def running(server: BusServer) -> Iterator[None]:
    """Run a server as fast as it goes, on a thread."""
    ended = threading.Event()
    thread = threading.Thread(target=server.run, args=(None, ended.is_set))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(LIMIT_S)
        assert not thread.is_alive()


def exchange_often(client: BusClient, pwm: float) -> None:
    """Exchange until the news of an end must have arrived."""
    for _ in range(3):
        client.exchange([pwm])


def lost(child: "subprocess.Popen[str]") -> tuple[int, list[list[int]]]:
    """Return an ended agent's count of mismatches, and its jumps in time."""
    out, _ = child.communicate(timeout=LIMIT_S)
    assert child.returncode == 0
    lines = [line.split() for line in out.splitlines()]
    assert lines[-1][0] == "lost"
    return int(lines[-1][1]), [[int(a), int(b)] for word, a, b in lines[:-1]]


# ------------------------------------------------------------------------------- processes


def test_every_agent_gets_the_samples_of_its_own_modules_in_its_own_order(path, start) -> None:
    world = EchoWorld(["A", "B", "C", "D"])
    with BusServer(path, world, bound_s=1.0) as server:
        agents = [start("D,B"), start("A")]
        tick_until(server, lambda: server.attached == ("A", "B", "D"))
        first = world.steps
        tick_until(server, lambda: world.steps == first + 500)
        # C has no agent. The second module of an agent gets 0.1 more than its first.
        a, b, c, d = world.pwm
        assert c == 0.0
        assert b - d == pytest.approx(0.1, abs=1e-12)
        assert 0.0 < a < 0.01
    for agent in agents:
        mismatches, jumps = lost(agent)
        # Every sample echoes the PWM that it answers: nothing is skipped or delayed by a tick. But the very
        # first PWM answers the welcome, comes at an unknown time, and is discarded.
        assert mismatches == 1
        assert jumps == []


def test_a_killed_agent_s_motors_get_zero_pwm_and_its_successor_takes_over(path, start) -> None:
    world = EchoWorld(["A", "B"])
    events: list[str] = []
    with BusServer(path, world, 1.0, events.append) as server:
        victim, other = start("A"), start("B")
        tick_until(server, lambda: server.attached == ("A", "B"))
        tick_until(server, lambda: all(value > 0.0 for value in world.pwm))
        victim.kill()
        victim.wait(LIMIT_S)
        # A PWM that it sent before it died may still be waiting.
        server.tick()
        server.tick()
        assert server.attached == ("B",)
        assert world.pwm[0] == 0.0
        assert world.pwm[1] > 0.0
        start("A")
        tick_until(server, lambda: server.attached == ("A", "B"))
        tick_until(server, lambda: world.pwm[0] > 0.0)
    assert any(line.startswith("A is gone") for line in events)
    assert lost(other)[1] == []


def test_a_frozen_agent_leaves_the_barrier_and_comes_back_without_a_backlog(path, start) -> None:
    world = EchoWorld(["A", "B"])
    with BusServer(path, world, bound_s=0.3) as server:
        frozen, other = start("A"), start("B")
        tick_until(server, lambda: server.attached == ("A", "B"))
        tick_until(server, lambda: all(value > 0.0 for value in world.pwm))
        frozen.send_signal(signal.SIGSTOP)
        tick_until(server, lambda: server.attached == ("B",))
        assert world.pwm[0] == 0.0
        froze_at = world.steps
        tick_until(server, lambda: world.steps == froze_at + 300)
        assert world.pwm[0] == 0.0
        frozen.send_signal(signal.SIGCONT)
        tick_until(server, lambda: server.attached == ("A", "B"))
        back_at = world.steps
        # Its late PWM is not applied at the tick with which it comes back, only the next one is.
        assert world.pwm[0] == 0.0
        server.tick()
        assert world.pwm[0] > 0.0
        tick_until(server, lambda: world.steps == back_at + 100)
    mismatches, jumps = lost(frozen)
    # One jump over everything that it slept through: from the last sample sent to it to the present one.
    assert len(jumps) == 1
    assert jumps[0][0] <= froze_at
    assert jumps[0][1] == back_at
    # The first sample ever, and the one it came back with.
    assert mismatches == 2
    assert lost(other)[1] == []


def test_agents_that_freeze_together_leave_the_barrier_together(path, start) -> None:
    world = EchoWorld(["A", "B", "C"])
    with BusServer(path, world, bound_s=0.2) as server:
        agents = [start(serial) for serial in "ABC"]
        tick_until(server, lambda: len(server.attached) == 3)
        for agent in agents:
            agent.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, agent.pid, os.WSTOPPED | os.WNOWAIT)
        # The first tick uses up what was answered before the freeze, the second waits in vain.
        server.tick()
        server.tick()
        assert server.attached == ()
        assert list(world.pwm) == [0.0, 0.0, 0.0]


# ------------------------------------------------------------------------------- refusals


def test_an_unknown_or_attached_serial_is_refused_by_name(path) -> None:
    with running(BusServer(path, EchoWorld(["A", "B"]))):
        client = BusClient(path, ["A"], LIMIT_S)
        with pytest.raises(BusRefused, match=r"no module 'Z'.*there are A, B"):
            BusClient(path, ["Z"], LIMIT_S)
        with pytest.raises(BusRefused, match="module 'A' has an agent already"):
            BusClient(path, ["B", "A"], LIMIT_S)
        with pytest.raises(BusRefused, match="named twice"):
            BusClient(path, ["B", "B"], LIMIT_S)
        with pytest.raises(BusRefused, match="at least one serial"):
            BusClient(path, [], LIMIT_S)
        client.close()
        BusClient(path, ["A", "B"], LIMIT_S).close()


def test_without_a_world_the_agent_says_so(path) -> None:
    with pytest.raises(HardwareLost, match="no world listens"):
        BusClient(path, ["A"], 0.05)


def test_a_client_waits_for_a_world_that_starts_later(path) -> None:
    got: list[SensorSample] = []

    def agent() -> None:
        client = BusClient(path, ["A"], LIMIT_S)
        got.extend(client.exchange([0.5]))
        client.close()

    thread = threading.Thread(target=agent)
    thread.start()
    with running(BusServer(path, EchoWorld(["A"]))):
        thread.join(LIMIT_S)
    assert len(got) == 1


def test_the_end_of_the_world_is_hardware_lost(path) -> None:
    with running(BusServer(path, EchoWorld(["A"]))):
        client = BusClient(path, ["A"], LIMIT_S)
        client.exchange([0.0])
    with pytest.raises(HardwareLost, match="gone"):
        exchange_often(client, 0.0)
    client.close()


@pytest.mark.parametrize("pwm", [1.5, -1.0000001, float("nan"), float("inf")])
def test_an_agent_with_a_pwm_out_of_range_is_dropped_and_nothing_of_it_applied(path, pwm) -> None:
    world = EchoWorld(["A"])
    applied: list[float] = []
    events: list[str] = []
    step = world.exchange
    world.exchange = lambda pwm: (applied.extend(pwm), step(pwm))[1]  # type: ignore[method-assign]
    with running(BusServer(path, world, report=events.append)):
        client = BusClient(path, ["A"], LIMIT_S)
        client.exchange([0.25])
        client.exchange([0.25])
        with pytest.raises(HardwareLost):
            exchange_often(client, pwm)
        client.close()
    assert set(applied) == {0.0, 0.25}
    assert any("a PWM is within [-1, 1]" in line for line in events)


def test_garbage_on_the_socket_does_not_disturb_the_world(path) -> None:
    with running(BusServer(path, EchoWorld(["A"]))):
        for garbage in (b"\xc1", b"\x93\x01", os.urandom(500), b"\x81\xa1v\x07"):
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stranger:
                stranger.connect(path)
                stranger.send(garbage)
                stranger.settimeout(LIMIT_S)
                assert isinstance(unpack_welcome(stranger.recv(65536)), str)
        client = BusClient(path, ["A"], LIMIT_S)
        assert len(client.exchange([0.0])) == 1
        client.close()


def test_a_connection_that_says_nothing_is_dropped_and_holds_nobody_up(path, monkeypatch) -> None:
    monkeypatch.setattr(bus_server, "HELLO_S", 0.05)
    lines: list[str] = []
    with (
        BusServer(path, EchoWorld(["A"]), report=lines.append) as server,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as squatter,
    ):
        squatter.connect(path)
        tick_until(server, lambda: bool(lines))
        squatter.settimeout(LIMIT_S)
        assert squatter.recv(1) == b""
    assert lines == ["an agent before its hello is dropped: no hello within 0.05 s"]


def test_where_no_more_connections_fit_the_world_goes_on_and_says_so_once(path, monkeypatch) -> None:
    class Full:
        """A process that has no descriptor left."""

        def __init__(self, listener) -> None:
            self._listener = listener

        def accept(self):
            raise OSError(24, "Too many open files")

        def __getattr__(self, name: str):
            return getattr(self._listener, name)

    lines: list[str] = []
    with (
        BusServer(path, EchoWorld(["A"]), report=lines.append) as server,
        socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as caller,
    ):
        monkeypatch.setattr(server, "_listener", Full(server._listener))
        caller.connect(path)
        tick_until(server, lambda: bool(lines))
        ticks = server.ticks
        tick_until(server, lambda: server.ticks > ticks + 3)
    assert lines == ["no more processes can attach for now: Too many open files"]


def test_modules_of_an_agent_that_does_not_answer_go_to_the_next_that_asks(path, monkeypatch) -> None:
    monkeypatch.setattr(bus_server, "ABANDONED_S", 1.0)
    lines: list[str] = []
    with running(BusServer(path, EchoWorld(["A"]), report=lines.append)):
        squatter = BusClient(path, ["A"], LIMIT_S)
        with pytest.raises(BusRefused, match="'A' has an agent already"):
            BusClient(path, ["A"], LIMIT_S)
        time.sleep(1.1)
        successor = BusClient(path, ["A"], LIMIT_S)
        assert len(successor.exchange([0.0])) == 1
        with pytest.raises(HardwareLost):
            exchange_often(squatter, 0.0)
        successor.close()
    assert "A is dropped for another agent: no answer for 1 s" in lines


def test_the_slow_agent_is_named_once_and_the_others_are_not(path, start) -> None:
    lines: list[str] = []
    with running(BusServer(path, EchoWorld(["A", "B"]), bound_s=2.0, report=lines.append)):
        start("B")
        slow = BusClient(path, ["A"], LIMIT_S)
        for _ in range(2 * bus_server.SLOW_TICKS + 10):
            time.sleep(2.0 * bus_server.SLOW_S)
            slow.exchange([0.0])
        slow.close()
    assert [line.split(":")[0] for line in lines if "slow" in line] == ["A is slow"]


# ------------------------------------------------------------------------------- the socket file


def test_the_socket_is_removed_at_the_end_and_a_stale_one_replaced(path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stale:
        stale.bind(path)
    assert os.path.exists(path)
    with BusServer(path, EchoWorld(["A"])) as server:
        server.tick()
        assert os.path.exists(path)
    assert not os.path.exists(path)
    server.close()


def test_a_second_world_on_the_same_path_is_refused_and_harms_nothing(path) -> None:
    with running(BusServer(path, EchoWorld(["A"]))):
        with pytest.raises(BusInUse, match="another world listens"):
            BusServer(path, EchoWorld(["A"]))
        client = BusClient(path, ["A"], LIMIT_S)
        client.exchange([0.0])
        client.close()


def test_a_file_in_the_way_is_left_alone(path) -> None:
    Path(path).write_text("precious")
    with pytest.raises(UsageError, match="not a socket"):
        BusServer(path, EchoWorld(["A"]))
    assert Path(path).read_text() == "precious"


def test_a_path_that_is_too_long_is_explained(tmp_path) -> None:
    with pytest.raises(UsageError, match="107 bytes"):
        BusServer(str(tmp_path / ("x" * 120)), EchoWorld(["A"]))


# ------------------------------------------------------------------------------- pacing


def test_the_pace_is_the_asked_speed_and_no_tick_is_early(path) -> None:
    world = EchoWorld(["A"])
    report = BusServer(path, world).run(10.0, lambda: world.steps >= 1000)
    assert report.ticks == world.steps == 1000
    assert report.simulated_s == pytest.approx(1.0)
    # The last tick begins 999 periods of 0.1 ms after the first, or later; never earlier.
    assert report.elapsed_s >= 0.0999
    assert report.achieved_speed == pytest.approx(report.simulated_s / report.elapsed_s)
    assert not os.path.exists(path)


def test_a_world_that_is_too_slow_slips_and_says_by_how_much(path) -> None:
    world = EchoWorld(["A"])
    step = world.exchange

    def slow(pwm: Sequence[float]) -> Readings:
        time.sleep(0.01)
        return step(pwm)

    world.exchange = slow  # type: ignore[method-assign]
    report = BusServer(path, world).run(1.0, lambda: world.steps >= 20)
    # 19 steps of at least 10 ms each where 1 ms is due: before the last, all lag but 20 ms has been given up.
    assert report.slipped_s >= 19 * 0.009 - 0.020 - 1e-9
    assert report.achieved_speed < 0.11


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_is_positive(path, speed) -> None:
    with BusServer(path, EchoWorld(["A"])) as server, pytest.raises(ValueError, match="positive"):
        server.run(speed, lambda: True)


# ------------------------------------------------------------------------------- frames

INT64 = st.integers(-(2**63), 2**63 - 1)
SAMPLES = st.builds(SensorSample, INT64, INT64, *(st.floats(allow_nan=False),) * 15)


@settings(deadline=None)
@given(st.integers(0, 2**64 - 1), st.lists(SAMPLES, min_size=1, max_size=5))
def test_samples_survive_the_wire_exactly(tick, samples) -> None:
    frames = TickFrames.of(len(samples))
    readings, read = Readings.of(samples), Readings(len(samples))
    packed = frames.pack_samples(tick, readings, range(len(samples)))
    assert len(packed) == 8 + 136 * len(samples)
    assert frames.unpack_samples(packed, read) == tick
    assert list(read) == samples
    with pytest.raises(FrameError, match="bytes"):
        frames.unpack_samples(packed + b"\0", read)


@settings(deadline=None)
@given(st.integers(0, 2**64 - 1), st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=5))
def test_pwm_survives_the_wire_exactly(tick, pwm) -> None:
    frames = TickFrames.of(len(pwm))
    packed = frames.pack_pwm(tick, pwm)
    assert len(packed) == 8 + 8 * len(pwm)
    assert frames.unpack_pwm(packed) == (tick, tuple(pwm))
    with pytest.raises(FrameError, match="bytes"):
        frames.unpack_pwm(packed[:-1])


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_no_bytes_break_the_handshake(data) -> None:
    for unpack in (unpack_hello, unpack_welcome):
        try:
            greeting = unpack(data)
        except FrameError:
            continue
        assert isinstance(greeting, tuple | str)


def test_the_handshake_survives_the_wire() -> None:
    assert unpack_hello(pack_hello(["A", "B"])) == ("A", "B")
    welcome = Welcome(7, (module("A"), module("B")))
    assert unpack_welcome(pack_welcome(welcome)) == welcome
    assert unpack_welcome(pack_refusal("why")) == "why"

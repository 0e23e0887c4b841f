"""Real processes over Zenoh on loopback: starting them, watching them, and proof that nothing is left."""

import os
import queue
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.recording.session_file import read_session
from module_agent.transport.transport import Event, Liveness, Reply, Sample
from module_agent.transport.zenoh_transport import ZenohConfig, ZenohTransport, open_zenoh
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.keys import Leaf, every, key, parse
from module_agent.wire.messages import (
    Ack,
    Ask,
    Feedback,
    HistoryRequest,
    Info,
    LeaseRequest,
    Message,
    MotionRecord,
    Setpoint,
    Status,
)
from module_agent.wire.refusal import WireError
from module_agent.wire.row_log import RowLog
from sim.physics.engine import Physics
from sim.processes.launcher import Child, LaunchConfig, Launcher
from sim.robot.robot_file import load_robot

ROOT = Path(__file__).parents[2]
# No test waits this long unless it fails: the machine may be slow and shared.
LIMIT_S = 400.0
MARK = "X5_INTEGRATION_TEST"
# All of these tests over the driver of real modules and what stands in for hebi-py; by default those that
# take `through_driver` are, once without it and, as breadth, once with it.
THROUGH_THE_DRIVER = "X5_TEST_HEBI" in os.environ

# A whole session in 14 s (27 s with dynamics): shorter motions, everything else as shipped.
SHORT_PLAN = """
discover_s = 0.3
link_s = 1.0
settle_s = 0.3
rest_s = 1.0
travel_speed_rad_s = 1.2
constant_duration_s = 0.5
sine_centre_s = 1.4
sine_sigma_s = 0.5
dynamic_repeats = 1
# On a machine that is busy with other things a keep-alive may come too late; that is tried again.
retries = 5
"""


def pytest_itemcollected(item: pytest.Item) -> None:
    """Mark every test of this folder, early enough for xdist to keep all of them on one worker."""
    item.add_marker(pytest.mark.integration)
    item.add_marker(pytest.mark.xdist_group("integration"))


# --------------------------------------------------------------------------- nothing is left behind


def marked_processes(mark: str) -> list[str]:
    """Return the living processes that were started, at any depth, with this mark in their environment."""
    found = []
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit() or int(folder.name) == os.getpid():
            continue
        try:
            if f"{MARK}={mark}".encode() in (folder / "environ").read_bytes():
                found.append(f"{folder.name}: {(folder / 'cmdline').read_text()}")
        except OSError:
            continue  # it has ended meanwhile, or is another user's
    return found


@pytest.fixture(autouse=True)
def nothing_is_left(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """Give the test its own place for bus sockets, and check that no process and no socket outlives it."""
    mark = uuid.uuid4().hex
    # Short, as the path of a Unix socket has at most 107 bytes.
    place = Path(tempfile.mkdtemp(prefix="x5-test-", dir="/tmp"))
    monkeypatch.setenv(MARK, mark)
    monkeypatch.setenv("TMPDIR", str(place))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    yield place
    processes = marked_processes(mark)
    for line in processes:
        os.kill(int(line.split(":")[0]), signal.SIGKILL)
    left = [str(path) for path in place.rglob("*")]
    shutil.rmtree(place)
    assert not processes, "processes are left"
    assert not left, "files are left beside the bus"


# --------------------------------------------------------------------------- programs


def until(condition: Callable[[], Any], what: str, *alive: Child) -> Any:
    """Wait until a condition holds and return its value; none of the `alive` processes may end meanwhile."""
    end_s = time.monotonic() + LIMIT_S
    while not (value := condition()):
        for child in alive:
            assert child.process.poll() is None, f"{child.name} ended before {what}: {words(child)}"
        assert time.monotonic() < end_s, f"{what} did not come about"
        time.sleep(0.005)
    return value


def words(child: Child) -> str:
    """Return all that a process has printed."""
    assert child.log is not None
    return child.log.read_text(errors="replace")


def ended(child: Child) -> tuple[int, str]:
    """Wait for the end of a process; return its exit code and all that it printed."""
    child.process.wait(LIMIT_S)
    return child.process.returncode, words(child)


def program(module: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """Run one of the programs to its end."""
    return subprocess.run(
        [sys.executable, "-m", module, *arguments],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )


class Programs:
    """What tests do with processes."""

    limit_s = LIMIT_S
    until = staticmethod(until)
    words = staticmethod(words)
    ended = staticmethod(ended)
    run = staticmethod(program)

    @staticmethod
    def entries(session: Path) -> list[Any]:
        """Return all entries of a recording."""
        return list(read_session(session))


@pytest.fixture
def programs() -> Programs:
    return Programs()


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(SHORT_PLAN)
    return path


@pytest.fixture
def lasting_plan(tmp_path: Path) -> Path:
    """The short plan with fifty seconds for each joint: programs that start meanwhile find it moving."""
    path = tmp_path / "lasting.toml"
    lasting = SHORT_PLAN.replace("sine_centre_s = 1.4", "sine_centre_s = 25.0")
    path.write_text(lasting.replace("sine_sigma_s = 0.5", "sine_sigma_s = 25.0"))
    return path


@pytest.fixture(
    params=[pytest.param(False, id="loops"), pytest.param(True, id="driver", marks=pytest.mark.breadth)]
)
def through_driver(request: pytest.FixtureRequest) -> bool:
    """Whether the agents speak to their modules through the driver of real ones."""
    return bool(request.param)


@pytest.fixture
def launcher(tmp_path: Path, endpoint: str, plan: Path, nothing_is_left: Path) -> Iterator[Any]:
    """Make the launcher of one robot; whatever it started is stopped at the end.

    Commands live longer than by default, for a machine that has other things to do; the tests that are about
    their lifetime set it.
    """
    made: list[Launcher] = []

    def make(
        robot: str = "thesis_171_horizontal",
        network: str = "lan",
        lifetime_ms: int = 1000,
        hebi: bool = False,
        physics: Physics = "pybullet",
    ) -> Launcher:
        config = LaunchConfig(
            robot_file=robot,
            robot_name=robot,
            serials=load_robot(robot).serials,
            out=tmp_path / "run",
            network=network,
            endpoint=endpoint,
            agent_options=("--lifetime-ms", str(lifetime_ms)),
            coordinator_options=("--plan", str(plan), "--no-dynamics", "--no-report"),
            hebi=hebi or THROUGH_THE_DRIVER,
            physics=physics,
        )
        made.append(Launcher(config, lambda text: None))
        return made[-1]

    yield make
    for each in made:
        each.stop()


# --------------------------------------------------------------------------- a foreign client


class Client:
    """Somebody else's program on the robot's network: it hears everything, asks, and commands if it may."""

    Ack = Ack

    def __init__(self, transport: ZenohTransport, robot: str, sender: str):
        self.transport = transport
        self.robot = robot
        self.sender = sender
        self.statuses: dict[str, list[Status]] = {}
        self.rows: dict[str, RowLog] = {}
        self.newest_ns: dict[str, int] = {}
        self.alive: dict[str, bool] = {}
        # How often each module has left the network, or been given up by the hub.
        self.losses: Counter[str] = Counter()
        self.tokens: dict[str, int] = {}
        self.unreadable = 0
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._replies: dict[int, Reply] = {}
        self._seq = 0
        for leaf in (Leaf.STATUS, Leaf.FEEDBACK):
            transport.subscribe(every(robot, leaf), self._events.put)
        transport.watch_alive(every(robot, Leaf.ALIVE), self._events.put)

    # ------------------------------------------------------------------ hearing

    def pump(self) -> None:
        """Take in what has arrived."""
        while True:
            try:
                event = self._events.get_nowait()
            except queue.Empty:
                return
            match event:
                case Sample(at, payload):
                    self._hear(at, payload)
                case Liveness(at, alive):
                    self.alive[parse(at).serial] = alive
                    self.losses[parse(at).serial] += not alive
                case Reply():
                    self._replies[event.tag] = event

    def _hear(self, at: str, payload: bytes) -> None:
        try:
            parts = parse(at)
            self._note(parts.serial, parts.leaf, payload)
        except WireError:
            self.unreadable += 1

    def _note(self, serial: str, leaf: Leaf, payload: bytes) -> None:
        if leaf is Leaf.STATUS:
            status = decode(Status, payload)
            self.statuses.setdefault(serial, []).append(status)
            self.newest_ns[serial] = status.t_ns
        else:
            feedback = decode(Feedback, payload, MAX_MESSAGE_BYTES)
            rows = self.rows.setdefault(serial, RowLog(feedback.boot)).add(feedback)
            self.newest_ns[serial] = int(rows["t_ns"][-1])

    def until(self, condition: Callable[[], Any], what: str, *alive: Child) -> Any:
        """Wait, while hearing, until a condition holds."""

        def heard() -> Any:
            self.pump()
            return condition()

        return until(heard, what, *alive)

    def meet(self, serials: tuple[str, ...], *alive: Child) -> None:
        """Wait until these modules are there and their feedback is heard."""
        self.until(lambda: all(self.alive.get(s) and s in self.rows for s in serials), "all modules", *alive)

    def motion(self, serial: str, kind: str, rows: int, *alive: Child) -> MotionRecord:
        """Wait until a motion of this kind has been running for so many feedback rows; return it."""

        def running() -> MotionRecord | None:
            latest = self.statuses.get(serial, [])[-1:]
            motion = latest[0].motion if latest else None
            if motion is None or motion.outcome != "running" or motion.pattern.kind != kind:
                return None
            return motion if self.rows[serial].end_row >= motion.start_row + rows else None

        found = self.until(running, f"a {kind} motion of {serial}", *alive)
        assert isinstance(found, MotionRecord)
        return found

    # ------------------------------------------------------------------ asking

    def next_seq(self) -> int:
        self._seq += 1
        return self._seq

    def raw(self, at: str, payload: bytes, timeout_s: float = 2.0) -> bytes | None:
        """Ask on a key; return the first answer, None without any."""
        tag = self.next_seq()
        self.transport.query(at, payload, timeout_s, self._events.put, tag)
        reply = self.until(lambda: self._replies.get(tag), f"the end of the question on {at}")
        payload_or_none: bytes | None = reply.payload
        return payload_or_none

    def ask(self, serial: str, leaf: Leaf, message: Message, kind: type[Message]) -> Any:
        """Ask a module as soon as it is there, until answered; return the answer."""
        self.until(lambda: self.alive.get(serial), f"{serial} on the network")
        for _ in range(20):
            answer = self.raw(key(self.robot, serial, leaf), encode(message))
            if answer is not None:
                return decode(kind, answer, MAX_MESSAGE_BYTES)
        raise AssertionError(f"{serial} does not answer on {leaf.value}")

    def _any_boot(self, serial: str) -> Ask:
        return Ask(serial=serial, boot=0, seq=self.next_seq(), sender=self.sender)

    def status(self, serial: str) -> Status:
        found: Status = self.ask(serial, Leaf.STATUS, self._any_boot(serial), Status)
        self.newest_ns[serial] = max(self.newest_ns.get(serial, 0), found.t_ns)
        return found

    def info(self, serial: str) -> Info:
        found: Info = self.ask(serial, Leaf.INFO, self._any_boot(serial), Info)
        return found

    def history(self, serial: str, first: int, end: int) -> Rows:
        """Fetch rows from a module's memory, in as many questions as it takes."""
        boot = self.status(serial).boot
        log = RowLog(boot)
        while missing := log.missing(first, end):
            request = HistoryRequest(
                serial=serial,
                boot=boot,
                seq=self.next_seq(),
                sender=self.sender,
                first_row=missing[0][0],
                end_row=missing[0][1],
            )
            log.add(self.ask(serial, Leaf.HISTORY, request, Feedback))
        return log.rows(first, end)

    # ------------------------------------------------------------------ commanding

    def head(self, serial: str) -> dict[str, Any]:
        """Return what a command of the lease's holder carries; echoes the newest module time heard."""
        self.pump()
        return {
            "serial": serial,
            "boot": self.rows[serial].boot,
            "seq": self.next_seq(),
            "sender": self.sender,
            "token": self.tokens.get(serial, 0),
            "echo_ns": self.newest_ns[serial],
        }

    def lease_message(self, serial: str, action: str, duration_s: float = 10.0) -> LeaseRequest:
        return LeaseRequest.model_validate(
            {**self.head(serial), "action": action, "duration_ns": round(duration_s * 1e9)}
        )

    def acquire(self, serial: str) -> None:
        """Take the lease; a request that a busy machine has made too old is made anew."""

        def acquired() -> bool:
            ack: Ack = self.ask(serial, Leaf.LEASE, self.lease_message(serial, "acquire"), Ack)
            assert ack.accepted or ack.reason == "stale", ack.detail
            self.tokens[serial] = ack.token
            return ack.accepted

        self.until(acquired, f"the lease of {serial}")

    def keep_alive(self, serial: str) -> None:
        """Renew without waiting for the answer."""
        at = key(self.robot, serial, Leaf.LEASE)
        self.transport.query(at, encode(self.lease_message(serial, "renew")), 1.0, self._events.put, 0)

    def stream(self, serial: str, position_rad: float) -> None:
        """Publish one setpoint."""
        setpoint = Setpoint.model_validate(
            {**self.head(serial), "position_rad": position_rad, "velocity_rad_s": None, "effort_nm": None}
        )
        self.transport.publish(key(self.robot, serial, Leaf.SETPOINT), encode(setpoint))

    def ramp(self, serial: str, start_rad: float, end_rad: float, speed_rad_s: float = 0.5) -> None:
        """Stream setpoints from one position to another in module time, then until the joint stands there.

        What has expired meanwhile, on a busy machine, is acquired again.
        """
        began_ns, sign = self.newest_ns[serial], np.sign(end_rad - start_rad)
        way = abs(end_rad - start_rad)

        def there() -> bool:
            done = min(way, speed_rad_s * (self.newest_ns[serial] - began_ns) / 1e9)
            if any(status.state == "expired" for status in self.statuses.get(serial, [])[-1:]):
                self.acquire(serial)
            self.stream(serial, float(start_rad + sign * done))
            latest = self.latest(serial)
            return bool(
                done == way
                and abs(latest["position_rad"] - end_rad) < 0.02
                and abs(latest["velocity_rad_s"]) < 0.02
            )

        self.until(there, f"{serial} at {end_rad} rad")

    def latest(self, serial: str) -> Any:
        """Return the newest feedback row that was heard."""
        log = self.rows[serial]
        return log.rows(log.end_row - 1, log.end_row)[0]

    def close(self) -> None:
        self.transport.close()


@pytest.fixture
def client(endpoint: str) -> Iterator[Any]:
    """Join the network of a robot, as its hub or as one more program."""
    made: list[Client] = []

    def join(robot: str, hub: bool = False, sender: str = "a-test") -> Client:
        config = ZenohConfig.hub(endpoint) if hub else ZenohConfig.spoke(endpoint)
        made.append(Client(open_zenoh(config), robot, sender))
        return made[-1]

    yield join
    for each in made:
        each.close()

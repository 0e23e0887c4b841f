"""A barrier as bare as it can be in Python, for the world's to be compared with.

A server, as the world, and processes, as the agents, exchange frames of the physics bus's sizes on Unix
SEQPACKET sockets in lock-step; each process puts one message of feedback's size by Zenoh for each of its
modules every 20 ticks, to a listener's process, in place of router and coordinator. Nothing is computed.
`python -m tests.benchmarks.bare_barrier agent PATH MODULES ENDPOINT` is one process, and
`python -m tests.benchmarks.bare_barrier listener ENDPOINT` is the listener.
"""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from module_agent.hardware.bus_frames import TickFrames
from module_agent.transport.zenoh_transport import ZenohConfig, _session_config
from tests.benchmarks.wire_publisher import MESSAGE_BYTES

EVERY_TICKS = 20
ROOT = Path(__file__).parents[2]


class BareFigures(NamedTuple):
    """Processor time for each module and tick, of server and agents, and of the listener [us].

    tick_us: of a tick, by the wall.
    """

    served_us: float
    heard_us: float
    tick_us: float

    @property
    def all_us(self) -> float:
        """Processor time of all processes for each module and tick."""
        return self.served_us + self.heard_us


def attach(path: str, modules: int, endpoint: str) -> None:
    """Answer every frame until the server hangs up."""
    session = zenoh.open(_session_config(ZenohConfig(mode="client", connect=(endpoint,))))
    drop = zenoh.CongestionControl.DROP
    name = os.getpid()
    publishers = [
        session.declare_publisher(f"bare/{name}/{k}", congestion_control=drop) for k in range(modules)
    ]
    frames, payload = TickFrames.of(modules), bytes(MESSAGE_BYTES)
    answer, size = bytes(frames.pwm.size), frames.samples_bytes + 1
    bus = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bus.connect(path)
    ticks = 0
    bus.send(answer)
    while bus.recv(size):
        ticks += 1
        if ticks % EVERY_TICKS == 0:
            for publisher in publishers:
                publisher.put(payload)
        bus.send(answer)
    bus.close()
    session.close()  # type: ignore[no-untyped-call]


def listen(endpoint: str) -> None:
    """Hear all messages until the input ends; print how many there were."""
    heard = [0]

    def hear(_: zenoh.Sample) -> None:
        heard[0] += 1

    session = zenoh.open(_session_config(ZenohConfig(listen=(endpoint,))))
    subscriber = session.declare_subscriber("bare/**", zenoh.handlers.Callback(hear, indirect=False))
    print("ready", flush=True)
    sys.stdin.read()
    subscriber.undeclare()
    session.close()  # type: ignore[no-untyped-call]
    print(heard[0], flush=True)


def measure(folder: Path, processes: int, modules: int, seconds: float, endpoint: str) -> BareFigures:
    """Run a barrier of `modules` modules in `processes` processes as fast as it goes."""
    path, each = str(folder / "bare"), modules // processes
    program = [sys.executable, "-m", "tests.benchmarks.bare_barrier"]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    hub = subprocess.Popen([*program, "listener", endpoint], cwd=ROOT, **pipes)
    assert hub.stdout.readline() == "ready\n"
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(path)
    listener.listen(processes)
    command = [*program, "agent", path, str(each), endpoint]
    children = [subprocess.Popen(command, cwd=ROOT) for _ in range(processes)]
    agents = [listener.accept()[0] for _ in children]
    frames = TickFrames.of(each)
    samples, size = bytes(frames.samples_bytes), frames.pwm.size + 1

    def tick() -> None:
        for agent in agents:
            agent.recv(size)
        for agent in agents:
            agent.send(samples)

    for _ in range(200):
        tick()
    ticks, begun_s = 0, time.monotonic()
    served_s, heard_s = time.process_time() + _cpu_s(children), _cpu_s([hub])
    while time.monotonic() < begun_s + seconds:
        tick()
        ticks += 1
    spent_s = time.monotonic() - begun_s
    served_s, heard_s = time.process_time() + _cpu_s(children) - served_s, _cpu_s([hub]) - heard_s
    for agent in agents:
        agent.recv(size)
        agent.close()
    for child in children:
        child.wait(20.0)
    listener.close()
    os.unlink(path)
    heard, _ = hub.communicate(timeout=20.0)
    assert int(heard) > 0, "nothing was heard by Zenoh"
    us = 1e6 / ticks
    return BareFigures(us * served_s / modules, us * heard_s / modules, us * spent_s)


def _cpu_s(children: list["subprocess.Popen[Any]"]) -> float:
    """Return the processor time of processes so far [s]."""
    fields = [
        Path(f"/proc/{child.pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13] for child in children
    ]
    return sum(int(value) for pair in fields for value in pair) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["agent", bus, count, hub_endpoint]:
            attach(bus, int(count), hub_endpoint)
        case ["listener", hub_endpoint]:
            listen(hub_endpoint)
        case _:
            raise SystemExit(__doc__)

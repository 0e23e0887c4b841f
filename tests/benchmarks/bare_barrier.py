"""A barrier as bare as it can be in Python, for the world's to be compared with.

A server and processes on Unix SEQPACKET sockets exchange frames of the physics bus's sizes in lock-step; each
process puts one message of feedback's size by Zenoh for each of its modules every 20 ticks, to the server's
process. Nothing is computed. `python -m tests.benchmarks.bare_barrier PATH MODULES ENDPOINT` is one process.
"""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import zenoh

from module_agent.hardware.bus_frames import TickFrames
from module_agent.transport.zenoh_transport import ZenohConfig, _session_config
from tests.benchmarks.wire_publisher import MESSAGE_BYTES

EVERY_TICKS = 20
ROOT = Path(__file__).parents[2]


class BareFigures(NamedTuple):
    """Processor time of all processes for each module and tick, and of a tick, by the wall [us]."""

    us_per_module_tick: float
    tick_us: float


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


def measure(folder: Path, processes: int, modules: int, seconds: float, endpoint: str) -> BareFigures:
    """Run a barrier of `modules` modules in `processes` processes as fast as it goes."""
    path, each = str(folder / "bare"), modules // processes
    heard = [0]

    def hear(_: zenoh.Sample) -> None:
        heard[0] += 1

    session = zenoh.open(_session_config(ZenohConfig(listen=(endpoint,))))
    subscriber = session.declare_subscriber("bare/**", zenoh.handlers.Callback(hear, indirect=False))
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(path)
    listener.listen(processes)
    command = [sys.executable, "-m", "tests.benchmarks.bare_barrier", path, str(each), endpoint]
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
    ticks, begun_s, cpu_s = 0, time.monotonic(), _cpu_s(children)
    while time.monotonic() < begun_s + seconds:
        tick()
        ticks += 1
    spent_s, cpu_s = time.monotonic() - begun_s, _cpu_s(children) - cpu_s
    for agent in agents:
        agent.recv(size)
        agent.close()
    for child in children:
        child.wait(20.0)
    listener.close()
    os.unlink(path)
    subscriber.undeclare()
    session.close()  # type: ignore[no-untyped-call]
    assert heard[0] > 0, "nothing was heard by Zenoh"
    return BareFigures(1e6 * cpu_s / ticks / modules, 1e6 * spent_s / ticks)


def _cpu_s(children: list["subprocess.Popen[bytes]"]) -> float:
    """Return the processor time of the children and of this process so far [s]."""
    fields = [
        Path(f"/proc/{child.pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13] for child in children
    ]
    ticks = sum(int(value) for pair in fields for value in pair)
    return ticks / os.sysconf("SC_CLK_TCK") + time.process_time()


if __name__ == "__main__":
    attach(sys.argv[1], int(sys.argv[2]), sys.argv[3])

"""What a message costs, and what reaches the coordinator of 64 modules, beside bare Zenoh and ZeroMQ.

`X5_WIRE_SECONDS` says for how long each of the three publishes, in rounds, so that all see the same machine
(9 by default; the bar is meant for 600).
"""

import asyncio
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import zenoh
import zmq

from coordinator.live_robot.messenger import Messenger
from coordinator.recording.recording import Entry, Recording
from module_agent.transport.zenoh_transport import ZenohConfig, _session_config, open_zenoh
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.feedback_rows import ROW, unpack
from module_agent.wire.messages import Feedback
from module_agent.wire.row_log import RowLog
from tests.benchmarks.bars import least_cpu_of, report
from tests.benchmarks.test_real_time import free_endpoint
from tests.benchmarks.wire_publisher import BARE, BATCH, ROBOT, Sent, resident_kb

pytestmark = pytest.mark.benchmark

SECONDS = float(os.environ.get("X5_WIRE_SECONDS", "9"))
ROUNDS, PROCESSES, MODULES = 3, 8, 64
ROOT = Path(__file__).parents[2]


class Heard(NamedTuple):
    """What reached the listener: delays of messages [ms], rows, its CPU time [s] and memory [kB]."""

    delays_ms: np.ndarray
    rows: int
    cpu_s: float
    early_kb: int = 0
    late_kb: int = 0


class Round(NamedTuple):
    """One kind's round."""

    heard: Heard
    sent: list[Sent]

    @property
    def lost(self) -> int:
        return sum(one.rows for one in self.sent) * (MODULES // PROCESSES) - self.heard.rows


class Publishers:
    """The processes that publish; `done` says that all have ended."""

    def __init__(self, kind: str, endpoint: str, seconds: float, boot: int):
        each = MODULES // PROCESSES
        command = [sys.executable, "-m", "tests.benchmarks.wire_publisher", kind, endpoint]
        self._children = [
            subprocess.Popen(
                [*command, str(first), str(each), str(seconds), str(boot)],
                cwd=ROOT,
                stdout=subprocess.PIPE,
                text=True,
            )
            for first in range(0, MODULES, each)
        ]

    @property
    def done(self) -> bool:
        return all(child.poll() is not None for child in self._children)

    def sent(self) -> list[Sent]:
        return [Sent(**json.loads(child.communicate()[0])) for child in self._children]


def _bare_round(kind: str, seconds: float, boot: int) -> Round:
    endpoint, arrivals = free_endpoint(), list[tuple[int, int]]()

    def hear(payload: bytes) -> None:
        arrivals.append((time.monotonic_ns(), BARE.unpack_from(payload)[2]))

    cpu_s = time.process_time()
    if kind == "zenoh":
        session = zenoh.open(_session_config(ZenohConfig(listen=(endpoint,))))
        handler = zenoh.handlers.Callback(lambda sample: hear(sample.payload.to_bytes()), indirect=False)
        subscriber = session.declare_subscriber("bare/*", handler)
        publishers = Publishers(kind, endpoint, seconds, boot)
        sent = publishers.sent()
        subscriber.undeclare()
        session.close()
    else:
        listener = zmq.Context.instance().socket(zmq.SUB)
        listener.bind(endpoint.replace("tcp/", "tcp://"))
        listener.setsockopt(zmq.SUBSCRIBE, b"")
        publishers = Publishers(kind, endpoint, seconds, boot)
        while not publishers.done:
            while listener.poll(50):
                hear(listener.recv())
        sent = publishers.sent()
        listener.close()
    cpu_s = time.process_time() - cpu_s
    times = np.array(arrivals)
    return Round(Heard(1e-6 * (times[:, 0] - times[:, 1]), BATCH * len(times), cpu_s), sent)


def _product_round(seconds: float, boot: int) -> Round:
    """Hear by messenger and recording, as a session does; rows are forgotten, as monitoring does."""
    endpoint, recording = free_endpoint(), Recording()
    delays, memory = list[np.ndarray](), list[int]()

    def record(entry: Entry) -> object:
        return recording.accept(entry)

    def forget() -> None:
        for module in recording.modules.values():
            row_ns, arrival_ns = module.arrivals.columns()
            delays.append(1e-6 * (arrival_ns - row_ns))
            module.forget(500, 0)
            module.arrivals.forget(0)
        memory.append(resident_kb())

    async def listen() -> Round:
        loop = asyncio.get_running_loop()
        transport = open_zenoh(ZenohConfig.hub(endpoint))
        messenger = Messenger(
            transport, ROBOT, time.monotonic_ns, loop.call_soon_threadsafe, record, time.thread_time_ns
        )
        messenger.start()
        publishers = Publishers("product", endpoint, seconds, boot)
        cpu_s = time.process_time()
        while not publishers.done:
            await asyncio.sleep(0.25)
            forget()
        await asyncio.sleep(0.1)
        forget()
        cpu_s = time.process_time() - cpu_s
        messenger.close()
        # Every arrival is a message whose rows had not come before.
        rows = BATCH * sum(map(len, delays))
        cost_us = messenger.cpu_us_per_message or 0.0
        print(f"  {cost_us:.1f} us a message on the event loop")
        heard = Heard(np.concatenate(delays), rows, cpu_s, memory[len(memory) // 4], memory[-1])
        return Round(heard, publishers.sent())

    return asyncio.run(listen())


def _reported(rounds: dict[str, list[Round]]) -> None:
    p50, p99 = (
        {
            kind: float(np.percentile(np.concatenate([r.heard.delays_ms for r in done]), share))
            for kind, done in rounds.items()
        }
        for share in (50, 99)
    )
    lost = {kind: sum(r.lost for r in done) for kind, done in rounds.items()}
    anchors = "; ".join(
        f"{kind}: p50 {p50[kind]:.2f}, p99 {p99[kind]:.2f} ms, {lost[kind]} rows lost" for kind in rounds
    )
    what = f"{MODULES} modules at 250 Hz in {PROCESSES} processes, {ROUNDS} x {SECONDS / ROUNDS:.0f} s"
    report(f"{what}: rows lost", lost["product"], at_most=0)
    report(f"{what}: p99 over bare Zenoh's", p99["product"] / p99["zenoh"], at_most=1.3, anchor=anchors)
    heard = [r.heard for r in rounds["product"]]
    sent = [one for r in rounds["product"] for one in r.sent]
    report(f"{what}: memory of the listener grows by", max(h.late_kb - h.early_kb for h in heard), "kB")
    report(f"{what}: memory of an agent grows by", max(s.late_kb - s.early_kb for s in sent), "kB")
    for kind, done in rounds.items():
        messages = sum(len(r.heard.delays_ms) for r in done)
        hear_us = 1e6 * sum(r.heard.cpu_s for r in done) / messages
        send_us = 1e6 * sum(one.cpu_s for r in done for one in r.sent) / messages
        report(f"{kind}: CPU a message of {BATCH} rows, sent", send_us, "us")
        report(f"{kind}: CPU a message of {BATCH} rows, received and kept", hear_us, "us")


def test_sixty_four_modules_beside_bare_zenoh_and_zeromq() -> None:
    rounds: dict[str, list[Round]] = {"product": [], "zenoh": [], "zeromq": []}
    for number in range(ROUNDS):
        for kind, done in rounds.items():
            seconds = SECONDS / ROUNDS
            done.append(
                _product_round(seconds, number + 1)
                if kind == "product"
                else _bare_round(kind, seconds, number + 1)
            )
    _reported(rounds)


def test_a_message_of_feedback() -> None:
    rows = np.zeros(BATCH, ROW)
    messages = [
        Feedback(serial="A", boot=1, seq=n, first_row=n * BATCH, count=BATCH, rows=rows.tobytes())
        for n in range(2000)
    ]
    payloads = [encode(message) for message in messages]

    def decoded() -> None:
        for payload in payloads:
            unpack(decode(Feedback, payload, MAX_MESSAGE_BYTES))

    def encoded() -> None:
        for message in messages:
            encode(message)

    def kept() -> None:
        log = RowLog(1)
        for message in messages:
            log.add(message)

    def recorded() -> None:
        recording = Recording()
        for payload in payloads:
            recording.add(Entry("publication", "x5/bench/A/feedback", 0, payload))

    names = ("encoded", "decoded, its rows as a view", "its rows kept", "decoded, kept, indexed and hashed")
    costs = least_cpu_of((encoded, decoded, kept, recorded))
    for name, cost_s in zip(names, costs, strict=True):
        report(f"a message of {BATCH} rows {name}", 1e6 * cost_s / len(messages), "us")

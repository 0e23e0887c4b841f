"""What a message costs, and what reaches the coordinator of 64 modules, beside bare Zenoh and ZeroMQ.

`X5_WIRE_SECONDS` says for how long each of the three publishes, in rounds, so that all see the same machine
(9 by default; the bar is meant for 600).
"""

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import zenoh
import zmq
from numpy.typing import NDArray

from coordinator.live_robot.messenger import COALESCED_S, Messenger
from coordinator.recording.recording import Entry, Recording
from module_agent.transport.zenoh_transport import ZenohConfig, _session_config, open_zenoh
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.feedback_rows import ROW, unpack
from module_agent.wire.messages import Feedback
from module_agent.wire.row_log import RowLog
from tests.benchmarks.bars import least_cpu_of, report
from tests.benchmarks.test_real_time import free_endpoint
from tests.benchmarks.wire_publisher import BARE, BATCH, PERIOD_S, ROBOT, Sent, resident_kb

pytestmark = pytest.mark.benchmark

SECONDS = float(os.environ.get("X5_WIRE_SECONDS", "9"))
ROUNDS, PROCESSES, MODULES = 3, 8, 64
# Of each module; one page and a part.
RETAINED_ROWS = 100
# Of the listener and of an agent, from half of a round to its end. In a round of 3 s, the shortest, the rows
# of that time have 2.4 MB, and those of an agent 0.3 MB: it would show if they were all kept.
MOST_GROWN_KB, AGENT_GROWN_KB = 1024, 256
ROOT = Path(__file__).parents[2]


class Delays:
    """Delays of messages, of which only a histogram is kept: the listener's memory is part of the result.

    Bins are a hundredth of their delay wide, from a microsecond to a minute.
    """

    EDGES_MS = 1e-3 * 1.01 ** np.arange(1802)
    WAITING = 4096

    def __init__(self) -> None:
        self.counts = np.zeros(len(self.EDGES_MS) + 1, np.int64)
        self._waiting: list[int] = []
        # Bare Zenoh calls from several threads.
        self._lock = threading.Lock()

    def add_one(self, delay_ns: int) -> None:
        """Take one delay [ns]; it is binned with others."""
        with self._lock:
            self._waiting.append(delay_ns)
            if len(self._waiting) >= self.WAITING:
                self.flush()

    def flush(self) -> None:
        """Bin what waits."""
        self.add(np.array(self._waiting, np.int64))
        self._waiting.clear()

    def add(self, delays_ns: NDArray[np.int64]) -> None:
        """Take delays (m,) [ns]."""
        bins = np.searchsorted(self.EDGES_MS, 1e-6 * delays_ns)
        self.counts += np.bincount(bins, minlength=len(self.counts))

    @property
    def messages(self) -> int:
        """How many there are."""
        return int(self.counts.sum())


def percentile_ms(delays: Sequence[Delays], share: float) -> float:
    """Return a percentile of all delays, the upper edge of its bin [ms]."""
    total = np.cumsum(sum(each.counts for each in delays))
    at = int(np.searchsorted(total, share / 100.0 * total[-1]))
    return float(Delays.EDGES_MS[min(at, len(Delays.EDGES_MS) - 1)])


class Heard(NamedTuple):
    """What reached the listener: delays of messages, rows, its CPU time [s] and memory [kB]."""

    delays: Delays
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
    endpoint, delays = free_endpoint(), Delays()

    def hear(payload: bytes) -> None:
        delays.add_one(time.monotonic_ns() - BARE.unpack_from(payload)[2])

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
    delays.flush()
    cpu_s = time.process_time() - cpu_s
    return Round(Heard(delays, BATCH * delays.messages, cpu_s), sent)


def _product_round(seconds: float, boot: int) -> Round:
    """Hear by messenger and recording, as a session does; rows are forgotten, as monitoring does."""
    endpoint, recording, delays = free_endpoint(), Recording(), Delays()
    # The memory when half of the messages have come: by then what is kept of each module has been filled.
    half, early_kb = 0.5 * MODULES * seconds / PERIOD_S / BATCH, 0

    def record(entry: Entry) -> object:
        return recording.accept(entry)

    def forget() -> None:
        nonlocal early_kb
        for module in recording.modules.values():
            row_ns, arrival_ns = module.arrivals.columns()
            delays.add(arrival_ns - row_ns)
            module.forget(RETAINED_ROWS, 0)
            module.arrivals.forget(0)
        if not early_kb and delays.messages >= half:
            early_kb = resident_kb()

    async def listen() -> Round:
        loop = asyncio.get_running_loop()
        transport = open_zenoh(ZenohConfig.hub(endpoint))
        messenger = Messenger(
            *(transport, ROBOT, time.monotonic_ns, loop.call_soon_threadsafe, record),
            time.thread_time_ns,
            COALESCED_S,
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
        rows = BATCH * delays.messages
        cost_us = messenger.cpu_us_per_message or 0.0
        print(f"  {cost_us:.1f} us a message on the event loop")
        heard = Heard(delays, rows, cpu_s, early_kb or resident_kb(), resident_kb())
        return Round(heard, publishers.sent())

    return asyncio.run(listen())


def _reported(rounds: dict[str, list[Round]]) -> None:
    p50, p99 = (
        {kind: percentile_ms([r.heard.delays for r in done], share) for kind, done in rounds.items()}
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
    grown_kb = max(h.late_kb - h.early_kb for h in heard)
    report(f"{what}: memory of the listener grows by", grown_kb, "kB", at_most=MOST_GROWN_KB)
    grown_kb = max(s.late_kb - s.early_kb for s in sent)
    report(f"{what}: memory of an agent grows by", grown_kb, "kB", at_most=AGENT_GROWN_KB)
    for kind, done in rounds.items():
        messages = sum(r.heard.delays.messages for r in done)
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

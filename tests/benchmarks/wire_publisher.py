"""One process of the wire's benchmark: modules publish 250 rows/s each in batches, by one of three means.

`product` makes the messages that agents make and sends them by the product's transport; `zenoh` and `zeromq`
send as many bytes by the bare libraries. Prints one line of JSON at the end.
"""

import json
import resource
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import zenoh
import zmq

from module_agent.transport.zenoh_transport import ZenohConfig, _session_config, open_zenoh
from module_agent.wire.codec import encode
from module_agent.wire.feedback_rows import ROW, pack_row
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import Feedback

ROBOT, PERIOD_S, BATCH = "bench", 0.004, 5
MESSAGE_BYTES = 570
# Of a bare message: module, first row, time of the newest row.
BARE = struct.Struct("<QQQ")
Send = Callable[[int, int, int], None]


class Sent(NamedTuple):
    """What a process did: rows of each module, its processor time, and its memory early and late [kB]."""

    rows: int
    cpu_s: float
    early_kb: int
    late_kb: int


def serial_of(number: int) -> str:
    return f"W-{number:05d}"


def resident_kb() -> int:
    """Return the memory that this process has in use."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() // 1024


def product(endpoint: str, boot: int) -> tuple[Send, Callable[[], None]]:
    """Send what agents send: each row packed when it is measured, five of them a message."""
    transport = open_zenoh(ZenohConfig(mode="client", connect=(endpoint,), connect_timeout_s=20.0))
    rings: dict[int, bytearray] = {}

    def send(number: int, row: int, t_ns: int) -> None:
        ring = rings.setdefault(number, bytearray(BATCH * ROW.itemsize))
        pack_row(ring, row % BATCH, (t_ns, t_ns, 0, 1, *(0.5 for _ in range(18))))
        if (row + 1) % BATCH == 0:
            serial = serial_of(number)
            first = row + 1 - BATCH
            rows = bytes(ring)
            message = Feedback(serial=serial, boot=boot, seq=row, first_row=first, count=BATCH, rows=rows)
            transport.publish(key(ROBOT, serial, Leaf.FEEDBACK), encode(message))

    return send, transport.close


def bare(endpoint: str, kind: str) -> tuple[Send, Callable[[], None]]:
    """Send as many bytes by a library alone."""
    padding = bytes(MESSAGE_BYTES - BARE.size)
    if kind == "zenoh":
        session = zenoh.open(_session_config(ZenohConfig(mode="client", connect=(endpoint,))))
        drop, publishers = zenoh.CongestionControl.DROP, dict[int, zenoh.Publisher]()

        def put(number: int, payload: bytes) -> None:
            if number not in publishers:
                publishers[number] = session.declare_publisher(f"bare/{number}", congestion_control=drop)
            publishers[number].put(payload)

        close: Callable[[], None] = session.close  # type: ignore[assignment]
    else:
        socket = zmq.Context.instance().socket(zmq.PUB)
        socket.connect(endpoint.replace("tcp/", "tcp://"))

        def put(number: int, payload: bytes) -> None:
            socket.send(payload, zmq.DONTWAIT)

        close = socket.close

    def send(number: int, row: int, t_ns: int) -> None:
        if (row + 1) % BATCH == 0:
            put(number, BARE.pack(number, row + 1 - BATCH, t_ns) + padding)

    return send, close


def publish(send: Send, numbers: range, seconds: float) -> Sent:
    """Publish rows of all modules every 4 ms, as the ticks of an agent do."""
    # Until the others hear.
    time.sleep(1.0)
    rows = round(seconds / PERIOD_S) // BATCH * BATCH
    cpu_s, begun_s, early_kb = time.process_time(), time.monotonic(), 0
    for row in range(rows):
        time.sleep(max(0.0, begun_s + row * PERIOD_S - time.monotonic()))
        t_ns = time.monotonic_ns()
        for number in numbers:
            send(number, row, t_ns)
        if row == rows // 2:
            early_kb = resident_kb()
    spent_s = time.process_time() - cpu_s
    time.sleep(0.5)
    return Sent(rows, spent_s, early_kb, resident_kb())


def main(kind: str, endpoint: str, first: str, count: str, seconds: str, boot: str) -> None:
    send, close = product(endpoint, int(boot)) if kind == "product" else bare(endpoint, kind)
    sent = publish(send, range(int(first), int(first) + int(count)), float(seconds))
    print(json.dumps(sent._asdict()), flush=True)
    close()


if __name__ == "__main__":
    main(*sys.argv[1:])

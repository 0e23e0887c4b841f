"""Looking at a robot without holding it: who is there, and stopping all of them."""

import queue
import time
from collections.abc import Sequence
from typing import NamedTuple

from module_agent.transport.transport import Event, Liveness, Reply, Transport
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf, every, key, parse
from module_agent.wire.messages import Ack, Ask, Status, Stop
from module_agent.wire.refusal import WireError

ANSWER_S = 1.0


class Search(NamedTuple):
    """How long to look for modules: until nothing was heard for `quiet_s`, and for `least_s` at least.

    With `expect` the search ends as soon as so many are there.
    """

    quiet_s: float = 1.0
    least_s: float = 0.0
    expect: int | None = None


# Agents without a hub look for one once a second, and each try lasts a second: whoever becomes their hub
# waits for them.
AS_HUB_S = 2.5
MAX_S = 10.0


def _present(transport: Transport, robot: str, search: Search) -> list[str]:
    events: queue.SimpleQueue[Event] = queue.SimpleQueue()
    watch = transport.watch_alive(every(robot, Leaf.ALIVE), events.put)
    alive: dict[str, bool] = {}
    start = heard = time.monotonic()
    while search.expect is None or sum(alive.values()) < search.expect:
        end = min(max(start + search.least_s, heard + search.quiet_s), start + MAX_S)
        try:
            event = events.get(timeout=max(0.0, end - time.monotonic()))
        except queue.Empty:
            break
        if isinstance(event, Liveness):
            alive[parse(event.key).serial] = event.alive
            heard = time.monotonic()
    watch.undeclare()
    return sorted(serial for serial, here in alive.items() if here)


def _ask_all(
    transport: Transport, robot: str, leaf: Leaf, questions: Sequence[tuple[str, bytes]]
) -> dict[str, bytes]:
    events: queue.SimpleQueue[Event] = queue.SimpleQueue()
    for tag, (serial, payload) in enumerate(questions):
        transport.query(key(robot, serial, leaf), payload, ANSWER_S, events.put, tag)
    answers: dict[str, bytes] = {}
    for _ in questions:
        event = events.get(timeout=ANSWER_S + 5.0)
        if isinstance(event, Reply) and event.payload is not None:
            answers[parse(event.key).serial] = event.payload
    return answers


def listed(transport: Transport, robot: str, search: Search) -> tuple[list[Status], list[str]]:
    """Return the statuses, and the serials that gave no answer to read. Closes the transport."""
    try:
        serials = _present(transport, robot, search)
        questions = [(s, encode(Ask(serial=s, boot=0, seq=1, sender="list"))) for s in serials]
        answers = _ask_all(transport, robot, Leaf.STATUS, questions)
    finally:
        transport.close()
    statuses = [status for s in serials if s in answers if (status := _status(answers[s])) is not None]
    known = [status.serial for status in statuses]
    return statuses, [s for s in serials if s not in known]


def _status(payload: bytes) -> Status | None:
    try:
        return decode(Status, payload)
    except WireError:
        return None  # its serial is then among those that gave no answer to read


def stop_robot(transport: Transport, robot: str, sender: str, search: Search) -> tuple[list[str], list[str]]:
    """Stop every module; return the serials that confirmed and those that did not. Closes the transport."""
    try:
        serials = _present(transport, robot, search)
        questions = [
            (s, encode(Stop(serial=s, boot=0, seq=1, sender=sender, why="stop command"))) for s in serials
        ]
        answers = _ask_all(transport, robot, Leaf.STOP, questions)
        stopped = [s for s in serials if s in answers and _accepted(answers[s])]
        return stopped, [s for s in serials if s not in stopped]
    finally:
        transport.close()


def _accepted(payload: bytes) -> bool:
    try:
        return decode(Ack, payload).accepted
    except WireError:
        return False

"""Looking at a robot without holding it: who is there, and stopping all of them."""

import queue
import time
from collections.abc import Sequence

from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf, every, key, parse
from module_agent.wire.messages import Ack, Ask, Status, Stop
from module_agent.wire.refusal import WireError
from module_agent.wire.transport import Event, Liveness, Reply, Transport

SEARCH_S = 1.0
ANSWER_S = 1.0


def _present(transport: Transport, robot: str) -> list[str]:
    events: queue.SimpleQueue[Event] = queue.SimpleQueue()
    watch = transport.watch_alive(every(robot, Leaf.ALIVE), events.put)
    alive: dict[str, bool] = {}
    end = time.monotonic() + SEARCH_S
    while (left := end - time.monotonic()) > 0:
        try:
            event = events.get(timeout=left)
        except queue.Empty:
            break
        if isinstance(event, Liveness):
            alive[parse(event.key).serial] = event.alive
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


def listed(transport: Transport, robot: str) -> list[Status]:
    """Return the status of every module that answers; closes the transport."""
    try:
        serials = _present(transport, robot)
        questions = [(s, encode(Ask(serial=s, boot=0, seq=1, sender="list"))) for s in serials]
        answers = _ask_all(transport, robot, Leaf.STATUS, questions)
        return [decode(Status, answers[s]) for s in serials if s in answers]
    finally:
        transport.close()


def stop_robot(transport: Transport, robot: str, sender: str) -> tuple[list[str], list[str]]:
    """Stop every module; return the serials that confirmed and those that did not. Closes the transport."""
    try:
        serials = _present(transport, robot)
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

"""Discovery of the modules of a robot, and the commands that need no lease: list and stop."""

import asyncio
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple, TypeVar

from coordinator.live_robot.messenger import INBOX_BYTES, LANE_BYTES, Clock, Messenger, NoAnswer, Refused
from coordinator.recording.recording import Entry, Recording
from module_agent.model.errors import RobotError
from module_agent.transport.inbox import Inbox
from module_agent.transport.transport import Event, Liveness, Reply, Sample, Transport
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.keys import Leaf, every, key, parse
from module_agent.wire.messages import Ack, Ask, Identify, Info, Message, Status
from module_agent.wire.refusal import WireError

ANSWER_S = 1.0
# Feedback is heard for this long to tell its delay, and its clocks are mapped by so many requests.
LISTEN_S = 1.0
TRIPS = 5
POLL_S = 0.02

Request = Callable[[str], Message]
M = TypeVar("M", bound=Message)


# Ends the sentence that a robot is not there.
IS_IT_THERE = ": is that its name (--robot), do its agents run, and do they connect here?"


class Search(NamedTuple):
    """How long to wait for modules: until none has come or left for `quiet_s`, at least `min_s`.

    The first is waited for longer, `first_s`: that a robot is not there must not be said of a slow network.
    With `expect` the search ends as soon as so many are present.
    """

    quiet_s: float = 1.0
    min_s: float = 0.0
    first_s: float = 4.0
    expect: int | None = None


# Agents without a hub look for one every second, for a second: their new hub waits for them.
AS_HUB_S = 2.5
MAX_S = 10.0


async def await_modules(
    messenger: Messenger,
    clock: Clock,
    complete: Callable[[frozenset[str], float], bool],
    timeout_s: float = float("inf"),
    poll_s: float = POLL_S,
) -> frozenset[str]:
    """Wait until `complete(present, quiet_s)`, or until the time is up; return the serials present.

    present: the modules whose liveliness token is on the network. quiet_s: time since one came or left.
    """
    start_ns = changed_ns = clock()
    present = frozenset[str]()
    while True:
        if messenger.alive != present:
            present, changed_ns = frozenset(messenger.alive), clock()
        now_ns = clock()
        if complete(present, (now_ns - changed_ns) / 1e9) or now_ns - start_ns >= 1e9 * timeout_s:
            return present
        await asyncio.sleep(poll_s)


class _Arrivals:
    """Events with the times of their arrival [ns], which one thread waits for; bounded as an `Inbox` is."""

    def __init__(self) -> None:
        self._inbox = Inbox(MAX_MESSAGE_BYTES, LANE_BYTES, INBOX_BYTES)
        self._arrived = threading.Event()

    def put(self, event: Event) -> None:
        """Take an event in, from any thread."""
        self._inbox.put(event, time.monotonic_ns())
        self._arrived.set()

    def get(self, timeout_s: float) -> tuple[int, Event] | None:
        """Return the next event and its time; None if there is none within the time."""
        end_s = time.monotonic() + timeout_s
        while True:
            # Before the look: what arrives after it sets it again. It may be that of an event taken already.
            self._arrived.clear()
            if taken := self._inbox.drain_stamped(limit=1):
                return taken[0]
            if not self._arrived.wait(max(0.0, end_s - time.monotonic())):
                return None


class _Presence:
    """The modules of which there are tokens, and until when others are waited for (`Search`)."""

    def __init__(self, search: Search):
        self._search = search
        self._alive: dict[str, bool] = {}
        self._start_s = self._changed_s = time.monotonic()

    @property
    def serials(self) -> list[str]:
        """Those that are there now, sorted."""
        return sorted(serial for serial, present in self._alive.items() if present)

    @property
    def is_complete(self) -> bool:
        """Whether as many are there as are expected."""
        return self._search.expect is not None and sum(self._alive.values()) >= self._search.expect

    @property
    def until_s(self) -> float:
        """Until when others are waited for, by `time.monotonic`."""
        quiet_s = self._search.quiet_s if self._alive else self._search.first_s
        end_s = max(self._start_s + self._search.min_s, self._changed_s + quiet_s)
        return min(end_s, self._start_s + MAX_S)

    def take(self, event: Event) -> str | None:
        """Take note of a token; return the serial of a module that has come."""
        if not isinstance(event, Liveness):
            return None
        try:
            serial = parse(event.key).serial
        except WireError:  # the token of something that is no module
            return None
        self._alive[serial], self._changed_s = event.alive, time.monotonic()
        return serial if event.alive else None


def _present(transport: Transport, robot: str, search: Search) -> list[str]:
    events, presence = _Arrivals(), _Presence(search)
    declared = transport.watch_alive(every(robot, Leaf.ALIVE), events.put)
    while not presence.is_complete:
        arrived = events.get(max(0.0, presence.until_s - time.monotonic()))
        if arrived is None:
            break
        presence.take(arrived[1])
    declared.undeclare()
    return presence.serials


def _ask_all(
    transport: Transport, robot: str, search: Search, leaf: Leaf, request: Request, expected: type[M]
) -> tuple[list[str], dict[str, M]]:
    """Return the serials present, and their answers as far as readable. Closes the transport."""
    events = _Arrivals()
    answers: dict[str, M] = {}
    try:
        serials = _present(transport, robot, search)
        for tag, serial in enumerate(serials):
            transport.query(key(robot, serial, leaf), encode(request(serial)), ANSWER_S, events.put, tag)
        for _ in serials:
            arrived = events.get(ANSWER_S + 5.0)
            if arrived is not None and isinstance(event := arrived[1], Reply) and event.payload is not None:
                with suppress(WireError):
                    answers[parse(event.key).serial] = decode(expected, event.payload)
    finally:
        transport.close()
    return serials, answers


class Listing(NamedTuple):
    """What `listed` found.

    silent: serials without a readable answer. recording: the feedback and the round trips of the search, on
    this process's steady clock. cpu_us_per_message: processor time of the process for each message received.
    """

    statuses: list[Status]
    silent: list[str]
    recording: Recording
    cpu_us_per_message: float | None


def listed(transport: Transport, robot: str, search: Search, listen_s: float = LISTEN_S) -> Listing:
    """Ask all modules what they are, and for their status several times while they are heard for `listen_s`.

    Closes the transport.
    """
    events = _Arrivals()
    recording, received = Recording(), 0

    def take_until(end_s: float, complete: Callable[[], bool] = lambda: False) -> None:
        nonlocal received
        while not complete() and (left_s := end_s - time.monotonic()) > 0.0:
            arrived = events.get(left_s)
            if arrived is not None:
                received += 1
                _record(recording, open_tags, *arrived)

    open_tags: set[int] = set()

    def ask(serial: str, leaf: Leaf, tag: int) -> None:
        topic, payload = key(robot, serial, leaf), encode(_ask(serial, tag))
        open_tags.add(tag)
        recording.accept(Entry("request", topic, time.monotonic_ns(), payload))
        transport.query(topic, payload, ANSWER_S, events.put, tag)

    try:
        serials = _present(transport, robot, search)
        begun_s, cpu_s = time.monotonic(), time.process_time()
        transport.subscribe(every(robot, Leaf.FEEDBACK), events.put)
        for number in range(TRIPS):
            for place, serial in enumerate(serials):
                ask(serial, Leaf.STATUS, number * len(serials) + place + 1)
            take_until(begun_s + listen_s * (number + 1) / TRIPS)
        # Afterwards: a longer answer would be in the delays.
        for place, serial in enumerate(serials):
            ask(serial, Leaf.INFO, TRIPS * len(serials) + place + 1)
        take_until(time.monotonic() + ANSWER_S + 5.0, lambda: not open_tags)
        cpu_s = time.process_time() - cpu_s
    finally:
        transport.close()
    found = {s: module.status for s, module in recording.modules.items() if module.status is not None}
    statuses = [status for serial in serials if (status := found.get(serial)) is not None]
    silent = [serial for serial in serials if serial not in found]
    return Listing(statuses, silent, recording, 1e6 * cpu_s / received if received else None)


def _ask(serial: str, seq: int) -> Ask:
    return Ask(serial=serial, boot=0, seq=seq, sender="list")


def _record(recording: Recording, open_tags: set[int], t_ns: int, event: Event) -> None:
    """Add an event to a recording; a reply closes its tag."""
    if isinstance(event, Reply):
        open_tags.discard(event.tag)
        if event.payload is not None:
            recording.accept(Entry("reply", event.key, t_ns, event.payload))
    elif isinstance(event, Sample):
        recording.accept(Entry("publication", event.key, t_ns, event.payload))


def described(transport: Transport, robot: str, search: Search) -> tuple[list[Info], list[str]]:
    """Return what modules tell of themselves, and the serials without an answer. Closes the transport."""

    def request(serial: str) -> Ask:
        return Ask(serial=serial, boot=0, seq=1, sender="gains")

    serials, answers = _ask_all(transport, robot, search, Leaf.INFO, request, Info)
    return [answers[s] for s in serials if s in answers], [s for s in serials if s not in answers]


def light_led(transport: Transport, robot: str, serial: str, sender: str, on: bool, search: Search) -> None:
    """Light a module's LED, or give it back to the module. Leaves the transport open.

    Raises:
        RobotError: there is no such module, or it does not confirm.
    """
    if on and serial not in (there := _present(transport, robot, search)):
        raise RobotError(f"no module {serial} of robot {robot!r}; there are {', '.join(there) or 'none'}")
    events = _Arrivals()
    request = encode(Identify(serial=serial, boot=0, seq=1, sender=sender, on=on))
    transport.query(key(robot, serial, Leaf.IDENTIFY), request, ANSWER_S, events.put, 0)
    arrived = events.get(ANSWER_S + 5.0)
    event = None if arrived is None else arrived[1]
    if not isinstance(event, Reply) or event.payload is None:
        raise RobotError(f"module {serial} does not confirm that its LED is {'lit' if on else 'off'}")
    try:
        ack = decode(Ack, event.payload)
    except WireError as error:
        raise RobotError(f"the answer of module {serial} cannot be read: {error}") from error
    if ack.serial != serial or (ack.re != 1 and (ack.accepted or ack.re)):
        raise RobotError(f"what module {serial} answers is no answer to the question: {ack.serial}, {ack.re}")
    if not ack.accepted:
        raise RobotError(f"module {serial} refuses: {ack.reason}: {ack.detail}")


def stop_robot(transport: Transport, robot: str, sender: str, search: Search) -> tuple[list[str], list[str]]:
    """Stop every module; return the serials that confirmed and those that did not. Closes the transport."""
    try:
        confirmed = asyncio.run(_stop_all(transport, robot, sender, search))
    finally:
        transport.close()
    stopped = [serial for serial, stops in confirmed.items() if stops]
    return stopped, [serial for serial in confirmed if serial not in stopped]


async def _stop_all(transport: Transport, robot: str, sender: str, search: Search) -> dict[str, bool]:
    """Stop every module as soon as it is seen; return which confirm, by serial in their order.

    The search for more goes on meanwhile: a module that makes it last, as it comes and goes, delays no stop.
    """
    post = asyncio.get_running_loop().call_soon_threadsafe
    messenger = Messenger(transport, robot, time.monotonic_ns, post, Recording().accept)
    presence, stops = _Presence(search), dict[str, asyncio.Task[bool]]()

    async def confirms(serial: str) -> bool:
        try:
            await messenger.stop(serial, sender, "stop command")
        except (NoAnswer, Refused):
            return False
        return True

    events = _Arrivals()
    declared = transport.watch_alive(every(robot, Leaf.ALIVE), events.put)
    while not presence.is_complete and time.monotonic() < presence.until_s:
        arrived = events.get(0.0)
        serial = presence.take(arrived[1]) if arrived is not None else None
        if serial is not None and serial not in stops:
            stops[serial] = asyncio.create_task(confirms(serial))
        # Between two tokens the stops of those before go out.
        await asyncio.sleep(POLL_S if arrived is None else 0.0)
    declared.undeclare()
    confirmed = {serial: await stops[serial] for serial in sorted(stops)}
    there = {*presence.serials}
    return {serial: stopped for serial, stopped in confirmed.items() if stopped or serial in there}

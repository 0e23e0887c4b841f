"""The coordinator's asyncio interface to a transport: publications, requests and replies, all recorded.

Clock and event loop are arguments, so that the same code runs in real and in virtual time.

Where a thread of the transport receives, each message that wakes the event loop costs more than what is done
with it. So while publications come they are looked for every `COALESCED_S`, and only the first after a pause
wakes the loop; answers and liveliness always do. Loops that control by what they hear do without. Measured
with 3,200 messages a second on two busy cores, with and without in turn, medians of three: 176 us of
processor time a message instead of 216, and 99 % of delays from the sample to the coordinator's thread within
4.4 ms instead of 8.1, as the two threads wait less for the interpreter.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Coroutine, Iterable
from typing import NamedTuple

from coordinator.recording.recording import MAX_MODULES, Entry
from module_agent.model.errors import RobotError
from module_agent.transport.inbox import Inbox
from module_agent.transport.transport import (
    CLOSED,
    Event,
    Liveness,
    Reply,
    Sample,
    Transport,
    Undeclare,
)
from module_agent.wire.codec import MAX_MESSAGE_BYTES, encode
from module_agent.wire.keys import Leaf, every, key, parse
from module_agent.wire.messages import Ack, LeaseRequest, Message, Stop, cut
from module_agent.wire.proof import proven
from module_agent.wire.refusal import WireError
from module_agent.wire.topics import HEARD_BY_COORDINATOR

Clock = Callable[[], int]
"""Returns session time in integer nanoseconds; it never goes back."""


Post = Callable[[Callable[[], None]], object]
# Of one module's key, and of all: 40 s of feedback, and 30 s of that of 64 modules.
LANE_BYTES, INBOX_BYTES = 1 << 21, 1 << 26
STOP_ATTEMPTS, STOP_ANSWER_S = 3, 0.3
# Less than a row's period at 250 Hz. The system waits for whole milliseconds of real time, at least one.
COALESCED_S = 0.002
Record = Callable[[Entry], Message | None]


class Sender(NamedTuple):
    """Who commands: a unique name, and the secret that proves that a command is of the lease's holder."""

    name: str
    secret: bytes = b""


class NoAnswer(RobotError):
    """A module did not answer; the message says which, on what, and why."""

    def __init__(self, serial: str, leaf: Leaf, why: str):
        super().__init__(f"module {serial} did not answer on {leaf.value}: {why or 'no reply'}")
        self.serial = serial


class Refused(RobotError):
    """A module refused a command; the message names the reason."""

    def __init__(self, serial: str, leaf: Leaf, ack: Ack):
        super().__init__(f"module {serial} refused {leaf.value}: {ack.reason}: {ack.detail}")
        self.serial = serial
        self.ack = ack


class Messenger:
    """Publishes, sends requests and receives for the coordinator; every message passes through `record`.

    `alive`: serials of the modules on the network, of as many as a recording takes. `post` runs a function on
    the event loop from any thread (`call_soon_threadsafe` in real time). `cpu_clock` returns the processor
    time of the event loop's thread [ns]. With `coalesced_s` [s] publications may wait so long for the event
    loop, see above; their times of arrival are those of the network all the same.
    """

    def __init__(
        self,
        transport: Transport,
        robot: str,
        clock: Clock,
        post: Post,
        record: Record,
        cpu_clock: Clock | None = None,
        coalesced_s: float | None = None,
    ):
        self.robot = robot
        self.alive: set[str] = set()
        self._transport = transport
        self._clock = clock
        self._post = post
        self._record = record
        self._inbox = Inbox(MAX_MESSAGE_BYTES, LANE_BYTES, INBOX_BYTES)
        # Taken out of the inbox, and not handled yet.
        self._taken: deque[tuple[int, Event]] = deque()
        # Whether a drain is under way to the event loop, and whether it will look by itself.
        self._draining = False
        self._looking = False
        self._coalesced_s = coalesced_s
        self._closed = False
        self._pending: dict[int, asyncio.Future[tuple[Reply, int]]] = {}
        self._declared: list[Undeclare] = []
        self._tag = 0
        self._seq = 0
        self._cpu_clock = cpu_clock
        self._cpu_ns = 0
        self._received = 0

    @property
    def cpu_us_per_message(self) -> float | None:
        """Processor time of what is done with a received message, in the mean; None without a `cpu_clock`."""
        measured = self._cpu_clock is not None and self._received > 0
        return 1e-3 * self._cpu_ns / self._received if measured else None

    @property
    def dropped(self) -> int:
        """Events lost because the loop did not keep up."""
        return self._inbox.dropped

    def start(self) -> None:
        """Begin to listen."""
        for leaf in HEARD_BY_COORDINATOR:
            self._declared.append(self._transport.subscribe(every(self.robot, leaf), self._sink))
        self._declared.append(self._transport.watch_alive(every(self.robot, Leaf.ALIVE), self._sink))

    def next_seq(self) -> int:
        """Return a sequence number larger than all before."""
        self._seq += 1
        return self._seq

    def _sink(self, event: Event) -> None:
        # Now, and not when the event loop comes to it: round trips and delays are those of the network.
        self._inbox.put(event, self._clock())
        if not self._draining and not (self._looking and isinstance(event, Sample)):
            self._draining = True
            self._post(self._drain)

    def _look(self) -> None:
        """See whether publications have come since the last drain; if not, the next one wakes the loop."""
        # Before the look: what comes after it wakes the loop.
        self._looking = False
        if self._inbox.waiting:
            self._drain()

    def _drain(self) -> None:
        if self._coalesced_s is not None and not self._looking:
            self._looking = True
            asyncio.get_running_loop().call_later(self._coalesced_s, self._look)
        self._draining = False
        begun_ns = self._cpu_clock() if self._cpu_clock is not None else 0
        # A few at a time: after a stall the keep-alives that are due must not wait for the whole inbox.
        if not self._taken:
            self._taken.extend(self._inbox.drain_stamped(limit=32))
        # What was left there is taken next, and does not wait: answers may be among it.
        behind = self._inbox.waiting
        try:
            while self._taken:
                self._received += 1
                t_ns, event = self._taken.popleft()
                self._handle(event, t_ns)
        finally:
            # After an error too: the answers behind what could not be recorded are waited for.
            if self._cpu_clock is not None:
                self._cpu_ns += self._cpu_clock() - begun_ns
            left = self._taken or behind or (self._inbox.waiting and not self._looking)
            if left and not self._draining:
                self._draining = True
                self._post(self._drain)

    def _handle(self, event: Event, t_ns: int) -> None:
        if self._closed:
            # A closed recording must not change any more; pending requests end with an error.
            if isinstance(event, Reply):
                self._answer(event._replace(payload=None, error=CLOSED), t_ns)
        elif isinstance(event, Sample | Liveness) and not _is_of_a_module(event.key):
            return
        elif isinstance(event, Sample):
            self._record(Entry("publication", event.key, t_ns, event.payload))
        elif isinstance(event, Liveness):
            serial = parse(event.key).serial
            if not event.alive:
                self.alive.discard(serial)
            elif len(self.alive) < MAX_MODULES:
                self.alive.add(serial)
        elif isinstance(event, Reply):
            self._answer(event, t_ns)

    def _answer(self, reply: Reply, t_ns: int) -> None:
        future = self._pending.pop(reply.tag, None)
        if future is not None and not future.done():
            future.set_result((reply, t_ns))

    def publish(self, serial: str, leaf: Leaf, message: Message, secret: bytes = b"") -> None:
        """Publish on a module's key, with the proof of the secret of a lease."""
        self._transport.publish(key(self.robot, serial, leaf), proven(encode(message), secret))

    async def ask(
        self, serial: str, leaf: Leaf, message: Message, timeout_s: float = 0.5, secret: bytes = b""
    ) -> Message:
        """Ask a module, with the proof of the secret of a lease; return its answer, which may be a refusal.

        Raises:
            NoAnswer: no answer within the time, or an unreadable one.
        """
        topic, payload = key(self.robot, serial, leaf), proven(encode(message), secret)
        self._tag += 1
        tag = self._tag
        future: asyncio.Future[tuple[Reply, int]] = asyncio.get_running_loop().create_future()
        self._pending[tag] = future
        try:
            sent_ns = self._clock()
            # First: whatever becomes of the recording, a stop goes out. Its answer waits for the event loop.
            self._transport.query(topic, payload, timeout_s, self._sink, tag)
            self._record(Entry("request", topic, sent_ns, _recorded(message, payload)))
            reply, t_ns = await future
        finally:
            self._pending.pop(tag, None)
        if reply.payload is None:
            raise NoAnswer(serial, leaf, reply.error)
        answer = self._record(Entry("reply", topic, t_ns, reply.payload))
        if answer is None:
            raise NoAnswer(serial, leaf, "its answer could not be read")
        return answer

    async def command(
        self, serial: str, leaf: Leaf, message: Message, timeout_s: float = 0.5, secret: bytes = b""
    ) -> Ack:
        """Send a command, see `ask`; return the module's acknowledgement.

        Raises:
            Refused: the module refused it.
            NoAnswer: see `ask`.
        """
        answer = await self.ask(serial, leaf, message, timeout_s, secret)
        if not isinstance(answer, Ack):
            raise NoAnswer(serial, leaf, f"its answer is {type(answer).__name__}, not Ack")
        # A module that refuses a command may not have read its number.
        if answer.re != message.seq and (answer.accepted or answer.re):
            raise NoAnswer(serial, leaf, f"it answers command {answer.re}, asked was {message.seq}")
        if not answer.accepted:
            raise Refused(serial, leaf, answer)
        return answer

    async def stop(self, serial: str, sender: str, why: str) -> None:
        """Stop a module, which needs no lease; asked again while no answer comes, as a network may lose it.

        Raises:
            Refused, NoAnswer: see `command`.
        """
        for left in reversed(range(STOP_ATTEMPTS)):
            stop = Stop(serial=serial, boot=0, seq=self.next_seq(), sender=sender, why=cut(why))
            try:
                await self.command(serial, Leaf.STOP, stop, STOP_ANSWER_S)
                return
            except NoAnswer:
                if not left:
                    raise

    def close(self) -> None:
        """Stop receiving and leave the network; messages that are not recorded yet are dropped."""
        self._closed = True
        for declared in reversed(self._declared):
            declared.undeclare()
        self._declared.clear()
        self._transport.close()


async def gather_all(work: Iterable[Coroutine[None, None, object]]) -> None:
    """Run all coroutines concurrently to their end; then raise the first error, if any."""
    for outcome in await asyncio.gather(*work, return_exceptions=True):
        if isinstance(outcome, BaseException):
            raise outcome


def _recorded(message: Message, payload: bytes) -> bytes:
    """Return what is recorded of a request: who reads a recording is not to learn the secret of a lease."""
    if isinstance(message, LeaseRequest) and message.secret:
        return encode(message.model_copy(update={"secret": b""}))
    return payload


def _is_of_a_module(text: str) -> bool:
    """Return whether a key is one of this system: anybody may publish what matches an expression of it."""
    try:
        parse(text)
    except WireError:
        return False
    return True

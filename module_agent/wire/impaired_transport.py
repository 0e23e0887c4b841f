"""A transport whose network misbehaves: latency, jitter, loss, reordering and duplication around any other.

Every message crosses exactly one wrapper, that of the endpoint that receives it: samples, requests, and the
replies to this endpoint's queries. What this endpoint sends goes out untouched.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from module_agent.wire.network_profile import NetworkProfile
from module_agent.wire.query_errors import CLOSED, TIMEOUT
from module_agent.wire.scheduler import Scheduler
from module_agent.wire.transport import (
    Event,
    Liveness,
    Reply,
    Request,
    Sample,
    Sink,
    Transport,
    TransportError,
    Undeclare,
)

# A lost request stays referenced this long: a transport may tell the asker at once that nobody answers when
# the request is garbage collected, and the loss would not look like one. Longer than any time-out in use.
_LOST_REQUEST_S = 30.0
_BLOCK = 256


class DropCounts(NamedTuple):
    """What an endpoint lost so far, by kind."""

    samples: int
    requests: int
    replies: int


class _Fate(NamedTuple):
    """What happens to one message; `copy_delay_s` is that of its duplicate, None without one."""

    lost: bool
    reordered: bool
    delay_s: float
    copy_delay_s: float | None


class _Flow:
    """Messages of one key in order: each waits for its own time and for those before it, as on a TCP link."""

    def __init__(self) -> None:
        self._queue: deque[list[object]] = deque()

    def enter(self) -> list[object]:
        entry: list[object] = [None]
        self._queue.append(entry)
        return entry

    def ripen(self, entry: list[object], deliver: Callable[[], None]) -> list[Callable[[], None]]:
        """Mark an entry's time as come; return what may be delivered now, in order."""
        entry[0] = deliver
        ready: list[Callable[[], None]] = []
        while self._queue and callable(first := self._queue[0][0]):
            self._queue.popleft()
            ready.append(first)
        return ready

    @property
    def empty(self) -> bool:
        return not self._queue


class _Declaration:
    """A declaration of the inner transport; events still on their way end with it."""

    def __init__(self, sink: Sink):
        self._sink: Sink | None = sink
        self._inner: Undeclare | None = None

    def hold(self, inner: Undeclare) -> "_Declaration":
        self._inner = inner
        return self

    def deliver(self, event: Event) -> None:
        sink = self._sink
        if sink is not None:
            sink(event)

    def undeclare(self) -> None:
        self._sink = None
        inner, self._inner = self._inner, None
        if inner is not None:
            inner.undeclare()


class _Question:
    """A query under way; whatever comes first, answer or time-out, is its one reply."""

    def __init__(self, tag: int, key: str, sink: Sink):
        self.tag = tag
        self.key = key
        self._sink: Sink | None = sink
        self._lock = threading.Lock()

    def withdraw(self) -> Sink | None:
        with self._lock:
            sink, self._sink = self._sink, None
        return sink

    def finish(self, reply: Reply) -> None:
        sink = self.withdraw()
        if sink is not None:
            sink(reply)


class _Once:
    """The reply function of a request that may arrive twice: only the first answer goes out."""

    def __init__(self, reply: Callable[[bytes], None]):
        self._reply: Callable[[bytes], None] | None = reply
        self._lock = threading.Lock()

    def __call__(self, payload: bytes) -> None:
        with self._lock:
            reply, self._reply = self._reply, None
        if reply is not None:
            reply(payload)


class ImpairedTransport:
    """Wraps a transport and impairs what its endpoint receives, as `profile` says.

    Order is kept per key and kind of message but for the fraction `reorder`. Lost requests and replies end as
    a `Reply` with error "Timeout" when the query's time is up. A reply is never duplicated, and a duplicated
    request is answered once. Liveliness is delayed, in order, never lost; so are errors of queries, which no
    message carries, delivered as they come. The profile `none`, or any without delay, loss and duplicates,
    passes everything straight through.

    Thread-safe; the scheduler must run its calls one at a time.
    """

    def __init__(
        self, inner: Transport, profile: NetworkProfile, rng: np.random.Generator, scheduler: Scheduler
    ):
        self._inner = inner
        self._profile = profile
        self._scheduler = scheduler
        self._fates = _fates(profile, rng)
        self._passes = not (profile.delay_ms or profile.jitter_ms or profile.loss or profile.duplicate)
        self._lock = threading.Lock()
        self._closed = False
        self._flows: dict[tuple[str, str], _Flow] = {}
        self._questions: dict[_Question, None] = {}
        self._dropped = {"sample": 0, "request": 0, "reply": 0}

    @property
    def drops(self) -> DropCounts:
        """What was lost so far at this endpoint."""
        with self._lock:
            return DropCounts(self._dropped["sample"], self._dropped["request"], self._dropped["reply"])

    def publish(self, key: str, payload: bytes) -> None:
        """Send to all subscribers, untouched."""
        self._inner.publish(key, payload)

    def subscribe(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver samples late, not at all, out of order or twice."""
        if self._passes:
            return self._inner.subscribe(key_expr, sink)
        declaration = _Declaration(sink)

        def on_sample(event: Event) -> None:
            assert isinstance(event, Sample)
            self._impair("sample", event.key, lambda: declaration.deliver(event))

        return declaration.hold(self._inner.subscribe(key_expr, on_sample))

    def serve(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver requests late, not at all, out of order or twice; the answers go out untouched."""
        if self._passes:
            return self._inner.serve(key_expr, sink)
        declaration = _Declaration(sink)

        def on_request(event: Event) -> None:
            assert isinstance(event, Request)
            request = event._replace(reply=_Once(event.reply))
            arrives = self._impair("request", event.key, lambda: declaration.deliver(request))
            if not arrives:
                self._scheduler.call_later(_LOST_REQUEST_S, lambda: _let_go(event))

        return declaration.hold(self._inner.serve(key_expr, on_request))

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        """Ask; the answer comes late or, if it is lost or too late, as the error "Timeout"."""
        if self._passes:
            self._inner.query(key, payload, timeout_s, sink, tag)
            return
        question = _Question(tag, key, sink)
        with self._lock:
            if self._closed:
                raise TransportError(f"cannot query {key}: {CLOSED}")
            self._questions[question] = None
        try:
            self._inner.query(key, payload, timeout_s, lambda event: self._on_reply(question, event), tag)
        except TransportError:
            self._forget(question)
            # Closing meanwhile has answered it.
            if question.withdraw() is not None:
                raise
        self._scheduler.call_later(timeout_s, lambda: self._finish(question, Reply(tag, key, None, TIMEOUT)))

    def declare_alive(self, key: str) -> Undeclare:
        """Hold a liveliness token while this session lives."""
        return self._inner.declare_alive(key)

    def watch_alive(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver changes of matching tokens late, in order, never lost."""
        if self._passes:
            return self._inner.watch_alive(key_expr, sink)
        declaration = _Declaration(sink)

        def on_liveness(event: Event) -> None:
            assert isinstance(event, Liveness)
            self._delay("liveness", event.key, lambda: declaration.deliver(event))

        return declaration.hold(self._inner.watch_alive(key_expr, on_liveness))

    def close(self) -> None:
        """Close the inner transport; messages under way are gone, queries under way get their `Reply`."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._flows.clear()
            questions, self._questions = list(self._questions), {}
        self._inner.close()
        for question in questions:
            question.finish(Reply(question.tag, question.key, None, CLOSED))

    def _on_reply(self, question: _Question, event: Event) -> None:
        assert isinstance(event, Reply)
        if event.payload is None:
            self._finish(question, event)
        else:
            self._impair("reply", event.key, lambda: self._finish(question, event))

    def _finish(self, question: _Question, reply: Reply) -> None:
        self._forget(question)
        question.finish(reply)

    def _forget(self, question: _Question) -> None:
        with self._lock:
            self._questions.pop(question, None)

    def _delay(self, kind: str, key: str, deliver: Callable[[], None]) -> None:
        with self._lock:
            if self._closed:
                return
            delay_s = next(self._fates).delay_s
            call = self._enter(kind, key, deliver)
        self._scheduler.call_later(delay_s, call)

    def _impair(self, kind: str, key: str, deliver: Callable[[], None]) -> bool:
        """Deliver as fate has it; return False when the message is lost."""
        with self._lock:
            if self._closed:
                return False
            fate = next(self._fates)
            if fate.lost:
                self._dropped[kind] += 1
                return False
            # The copy has its place in the queue right behind the original, as order goes but for `reorder`.
            route = self._past_queue if fate.reordered else self._enter
            calls = [(fate.delay_s, route(kind, key, deliver))]
            if fate.copy_delay_s is not None and kind != "reply":
                calls.append((fate.copy_delay_s, route(kind, key, deliver)))
        for delay_s, call in calls:
            self._scheduler.call_later(delay_s, call)
        return True

    def _past_queue(self, kind: str, key: str, deliver: Callable[[], None]) -> Callable[[], None]:
        def call() -> None:
            if not self._closed:
                deliver()

        return call

    def _enter(self, kind: str, key: str, deliver: Callable[[], None]) -> Callable[[], None]:
        """Queue behind the earlier messages of this key; return what is to be called at its own time."""
        flow = self._flows.setdefault((kind, key), _Flow())
        entry = flow.enter()

        def call() -> None:
            with self._lock:
                if self._closed:
                    return
                ready = flow.ripen(entry, deliver)
                if flow.empty and self._flows.get((kind, key)) is flow:
                    del self._flows[kind, key]
            for each in ready:
                each()

        return call


def _let_go(request: Request) -> None:
    """Hold the last reference to a lost request until here."""


def _fates(profile: NetworkProfile, rng: np.random.Generator) -> Iterator[_Fate]:
    """Yield one fate per message. Drawn in blocks, as scalar draws cost several times more."""
    scale_s = 1e-3 * profile.jitter_ms / profile.jitter_shape
    while True:
        chances = rng.random((_BLOCK, 3)).tolist()
        jitter_s = scale_s * rng.standard_gamma(profile.jitter_shape, (_BLOCK, 2))
        delays_s = (1e-3 * profile.delay_ms + jitter_s).tolist()
        for (loss, reorder, duplicate), (delay_s, copy_delay_s) in zip(chances, delays_s, strict=True):
            yield _Fate(
                loss < profile.loss,
                reorder < profile.reorder,
                delay_s,
                copy_delay_s if duplicate < profile.duplicate else None,
            )

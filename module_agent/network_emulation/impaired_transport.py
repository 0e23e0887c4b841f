"""A wrapper of any transport that delays, loses, stalls, cuts off, reorders and duplicates messages.

Every message crosses exactly one wrapper, that of the endpoint that receives it: samples, requests, and the
replies to this endpoint's queries. Messages that this endpoint sends pass unchanged, unless it is cut off.
`inject` puts a network profile between a program and its transport, in real time.
"""

import threading
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from module_agent.network_emulation.channel import Channel, OrderedFlow
from module_agent.network_emulation.partition import OwnToken, WatchedTokens
from module_agent.network_emulation.profile import NetworkProfile, Receiver
from module_agent.network_emulation.scheduler import Scheduler, TimerThread
from module_agent.transport.handles import Answer, Declaration, Question
from module_agent.transport.transport import (
    CLOSED,
    LEASE_S,
    TIMEOUT,
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

# A lost request stays referenced this long, longer than any time-out in use: when a request is garbage
# collected, a transport may report at once that there is no answer, which does not look like a loss.
_LOST_REQUEST_S = 30.0


class DropCounts(NamedTuple):
    """Messages that an endpoint lost so far, by kind; `sent` are those that it sent while cut off."""

    samples: int
    requests: int
    replies: int
    sent: int


class ImpairedTransport:
    """Wraps a transport and impairs the messages that its endpoint receives by one path of a profile.

    Order is kept per key and kind of message but for the fraction `reorder`. A stall holds up all messages of
    the endpoint together. Lost requests and replies end as a `Reply` with error "Timeout" when the query's
    time is up. A reply is never duplicated, and a duplicated request is answered once. Liveliness is delayed,
    in order, never lost; errors of queries are delivered at once, as are all messages of a perfect path.

    Partition: from `partition` to `heal`, and at a coordinator at the profile's times, the endpoint is cut
    off: what it sends and what comes for it is lost, what is under way to it already arrives. Liveliness
    changes are then reported at the end; if the partition lasts longer than the lease (`LEASE_S`), both sides
    see the other's tokens vanish after it and reappear at the end.

    Thread-safe; the scheduler must run its calls one at a time.
    """

    def __init__(
        self,
        inner: Transport,
        profile: NetworkProfile,
        rng: np.random.Generator,
        scheduler: Scheduler,
        *,
        receiver: Receiver,
    ):
        path = profile.path(receiver)
        self._inner = inner
        self._scheduler = scheduler
        self._start_s = scheduler.now_s
        self._channel = None if path.is_perfect else Channel(path, rng)
        self._lock = threading.Lock()
        self._closed = False
        self._flows: dict[tuple[str, str], OrderedFlow] = {}
        self._questions: dict[Question, None] = {}
        self._dropped = {"sample": 0, "request": 0, "reply": 0, "sent": 0}
        # Guards what follows; taken before the other, never after it.
        self._parting = threading.Lock()
        self._parted = False
        self._partition = 0
        self._own_tokens: dict[OwnToken, None] = {}
        self._watched: dict[Declaration, WatchedTokens] = {}
        for start_s, end_s in profile.partitions if receiver == "coordinator" else ():
            scheduler.call_later(start_s, self.partition)
            scheduler.call_later(end_s, self.heal)

    @property
    def drops(self) -> DropCounts:
        """Messages lost so far at this endpoint."""
        with self._lock:
            return DropCounts(*self._dropped.values())

    def publish(self, key: str, payload: bytes) -> None:
        """Send to all subscribers; untouched, unless cut off."""
        if not self._is_cut_off():
            self._inner.publish(key, payload)

    def subscribe(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver samples late, not at all, out of order or twice."""
        declaration = Declaration(sink)

        def on_sample(event: Event) -> None:
            assert isinstance(event, Sample)
            self._impair("sample", event.key, lambda: declaration.deliver(event))

        return declaration.hold(self._inner.subscribe(key_expr, on_sample))

    def serve(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver requests late, not at all, out of order or twice; answers go out unless cut off."""
        declaration = Declaration(sink)

        def on_request(event: Event) -> None:
            assert isinstance(event, Request)
            request = event._replace(reply=Answer(partial(self._answer, event.reply)))
            arrives = self._impair("request", event.key, lambda: declaration.deliver(request))
            if not arrives:
                self._scheduler.call_later(_LOST_REQUEST_S, lambda: _release(event.reply))

        return declaration.hold(self._inner.serve(key_expr, on_request))

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        """Ask; the answer comes late or, if it is lost or too late, as the error "Timeout"."""
        question = Question(key, tag, sink, self._forget_question)
        with self._lock:
            if self._closed:
                raise TransportError(f"cannot query {key}: {CLOSED}")
            self._questions[question] = None
        try:
            if not self._is_cut_off():
                self._inner.query(key, payload, timeout_s, lambda event: self._on_reply(question, event), tag)
        except TransportError:
            # A concurrent close has answered it.
            if question.withdraw():
                raise
        self._scheduler.call_later(timeout_s, lambda: question.finish(None, TIMEOUT))

    def declare_alive(self, key: str) -> Undeclare:
        """Hold a liveliness token while this session lives; the others see it unless cut off for long."""
        with self._parting:
            token = OwnToken(lambda: self._inner.declare_alive(key), self._forget_token)
            self._own_tokens[token] = None
            visible = not self._parted or self._closed
        if visible:
            token.show()
        return token

    def watch_alive(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver changes of matching tokens late, in order, never lost."""
        declaration = Declaration(sink, self._forget_watch)

        def report(event: Liveness) -> None:
            self._impair("liveness", event.key, lambda: declaration.deliver(event))

        watched = WatchedTokens(report)

        def on_liveness(event: Event) -> None:
            assert isinstance(event, Liveness)
            with self._parting:
                watched.on_change(event, self._parted)

        with self._parting:
            self._watched[declaration] = watched
        return declaration.hold(self._inner.watch_alive(key_expr, on_liveness))

    def close(self) -> None:
        """Close the inner transport; messages under way are dropped, queries under way get their `Reply`."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._flows.clear()
            questions, self._questions = list(self._questions), {}
        self._inner.close()
        for question in questions:
            question.finish(None, CLOSED)

    def partition(self) -> None:
        """Cut this endpoint off until `heal`; nothing happens if it is cut off already."""
        with self._parting:
            if self._parted:
                return
            self._parted = True
            number = self._partition = self._partition + 1
        self._scheduler.call_later(LEASE_S, lambda: self._lapse(number))

    def heal(self) -> None:
        """End the partition, also one that the profile began."""
        with self._parting:
            if not self._parted:
                return
            self._parted = False
            for watched in self._watched.values():
                watched.heal()
            tokens = [] if self._closed else list(self._own_tokens)
        for token in tokens:
            token.show()

    def _lapse(self, number: int) -> None:
        with self._parting:
            if not self._parted or self._partition != number or self._closed:
                return
            for watched in self._watched.values():
                watched.lapse()
            tokens = list(self._own_tokens)
        for token in tokens:
            token.hide()

    def _is_cut_off(self) -> bool:
        """Return whether a message to be sent is lost, and count it."""
        if not self._parted or self._closed:
            return False
        with self._lock:
            self._dropped["sent"] += 1
        return True

    def _answer(self, reply: Callable[[bytes], None], payload: bytes) -> None:
        if self._is_cut_off():
            self._scheduler.call_later(_LOST_REQUEST_S, lambda: _release(reply))
        else:
            reply(payload)

    def _forget_token(self, token: OwnToken) -> None:
        with self._parting:
            self._own_tokens.pop(token, None)

    def _forget_watch(self, declaration: Declaration) -> None:
        with self._parting:
            self._watched.pop(declaration, None)

    def _on_reply(self, question: Question, event: Event) -> None:
        assert isinstance(event, Reply)
        if event.payload is None:
            question.finish(None, event.error)
        else:
            self._impair("reply", event.key, lambda: question.finish(event.payload))

    def _forget_question(self, question: Question) -> None:
        with self._lock:
            self._questions.pop(question, None)

    def _impair(self, kind: str, key: str, deliver: Callable[[], None]) -> bool:
        """Deliver a message by its fate; return False if it is lost."""
        with self._lock:
            if self._closed:
                return False
            if self._parted and kind != "liveness":
                self._dropped[kind] += 1
                return False
            calls = self._calls(kind, key, deliver)
        if calls is None:
            deliver()
            return True
        for delay_s, call in calls:
            self._scheduler.call_later(delay_s, call)
        return bool(calls)

    def _calls(
        self, kind: str, key: str, deliver: Callable[[], None]
    ) -> list[tuple[float, Callable[[], None]]] | None:
        """Return the delays and calls that deliver a message; empty if it is lost, None on a perfect path."""
        if self._channel is None:
            return None
        fate = self._channel.fate(self._scheduler.now_s - self._start_s)
        if kind == "liveness":
            return [(fate.delay_s, self._enter(kind, key, deliver))]
        if fate.lost:
            self._dropped[kind] += 1
            return []
        delays_s = [fate.delay_s]
        # The copy has its place in the queue right behind the original, as order goes but for `reorder`.
        if fate.copy_delay_s is not None and kind != "reply":
            delays_s.append(fate.copy_delay_s)
        if fate.reordered:
            # Past the queue.
            return [(delay_s, lambda: None if self._closed else deliver()) for delay_s in delays_s]
        return [(delay_s, self._enter(kind, key, deliver)) for delay_s in delays_s]

    def _enter(self, kind: str, key: str, deliver: Callable[[], None]) -> Callable[[], None]:
        """Queue behind the earlier messages of this key; return what is to be called at its own time."""
        flow = self._flows.setdefault((kind, key), OrderedFlow())
        entry = flow.enter()

        def call() -> None:
            with self._lock:
                if self._closed:
                    return
                ready = flow.ripen(entry, deliver)
                if flow.is_empty and self._flows.get((kind, key)) is flow:
                    del self._flows[kind, key]
            for each in ready:
                each()

        return call


def _release(reply: Callable[[bytes], None]) -> None:
    """Hold the last reference to the reply function of a lost request until now."""


def inject(transport: Transport, network: NetworkProfile, seed: int, receiver: Receiver) -> Transport:
    """Return the transport impaired as the profile says for this receiver; a perfect path changes nothing."""
    parted = receiver == "coordinator" and network.partitions
    if network.path(receiver).is_perfect and not parted:
        return transport
    rng = np.random.default_rng(seed)
    return ImpairedTransport(transport, network, rng, TimerThread(), receiver=receiver)

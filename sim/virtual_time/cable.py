"""The cable of one endpoint: it can be cut, and damage, repeat or delay what goes through it.

It does so in both directions: to what the endpoint publishes, asks and answers, and to what comes for it,
replies to its own questions included. It draws nothing: the same state does the same to the same messages.
"""

from collections.abc import Callable
from functools import partial

from module_agent.network_emulation.impaired_transport import ImpairedTransport
from module_agent.transport.handles import Answer, Declaration, Question
from module_agent.transport.transport import (
    CLOSED,
    TIMEOUT,
    Event,
    Reply,
    Request,
    Sample,
    Sink,
    TransportError,
    Undeclare,
)
from sim.virtual_time.loop import LoopScheduler, VirtualLoop


class CableState:
    """What some cables do to messages, as of now.

    cut: nothing passes, in either direction, as if it was pulled; liveliness is that of a partition, see
    `ImpairedTransport`. flip: whatever passes has this byte inverted, counted from its beginning and around;
    None for none. copies: how often each publication and each question arrives in addition, at once; of the
    answers to a question only the first counts, on any network. delay_s: how much later each arrives [s].
    """

    def __init__(self, cut: bool = False, flip: int | None = None, copies: int = 0, delay_s: float = 0.0):
        self.flip = flip
        self.copies = copies
        self.delay_s = delay_s
        self._cut = cut
        self._endpoints: list[ImpairedTransport] = []

    @property
    def cut(self) -> bool:
        """Whether nothing passes."""
        return self._cut

    @cut.setter
    def cut(self, cut: bool) -> None:
        self._cut = cut
        for endpoint in self._endpoints:
            if cut:
                endpoint.partition()
            else:
                endpoint.heal()

    def attach(self, endpoint: ImpairedTransport) -> None:
        """Cut off an endpoint from now on whenever the cable is cut."""
        self._endpoints.append(endpoint)
        if self._cut:
            endpoint.partition()


class Cable:
    """A transport behind a cable in the given state, which may change at any time.

    What is delayed in it when its program closes it, or is killed, is lost.

    given_ns: when the program gave it what it is sending on at this moment, None while it sends nothing.
    """

    def __init__(self, inner: ImpairedTransport, loop: VirtualLoop, state: CableState):
        self._inner = inner
        self._loop = loop
        self._scheduler = LoopScheduler(loop)
        self._state = state
        self._closed = False
        self._questions: dict[Question, None] = {}
        self.given_ns: int | None = None
        state.attach(inner)

    def publish(self, key: str, payload: bytes) -> None:
        """Send to all subscribers."""
        self._send(partial(self._inner.publish, key, self._carried(payload)), self._state.copies)

    def subscribe(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Sample` for everything published on a matching key."""
        declaration = Declaration(sink)

        def on_sample(event: Event) -> None:
            assert isinstance(event, Sample)
            carried = Sample(event.key, self._carried(event.payload))
            self._pass(partial(declaration.deliver, carried), self._state.copies)

        return declaration.hold(self._inner.subscribe(key_expr, on_sample))

    def serve(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Request` for every query on a matching key."""
        declaration = Declaration(sink)

        def on_request(event: Event) -> None:
            assert isinstance(event, Request)
            reply = Answer(partial(self._answer, event.reply))
            carried = Request(event.key, self._carried(event.payload), reply)
            self._pass(partial(declaration.deliver, carried), self._state.copies)

        return declaration.hold(self._inner.serve(key_expr, on_request))

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        """Ask; of a cut cable the `Reply` is a time-out, as it is of one that delays for too long."""
        question = Question(key, tag, sink, self._forget)
        self._questions[question] = None

        def on_reply(event: Event) -> None:
            assert isinstance(event, Reply)
            if event.payload is None:
                question.finish(None, event.error)
            else:
                self._pass(partial(question.finish, self._carried(event.payload)))

        ask = partial(self._inner.query, key, self._carried(payload), timeout_s, on_reply, tag)
        try:
            self._send(ask, self._state.copies)
        except TransportError:
            question.withdraw()
            raise
        self._scheduler.call_later(timeout_s, lambda: question.finish(None, TIMEOUT))

    def declare_alive(self, key: str) -> Undeclare:
        """Hold a liveliness token while this endpoint lives."""
        return self._inner.declare_alive(key)

    def watch_alive(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Liveness` for every change of a matching token."""
        declaration = Declaration(sink)
        seen = self._inner.watch_alive(
            key_expr, lambda event: self._pass(partial(declaration.deliver, event))
        )
        return declaration.hold(seen)

    def close(self) -> None:
        """End all declarations; queries under way get their `Reply`."""
        self._closed = True
        self._inner.close()
        for question in list(self._questions):
            question.finish(None, CLOSED)

    def _answer(self, reply: Callable[[bytes], None], payload: bytes) -> None:
        self._send(partial(reply, self._carried(payload)))

    def _forget(self, question: Question) -> None:
        self._questions.pop(question, None)

    def _carried(self, payload: bytes) -> bytes:
        if self._state.flip is None or not payload:
            return payload
        at = self._state.flip % len(payload)
        return payload[:at] + bytes([payload[at] ^ 0xFF]) + payload[at + 1 :]

    def _send(self, call: Callable[[], None], copies: int = 0) -> None:
        given_ns, is_late = self._loop.now_ns, self._state.delay_s > 0.0

        def send() -> None:
            self.given_ns = given_ns
            try:
                call()
            except TransportError:
                # The endpoint of what was delayed may be gone by then.
                if not is_late:
                    raise
            finally:
                self.given_ns = None

        self._pass(send, copies)

    def _pass(self, call: Callable[[], None], copies: int = 0) -> None:
        """Call at once, or later while the cable is open; as often as the message is to arrive."""
        delay_s = self._state.delay_s
        for _ in range(1 + copies):
            if delay_s > 0.0:
                self._scheduler.call_later(delay_s, lambda: None if self._closed else call())
            else:
                call()

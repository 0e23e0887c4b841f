"""The cable of one endpoint: it can be cut, and damage, repeat or delay what goes through it."""

from collections.abc import Callable
from dataclasses import dataclass

from module_agent.transport.transport import Event, Reply, Request, Sample, Sink, Transport, Undeclare
from sim.virtual_time.loop import VirtualLoop


@dataclass
class CableState:
    """What a cable does to messages, as of now.

    cut: nothing passes, in either direction, as if it was pulled. flip: publications and requests have this
    byte of them inverted, counted from their beginning and around; None for none. copies: how often each
    arrives in addition. delay_s: how much later each arrives [s].
    """

    cut: bool = False
    flip: int | None = None
    copies: int = 0
    delay_s: float = 0.0


class Cable:
    """A transport behind a cable in the given state, which may change at any time."""

    def __init__(self, inner: Transport, loop: VirtualLoop, state: CableState):
        self._inner = inner
        self._loop = loop
        self._state = state

    def publish(self, key: str, payload: bytes) -> None:
        """Send to all subscribers."""
        if not self._state.cut:
            self._inner.publish(key, self._carried(payload))

    def subscribe(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Sample` for everything published on a matching key."""
        return self._inner.subscribe(key_expr, self._filtered(sink))

    def serve(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Request` for every query on a matching key."""
        return self._inner.serve(key_expr, self._filtered(sink))

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        """Ask; of a cut cable the `Reply` is a time-out."""
        if self._state.cut:
            lost = Reply(tag, key, None, "Timeout")
            self._loop.call_later(timeout_s, sink, lost)
        else:
            self._inner.query(key, self._carried(payload), timeout_s, sink, tag)

    def declare_alive(self, key: str) -> Undeclare:
        """Hold a liveliness token while this endpoint lives."""
        return self._inner.declare_alive(key)

    def watch_alive(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Liveness` for every change of a matching token."""
        return self._inner.watch_alive(key_expr, sink)

    def close(self) -> None:
        """End all declarations."""
        self._inner.close()

    def _carried(self, payload: bytes) -> bytes:
        if self._state.flip is None or not payload:
            return payload
        at = self._state.flip % len(payload)
        return payload[:at] + bytes([payload[at] ^ 0xFF]) + payload[at + 1 :]

    def _filtered(self, sink: Sink) -> Callable[[Event], None]:
        def pass_on(event: Event) -> None:
            state = self._state
            if not isinstance(event, Sample | Request):
                sink(event)
                return
            if state.cut:
                return
            copies = 1
            if isinstance(event, Sample):
                event = Sample(event.key, self._carried(event.payload))
                copies += state.copies
            for _ in range(copies):
                if state.delay_s > 0.0:
                    self._loop.call_later(state.delay_s, sink, event)
                else:
                    sink(event)

        return pass_on

"""What a transport holds open on behalf of a program; each of them ends once, and from any thread."""

import threading
from collections.abc import Callable

from module_agent.transport.transport import Event, Reply, Sink, Undeclare


class Declaration:
    """A declaration whose events end with `undeclare`, also those that are still on their way."""

    def __init__(self, sink: Sink | None, forget: Callable[["Declaration"], None] = lambda ended: None):
        self._sink = sink
        self._forget = forget
        self._inner: Undeclare | None = None

    def hold(self, inner: Undeclare) -> "Declaration":
        """Take the handle of what is declared further in, which ends with this."""
        self._inner = inner
        return self

    def deliver(self, event: Event) -> None:
        """Hand an event to the sink."""
        sink = self._sink
        if sink is not None:
            sink(event)

    def undeclare(self) -> None:
        """End the declaration. May be called twice."""
        self._sink = None
        self._forget(self)
        inner, self._inner = self._inner, None
        if inner is not None:
            inner.undeclare()


class Question:
    """A query under way: the first to finish it delivers the one reply."""

    def __init__(self, key: str, tag: int, sink: Sink, forget: Callable[["Question"], None]):
        self._key = key
        self._tag = tag
        self._sink = sink
        self._forget = forget
        self._lock = threading.Lock()
        self._open = True

    def withdraw(self) -> bool:
        """End without a reply; False when the reply has been delivered."""
        with self._lock:
            first, self._open = self._open, False
        self._forget(self)
        return first

    def finish(self, payload: bytes | None, error: str = "") -> None:
        """End with this reply, unless there was one."""
        if self.withdraw():
            self._sink(Reply(self._tag, self._key, payload, error))


class Answer:
    """The reply function of a request: of what is given to it, only the first goes out by `send`."""

    def __init__(self, send: Callable[[bytes], None]):
        self._send: Callable[[bytes], None] | None = send
        self._lock = threading.Lock()

    def __call__(self, payload: bytes) -> None:
        """Send the answer, unless there was one."""
        with self._lock:
            send, self._send = self._send, None
        if send is not None:
            send(payload)

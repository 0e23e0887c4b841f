"""The contract of a transport, and the events that it delivers.

A transport delivers every event by calling a `Sink`, from any thread: a sink must only enqueue, after a look
into the event at most. Publishing
never blocks for long and may drop; a query is answered by exactly one `Reply`. Implementations: Zenoh
(`zenoh_transport`), the simulator's virtual network, and `impaired_transport`, which wraps either.

A `Reply` without payload carries one of the errors at the end of this file, the same for every transport.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from module_agent.model.errors import RobotError

# A session that is silent for longer is lost to the others: its liveliness tokens vanish.
LEASE_S = 1.0


class Sample(NamedTuple):
    """Something published on a key."""

    key: str
    payload: bytes


class Request(NamedTuple):
    """A query to be answered: call `reply` at most once, from any thread."""

    key: str
    payload: bytes
    reply: Callable[[bytes], None]


class Reply(NamedTuple):
    """The end of a query: `payload` is None without an answer, and `error` says why."""

    tag: int
    key: str
    payload: bytes | None
    error: str = ""


class Liveness(NamedTuple):
    """A liveliness token appeared or vanished."""

    key: str
    alive: bool


Event = Sample | Request | Reply | Liveness
Sink = Callable[[Event], None]


class TransportError(RobotError):
    """The transport could not be opened or is closed; the message says what to check."""


class NoHub(TransportError):
    """The hub does not answer; it may start later."""


class EndpointInUse(TransportError):
    """Another program listens on the endpoint."""


class Undeclare(Protocol):
    """The handle of a declaration; keep it as long as the declaration shall hold."""

    def undeclare(self) -> None:
        """End the declaration. May be called twice."""


class Transport(Protocol):
    """The only way between agents and coordinator, and between agents."""

    def publish(self, key: str, payload: bytes) -> None:
        """Send to all subscribers; dropped under congestion, never blocking."""

    def subscribe(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Sample` for everything published on a matching key from now on."""

    def serve(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Request` for every query on a matching key."""

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        """Ask; exactly one `Reply` with this tag comes to the sink, within about `timeout_s`."""

    def declare_alive(self, key: str) -> Undeclare:
        """Hold a liveliness token while this session lives."""

    def watch_alive(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Liveness` for every present and future change of a matching token."""

    def close(self) -> None:
        """End all declarations and the session. May be called twice."""


TIMEOUT = "Timeout"
NO_ANSWER = "no answer on this key"
CLOSED = "the transport is closed"

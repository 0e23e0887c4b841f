"""The transport over Zenoh: one session, scouting off, every endpoint named by configuration.

Topology: one hub listens, in `router` mode; every other session connects to it. The programs do so in
`client` mode with a bounded wait, tried again and again: so an agent can say that it waits for a hub.
Measured with eclipse-zenoh 1.10.2 on loopback, spokes started before the hub:

========  ==============  =====================================  ==============================
spokes    opens           hear each other through the hub        back after SIGKILL of the hub
========  ==============  =====================================  ==============================
router    at once         yes                                    0.3-0.4 s after the new hub
client    blocks for it   yes                                    0.3 s after the new hub
peer      at once         no (peers are not relayed since 1.9)   0.3 s after the new hub
========  ==============  =====================================  ==============================
"""

import json
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, Self

import zenoh
from pydantic import BaseModel, ConfigDict, Field

from module_agent.model.errors import UsageError
from module_agent.transport.credentials import Credentials, secured
from module_agent.transport.endpoint import DEFAULT_ENDPOINT, check_endpoint
from module_agent.transport.handles import Answer, Declaration, Question
from module_agent.transport.transport import (
    CLOSED,
    LEASE_S,
    NO_ANSWER,
    EndpointInUse,
    Liveness,
    NoHub,
    Request,
    Sample,
    Sink,
    TransportError,
    Undeclare,
)

_MAX_MESSAGE_BYTES = 1 << 20


class ZenohConfig(BaseModel):
    """How a session meets the others; endpoints are Zenoh's, such as `tcp/127.0.0.1:7447`.

    `connect_timeout_s` bounds how long a `client` waits for its hub while it opens (None = for ever). With
    `credentials` all links are mutual TLS, and a hub allows by them.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: Literal["router", "peer", "client"] = "router"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    connect_timeout_s: float | None = Field(default=None, gt=0.0)
    credentials: Credentials | None = None

    @classmethod
    def hub(cls, endpoint: str = DEFAULT_ENDPOINT, credentials: Credentials | None = None) -> Self:
        """Return the configuration of the one session that all others connect to."""
        return cls(listen=(endpoint,), credentials=credentials)

    @classmethod
    def spoke(cls, endpoint: str = DEFAULT_ENDPOINT) -> Self:
        """Return the configuration of a session that connects to the hub, now or whenever there is one."""
        return cls(connect=(endpoint,))


class ZenohTransport:
    """A `Transport` over one Zenoh session; made by `open_zenoh`."""

    def __init__(self, session: zenoh.Session):
        self._session = session
        self._lock = threading.Lock()
        self._closed = False
        # Dictionaries as ordered sets.
        self._declarations: dict[Declaration, None] = {}
        self._questions: dict[Question, None] = {}
        self._publishers: dict[str, zenoh.Publisher] = {}

    def publish(self, key: str, payload: bytes) -> None:
        """Send to all subscribers; dropped under congestion. The publisher of a key is declared once."""
        publisher = self._publishers.get(key) or self._declare_publisher(key)
        try:
            publisher.put(payload)
        except zenoh.ZError as error:
            raise self._error(f"publish on {key}", error) from error

    def subscribe(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Sample` for everything published on a matching key from now on.

        A foreign client may publish on an expression such as `x5/**`. Subscribers to one key receive that as
        their key; subscribers to many do not receive it, as it names none of them.
        """
        declaration = Declaration(sink, self._forget_declaration)

        def on_sample(sample: zenoh.Sample) -> None:
            key = _one_key(str(sample.key_expr), key_expr)
            if key is not None:
                declaration.deliver(Sample(key, sample.payload.to_bytes()))

        declare, handler = self._session.declare_subscriber, _direct(on_sample)
        return self._declare(declaration, f"subscribe to {key_expr}", lambda: declare(key_expr, handler))

    def serve(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Request` for every query on a matching key; an unanswered one times out at its asker.

        Queries on an expression are taken as samples on one are (see `subscribe`).
        """
        declaration = Declaration(sink, self._forget_declaration)

        def on_query(query: zenoh.Query) -> None:
            payload = b"" if query.payload is None else query.payload.to_bytes()
            key = _one_key(str(query.key_expr), key_expr)
            if key is not None:
                declaration.deliver(Request(key, payload, Answer(partial(_reply, query, key))))

        declare, handler = self._session.declare_queryable, _direct(on_query)
        return self._declare(declaration, f"serve {key_expr}", lambda: declare(key_expr, handler))

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        """Ask; the first answer wins. Without any, the one `Reply` carries the reason as `error`."""
        question = Question(key, tag, sink, self._forget_question)
        with self._lock:
            self._check_open(f"query {key}")
            self._questions[question] = None
        try:
            # Without consolidation NONE the first answer would wait for the last queryable. DROP, as Zenoh's
            # default lets a full link block the caller for seconds.
            self._session.get(
                key,
                _direct(partial(_finish, question), lambda: question.finish(None, NO_ANSWER)),
                payload=payload,
                # By default a queryable that calls itself complete is asked in place of the module's own.
                target=zenoh.QueryTarget.ALL,
                timeout=timeout_s,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.DROP,
            )
        except zenoh.ZError as error:
            if question.withdraw():
                raise self._error(f"query {key}", error) from error

    def declare_alive(self, key: str) -> Undeclare:
        """Hold a liveliness token while this session lives."""
        declaration, declare = Declaration(None, self._forget_declaration), self._session.liveliness()
        return self._declare(declaration, f"declare {key} alive", lambda: declare.declare_token(key))

    def watch_alive(self, key_expr: str, sink: Sink) -> Undeclare:
        """Deliver a `Liveness` for every present and future change of a matching token."""
        declaration = Declaration(sink, self._forget_declaration)

        def on_token(sample: zenoh.Sample) -> None:
            declaration.deliver(Liveness(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))

        return self._declare(
            declaration,
            f"watch {key_expr}",
            lambda: self._session.liveliness().declare_subscriber(key_expr, _direct(on_token), history=True),
        )

    def close(self) -> None:
        """End all declarations, then the session; queries under way get their `Reply`."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            declarations, questions = list(self._declarations), list(self._questions)
            publishers, self._publishers = list(self._publishers.values()), {}
        for question in questions:
            question.finish(None, CLOSED)
        # A session that closes under a live callback can hang the interpreter at exit: undeclare all first.
        for declaration in declarations:
            declaration.undeclare()
        for publisher in publishers:
            publisher.undeclare()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]

    def _declare_publisher(self, key: str) -> zenoh.Publisher:
        with self._lock:
            self._check_open(f"publish on {key}")
            if key not in self._publishers:
                try:
                    self._publishers[key] = self._session.declare_publisher(
                        key, congestion_control=zenoh.CongestionControl.DROP, express=False
                    )
                except zenoh.ZError as error:
                    raise self._error(f"publish on {key}", error) from error
            return self._publishers[key]

    def _declare(self, declaration: Declaration, what: str, make: Callable[[], Undeclare]) -> Declaration:
        with self._lock:
            self._check_open(what)
        # Not under the lock: Zenoh may run the callback, and so the sink, before it returns the handle.
        try:
            declaration.hold(make())
        except zenoh.ZError as error:
            raise self._error(what, error) from error
        with self._lock:
            if not self._closed:
                self._declarations[declaration] = None
                return declaration
        declaration.undeclare()
        raise TransportError(f"cannot {what}: {CLOSED}")

    def _check_open(self, what: str) -> None:
        if self._closed:
            raise TransportError(f"cannot {what}: {CLOSED}")

    def _error(self, what: str, error: zenoh.ZError) -> TransportError:
        return TransportError(f"cannot {what}: {CLOSED if self._closed else _first_line(error)}")

    def _forget_declaration(self, declaration: Declaration) -> None:
        with self._lock:
            self._declarations.pop(declaration, None)

    def _forget_question(self, question: Question) -> None:
        with self._lock:
            self._questions.pop(question, None)


def _direct(
    callback: Callable[[Any], None], drop: Callable[[], None] | None = None
) -> "zenoh.handlers.Callback[Any]":
    """Return a handler that is run by the thread that receives, since sinks only enqueue.

    By default every declaration and every query has a thread of its own: 11 threads a module, and 0.4 ms of
    processor time for a query instead of 0.2.
    """
    return zenoh.handlers.Callback(callback, drop, indirect=False)


def _finish(question: Question, reply: zenoh.Reply) -> None:
    if reply.ok is not None:
        question.finish(reply.ok.payload.to_bytes())
    elif reply.err is not None:
        question.finish(None, reply.err.payload.to_bytes().decode("utf-8", "replace") or NO_ANSWER)


def _reply(query: zenoh.Query, key: str, payload: bytes) -> None:
    try:
        query.reply(key, payload)
    except zenoh.ZError as error:
        # A session that closed meanwhile has already ended the query at the asker.
        if "closed" not in str(error):
            raise TransportError(f"cannot answer the query on {query.key_expr}: {error}") from error
    finally:
        query.drop()  # type: ignore[no-untyped-call]


def _one_key(said: str, declared: str) -> str | None:
    """Return the key that a message on `said` means for a declaration on `declared`, None for many."""
    if "*" not in said:
        return said
    return None if "*" in declared else declared


def open_zenoh(config: ZenohConfig) -> ZenohTransport:
    """Open a session. A `client` waits for its hub; the other modes connect in the background, for ever.

    Raises:
        NoHub: a client found no hub within `connect_timeout_s`.
        EndpointInUse: another program listens there, most often another coordinator.
        TransportError: an endpoint is malformed or cannot be listened on.
    """
    # Of the variable RUST_LOG, which `--log-level` sets; without it nothing is logged.
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    try:
        for endpoint in (*config.listen, *config.connect):
            check_endpoint(endpoint)
        config = _secure(config)
    except UsageError as error:
        raise TransportError(str(error)) from error
    try:
        return ZenohTransport(zenoh.open(_session_config(config)))
    except zenoh.ZError as error:
        raise _why_not_open(config, error) from error


def _secure(config: ZenohConfig) -> ZenohConfig:
    """Return the configuration with endpoints of TLS, if it has credentials.

    Raises:
        UsageError: they do not allow to listen, or an endpoint is of another protocol.
    """
    credentials = config.credentials
    if credentials is None:
        return config
    if config.listen and not credentials.may_serve:
        raise UsageError(
            f"the certificate of {credentials.name} is good for connecting only: the coordinator is the hub"
        )
    listen, connect = (tuple(map(secured, ends)) for ends in (config.listen, config.connect))
    return config.model_copy(update={"listen": listen, "connect": connect})


def _session_config(config: ZenohConfig) -> zenoh.Config:
    connect_ms = -1 if config.connect_timeout_s is None else max(1, round(config.connect_timeout_s * 1e3))
    retry = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5}
    settings = {
        "mode": config.mode,
        "listen/endpoints": config.listen,
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
        "connect/endpoints": config.connect,
        "connect/timeout_ms": connect_ms,
        "connect/exit_on_failure": config.mode == "client",
        "connect/retry": retry,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/link/tx/lease": round(1000 * LEASE_S),
        "transport/link/tx/keep_alive": 4,
        # Closing waits for a handshake under way, such as one with a frozen hub: not for the default 10 s.
        "transport/unicast/open_timeout": 1000,
        "transport/unicast/accept_timeout": 1000,
        # Zenoh's default is 1 GiB; the largest message here has 80 KiB.
        "transport/link/rx/max_message_size": _MAX_MESSAGE_BYTES,
    }
    if config.credentials is not None:
        settings |= config.credentials.settings(as_hub=bool(config.listen))
    made = zenoh.Config()
    for name, value in settings.items():
        made.insert_json5(name, json.dumps(value))
    return made


def _why_not_open(config: ZenohConfig, error: zenoh.ZError) -> TransportError:
    text = _first_line(error)
    if "Address already in use" in text:
        return EndpointInUse(
            f"cannot listen on {', '.join(config.listen)}: the address is in use, most likely by another "
            "coordinator; connect to that one as a spoke, or listen on another port"
        )
    if config.mode == "client" and "Unable to connect" in text:
        return NoHub(
            f"no hub answers on {', '.join(config.connect)} within {config.connect_timeout_s} s; is the "
            "coordinator running, do both sides agree on the address, and do both (or neither) use --secure "
            "with certificates of the same authority?"
        )
    return TransportError(
        f"cannot open a Zenoh session (listen {list(config.listen)}, connect {list(config.connect)}): {text}"
    )


def _first_line(error: zenoh.ZError) -> str:
    # Zenoh appends the place in its own sources.
    return str(error).split(" at /", 1)[0]

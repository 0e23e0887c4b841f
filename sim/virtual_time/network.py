"""A network in virtual time: the whole `Transport` contract in one process, delivered by the virtual loop.

It is perfect, without delay or loss; put `ImpairedTransport` with a `LoopScheduler` around each endpoint for
the rest. Messages are bytes, as on any wire. Nothing is delivered from inside the call that sends it.
"""

import re
from collections.abc import Callable
from functools import lru_cache, partial

from module_agent.transport.transport import (
    CLOSED,
    NO_ANSWER,
    TIMEOUT,
    Event,
    Liveness,
    Reply,
    Request,
    Sample,
    Sink,
    TransportError,
)
from sim.virtual_time.loop import NS_PER_S, VirtualLoop

Tap = Callable[[int, str, str, str, bytes], None]
_KEY = re.compile(r"[^/*$?#]+(/[^/*$?#]+)*\Z")


@lru_cache(maxsize=4096)
def _pattern(key_expr: str) -> re.Pattern[str]:
    chunks = key_expr.split("/")
    tail = ""
    if chunks[-1] == "**":
        chunks, tail = chunks[:-1], ".*" if len(chunks) == 1 else "(/.*)?"
    for chunk in chunks:
        if chunk != "*" and not _KEY.match(chunk):
            raise TransportError(
                f"{key_expr!r} is no key expression known here: chunks are names or '*', the last may be '**'"
            )
    return re.compile("/".join("[^/]+" if c == "*" else re.escape(c) for c in chunks) + tail + r"\Z")


def matches(key_expr: str, key: str) -> bool:
    """Return whether a key matches an expression of names, `*` (one chunk) and a last `**` (any number).

    Raises:
        TransportError: the expression is of another form.
    """
    return _pattern(key_expr).match(key) is not None


def _check(key: str, payload: bytes = b"") -> None:
    if not _KEY.match(key):
        raise TransportError(f"{key!r} is not a key: no empty chunks, none of the characters * $ ? #")
    if not isinstance(payload, bytes):
        raise TypeError(f"a payload is bytes, not {type(payload).__name__}")


class _Declaration:
    """Something declared by an endpoint: a subscription, a service or a watch, with its sink; or a token."""

    __slots__ = ("_network", "endpoint", "key_expr", "kind", "live", "sink")

    def __init__(
        self,
        network: "VirtualNetwork",
        endpoint: "VirtualEndpoint",
        kind: str,
        key_expr: str,
        sink: Sink | None,
    ):
        self._network = network
        self.endpoint = endpoint
        self.kind = kind
        self.key_expr = key_expr
        self.sink = sink
        self.live = True

    def deliver(self, event: Event) -> None:
        if self.live and self.sink is not None:
            self.sink(event)

    def undeclare(self) -> None:
        if self.live:
            self.live = False
            self._network._withdraw(self)


class _Question:
    """A query under way."""

    __slots__ = ("asker", "key", "sink", "tag")

    def __init__(self, asker: "VirtualEndpoint", key: str, sink: Sink, tag: int):
        self.asker = asker
        self.key = key
        self.sink = sink
        self.tag = tag


class VirtualEndpoint:
    """One session of the virtual network, made by `VirtualNetwork.endpoint`."""

    def __init__(self, network: "VirtualNetwork", name: str):
        self._network = network
        self.name = name
        self._why_closed = ""

    def publish(self, key: str, payload: bytes) -> None:
        """Send to all subscribers, this endpoint's own included."""
        self._check_open(f"publish on {key}")
        self._network._publish(self, key, payload)

    def subscribe(self, key_expr: str, sink: Sink) -> _Declaration:
        """Deliver a `Sample` for everything published on a matching key from now on."""
        return self._declare("sample", key_expr, sink)

    def serve(self, key_expr: str, sink: Sink) -> _Declaration:
        """Deliver a `Request` for every query on a matching key."""
        return self._declare("request", key_expr, sink)

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        """Ask; exactly one `Reply` comes, unless this endpoint is killed."""
        self._check_open(f"query {key}")
        self._network._query(_Question(self, key, sink, tag), payload, timeout_s)

    def declare_alive(self, key: str) -> _Declaration:
        """Hold a liveliness token while this endpoint lives."""
        _check(key)
        return self._declare("token", key, None)

    def watch_alive(self, key_expr: str, sink: Sink) -> _Declaration:
        """Deliver a `Liveness` for every present and future change of a matching token."""
        return self._declare("liveness", key_expr, sink)

    def close(self) -> None:
        """End all declarations; queries under way get their `Reply`."""
        if not self._why_closed:
            self._why_closed = CLOSED
            self._network._close(self, answer=True)

    def _kill(self) -> None:
        if not self._why_closed:
            self._why_closed = f"endpoint {self.name!r} was killed"
            self._network._close(self, answer=False)

    def _declare(self, kind: str, key_expr: str, sink: Sink | None) -> _Declaration:
        self._check_open(f"declare {key_expr}")
        _pattern(key_expr)
        return self._network._add(_Declaration(self._network, self, kind, key_expr, sink))

    def _check_open(self, what: str) -> None:
        if self._why_closed:
            raise TransportError(f"cannot {what}: {self._why_closed}")


class VirtualNetwork:
    """All endpoints of one virtual network.

    `tap(now_ns, endpoint, kind, key, payload)` sees every message as it is sent, kind "sample", "request" or
    "reply": for recordings and trace hashes.
    """

    def __init__(self, loop: VirtualLoop, tap: Tap | None = None):
        self._loop = loop
        self._tap = tap
        self._endpoints: dict[str, VirtualEndpoint] = {}
        # Dictionaries as ordered sets: delivery goes in the order of declaration.
        self._declared: dict[str, dict[_Declaration, None]] = {
            kind: {} for kind in ("sample", "request", "token", "liveness")
        }
        self._routes: dict[str, tuple[_Declaration, ...]] = {}
        self._tokens: dict[str, int] = {}
        self._questions: dict[_Question, None] = {}

    def endpoint(self, name: str) -> VirtualEndpoint:
        """Open an endpoint; a name is free again when its endpoint was closed or killed.

        Raises:
            ValueError: the name is taken.
        """
        if name in self._endpoints:
            raise ValueError(f"endpoint {name!r} is open already")
        made = self._endpoints[name] = VirtualEndpoint(self, name)
        return made

    def kill(self, name: str) -> None:
        """Do to an endpoint what SIGKILL does: its tokens vanish, nothing more reaches or leaves it.

        Requests that it holds are never answered, and its own queries get no `Reply`.

        Raises:
            KeyError: there is no such endpoint.
        """
        if name not in self._endpoints:
            raise KeyError(f"no endpoint {name!r}; open are {', '.join(self._endpoints) or 'none'}")
        self._endpoints[name]._kill()

    # The methods below are called by the endpoints and declarations of this module only.

    def _publish(self, endpoint: VirtualEndpoint, key: str, payload: bytes) -> None:
        route = self._routes.get(key)
        if route is None:
            _check(key)
            route = self._routes[key] = self._matching("sample", key)
        if type(payload) is not bytes:
            _check(key, payload)
        if self._tap is not None:
            self._tap(self._loop.now_ns, endpoint.name, "sample", key, payload)
        if route:
            self._soon(lambda: _deliver(route, Sample(key, payload)))

    def _query(self, question: _Question, payload: bytes, timeout_s: float) -> None:
        _check(question.key, payload)
        self._questions[question] = None
        if self._tap is not None:
            self._tap(self._loop.now_ns, question.asker.name, "request", question.key, payload)
        self._soon(lambda: self._ask(question, payload))
        due_ns = self._loop.now_ns + round(timeout_s * NS_PER_S)
        self._loop.schedule_ns(due_ns, lambda: self._finish(question, None, TIMEOUT))

    def _ask(self, question: _Question, payload: bytes) -> None:
        if question not in self._questions:
            return
        servers = self._matching("request", question.key)
        if not servers:
            self._finish(question, None, NO_ANSWER)
        for server in servers:
            server.deliver(Request(question.key, payload, self._answer(question, server.endpoint)))

    def _answer(self, question: _Question, server: VirtualEndpoint) -> Callable[[bytes], None]:
        used = False

        def reply(payload: bytes) -> None:
            nonlocal used
            _check(question.key, payload)
            if used or server._why_closed:
                return
            used = True
            if self._tap is not None:
                self._tap(self._loop.now_ns, server.name, "reply", question.key, payload)
            self._soon(lambda: self._finish(question, payload, ""))

        return reply

    def _finish(self, question: _Question, payload: bytes | None, error: str) -> None:
        if question in self._questions:
            del self._questions[question]
            question.sink(Reply(question.tag, question.key, payload, error))

    def _add(self, declaration: _Declaration) -> _Declaration:
        key_expr = declaration.key_expr
        self._declared[declaration.kind][declaration] = None
        if declaration.kind == "sample":
            self._routes.clear()
        elif declaration.kind == "token":
            self._tokens[key_expr] = self._tokens.get(key_expr, 0) + 1
            if self._tokens[key_expr] == 1:
                self._announce(key_expr, True)
        elif declaration.kind == "liveness":
            for key in self._tokens:
                if matches(key_expr, key):
                    self._tell((declaration,), Liveness(key, True))
        return declaration

    def _withdraw(self, declaration: _Declaration) -> None:
        key_expr = declaration.key_expr
        del self._declared[declaration.kind][declaration]
        if declaration.kind == "sample":
            self._routes.clear()
        elif declaration.kind == "token":
            self._tokens[key_expr] -= 1
            if self._tokens[key_expr] == 0:
                del self._tokens[key_expr]
                self._announce(key_expr, False)

    def _close(self, endpoint: VirtualEndpoint, answer: bool) -> None:
        del self._endpoints[endpoint.name]
        for declared in self._declared.values():
            for declaration in [d for d in declared if d.endpoint is endpoint]:
                declaration.undeclare()
        for question in [q for q in self._questions if q.asker is endpoint]:
            if answer:
                self._soon(partial(self._finish, question, None, CLOSED))
            else:
                del self._questions[question]

    def _announce(self, key: str, alive: bool) -> None:
        self._tell(self._matching("liveness", key), Liveness(key, alive))

    def _tell(self, declarations: tuple[_Declaration, ...], event: Liveness) -> None:
        if declarations:
            self._soon(lambda: _deliver(declarations, event))

    def _matching(self, kind: str, key: str) -> tuple[_Declaration, ...]:
        return tuple(d for d in self._declared[kind] if matches(d.key_expr, key))

    def _soon(self, call: Callable[[], object]) -> None:
        self._loop.schedule_ns(self._loop.now_ns, call)


def _deliver(declarations: tuple[_Declaration, ...], event: Event) -> None:
    for declaration in declarations:
        declaration.deliver(event)

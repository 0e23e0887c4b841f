"""A network in virtual time: the whole `Transport` contract in one process, delivered by the virtual loop.

It is perfect, without delay or loss; put `ImpairedTransport` with a `LoopScheduler` around each endpoint for
the rest. Messages are bytes, as on any wire. Nothing is delivered from inside the call that sends it.
"""

import re
from collections.abc import Callable
from functools import lru_cache, partial

from module_agent.transport.handles import Answer, Declaration, Question
from module_agent.transport.transport import (
    CLOSED,
    NO_ANSWER,
    TIMEOUT,
    Event,
    Liveness,
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

    def subscribe(self, key_expr: str, sink: Sink) -> Declaration:
        """Deliver a `Sample` for everything published on a matching key from now on."""
        return self._declare("sample", key_expr, sink)

    def serve(self, key_expr: str, sink: Sink) -> Declaration:
        """Deliver a `Request` for every query on a matching key."""
        return self._declare("request", key_expr, sink)

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        """Ask; exactly one `Reply` comes, unless this endpoint is killed."""
        self._check_open(f"query {key}")
        self._network._query(self, key, payload, timeout_s, sink, tag)

    def declare_alive(self, key: str) -> Declaration:
        """Hold a liveliness token while this endpoint lives."""
        _check(key)
        return self._declare("token", key, None)

    def watch_alive(self, key_expr: str, sink: Sink) -> Declaration:
        """Deliver a `Liveness` for every present and future change of a matching token."""
        return self._declare("liveness", key_expr, sink)

    def close(self) -> None:
        """End all declarations; queries under way get their `Reply`."""
        self._end(CLOSED, answer=True)

    def _end(self, why: str, answer: bool) -> None:
        if not self._why_closed:
            self._why_closed = why
            self._network._close(self, answer)

    def _declare(self, kind: str, key_expr: str, sink: Sink | None) -> Declaration:
        self._check_open(f"declare {key_expr}")
        _pattern(key_expr)
        return self._network._add(self, kind, key_expr, sink)

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
        # Delivery goes in the order of declaration.
        self._declared: dict[str, dict[Declaration, tuple[str, VirtualEndpoint]]] = {
            kind: {} for kind in ("sample", "request", "token", "liveness")
        }
        # What matches a key, until something else is declared.
        self._routes: dict[tuple[str, str], tuple[Declaration, ...]] = {}
        self._questions: dict[Question, VirtualEndpoint] = {}

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
        self._endpoints[name]._end(f"endpoint {name!r} was killed", answer=False)

    # The methods below are called by the endpoints and declarations of this module only.

    def _publish(self, endpoint: VirtualEndpoint, key: str, payload: bytes) -> None:
        route = self._routes.get(("sample", key))
        if route is None:
            _check(key)
            route = self._matching("sample", key)
        if type(payload) is not bytes:
            _check(key, payload)
        self._note(endpoint, "sample", key, payload)
        if route:
            self._soon(lambda: _deliver(route, Sample(key, payload)))

    def _query(
        self, asker: VirtualEndpoint, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int
    ) -> None:
        _check(key, payload)
        question = Question(key, tag, sink, self._forget)
        self._questions[question] = asker
        self._note(asker, "request", key, payload)
        self._soon(lambda: self._ask(question, key, payload))
        due_ns = self._loop.now_ns + round(timeout_s * NS_PER_S)
        self._loop.schedule_ns(due_ns, lambda: question.finish(None, TIMEOUT))

    def _forget(self, question: Question) -> None:
        self._questions.pop(question, None)

    def _ask(self, question: Question, key: str, payload: bytes) -> None:
        if question not in self._questions:
            return
        servers = [(each, self._declared["request"][each][1]) for each in self._matching("request", key)]
        if not servers:
            question.finish(None, NO_ANSWER)
        for declaration, server in servers:
            answer = Answer(partial(self._answer, question, server, key))
            declaration.deliver(Request(key, payload, answer))

    def _answer(self, question: Question, server: VirtualEndpoint, key: str, payload: bytes) -> None:
        _check(key, payload)
        if not server._why_closed:
            self._note(server, "reply", key, payload)
            self._soon(lambda: question.finish(payload))

    def _add(self, endpoint: VirtualEndpoint, kind: str, key_expr: str, sink: Sink | None) -> Declaration:
        tokens = self._tokens()
        declaration = Declaration(sink, partial(self._withdraw, kind))
        self._declared[kind][declaration] = key_expr, endpoint
        self._routes.clear()
        if kind == "token" and key_expr not in tokens:
            self._announce(key_expr, True)
        elif kind == "liveness":
            for key in tokens:
                if matches(key_expr, key):
                    self._soon(partial(_deliver, (declaration,), Liveness(key, True)))
        return declaration

    def _withdraw(self, kind: str, declaration: Declaration) -> None:
        if declaration not in self._declared[kind]:
            return
        key_expr, _ = self._declared[kind].pop(declaration)
        self._routes.clear()
        if kind == "token" and key_expr not in self._tokens():
            self._announce(key_expr, False)

    def _close(self, endpoint: VirtualEndpoint, answer: bool) -> None:
        del self._endpoints[endpoint.name]
        for declared in self._declared.values():
            for declaration in [d for d, (_, holder) in declared.items() if holder is endpoint]:
                declaration.undeclare()
        for question in [q for q, asker in self._questions.items() if asker is endpoint]:
            if answer:
                self._soon(partial(question.finish, None, CLOSED))
            else:
                question.withdraw()

    def _tokens(self) -> dict[str, None]:
        return dict.fromkeys(key for key, _ in self._declared["token"].values())

    def _announce(self, key: str, alive: bool) -> None:
        watches = self._matching("liveness", key)
        if watches:
            self._soon(lambda: _deliver(watches, Liveness(key, alive)))

    def _matching(self, kind: str, key: str) -> tuple[Declaration, ...]:
        route = self._routes.get((kind, key))
        if route is None:
            declared = self._declared[kind].items()
            route = self._routes[kind, key] = tuple(d for d, (expr, _) in declared if matches(expr, key))
        return route

    def _note(self, sender: VirtualEndpoint, kind: str, key: str, payload: bytes) -> None:
        if self._tap is not None:
            self._tap(self._loop.now_ns, sender.name, kind, key, payload)

    def _soon(self, call: Callable[[], object]) -> None:
        self._loop.schedule_ns(self._loop.now_ns, call)


def _deliver(declarations: tuple[Declaration, ...], event: Event) -> None:
    for declaration in declarations:
        declaration.deliver(event)

"""What the virtual network promises beyond the transport contract: determinism, order, and sudden death."""

import hashlib
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.network_emulation.impaired_transport import ImpairedTransport
from module_agent.network_emulation.profile import PROFILES
from module_agent.transport.transport import (
    NO_ANSWER,
    TIMEOUT,
    Event,
    Liveness,
    Reply,
    Request,
    Sample,
    TransportError,
)
from sim.virtual_time.loop import LoopScheduler, VirtualLoop
from sim.virtual_time.network import VirtualNetwork, matches

CHUNK = st.sampled_from(["a", "b", "ab", "x.5", "q-1"])


@pytest.fixture
def loop() -> Iterator[VirtualLoop]:
    made = VirtualLoop()
    yield made
    made.close()


def run(loop: VirtualLoop, seconds: float = 1.0) -> None:
    loop.call_later(seconds, loop.stop)
    loop.run_forever()


@settings(deadline=None, max_examples=500)
@given(
    st.lists(CHUNK | st.just("*"), max_size=4),
    st.booleans(),
    st.lists(CHUNK, min_size=1, max_size=5),
)
def test_keys_match_as_zenoh_matches_them(chunks, deep, key) -> None:
    if not chunks and not deep:
        return
    expression = "/".join([*chunks, *(["**"] if deep else [])])
    assert matches(expression, "/".join(key)) == zenoh.KeyExpr(expression).includes("/".join(key))


@pytest.mark.parametrize("expression", ["", "/a", "a/", "a//b", "a/**/b", "a*", "a/$*", "a?b", "a#"])
def test_other_expressions_are_refused_with_what_would_be_right(loop, expression) -> None:
    endpoint = VirtualNetwork(loop).endpoint("a")
    with pytest.raises(TransportError, match="chunks are names or"):
        endpoint.subscribe(expression, print)


def test_keys_to_publish_on_or_to_ask_have_no_wildcards(loop) -> None:
    endpoint = VirtualNetwork(loop).endpoint("a")
    for operation in (
        lambda: endpoint.publish("a/*", b""),
        lambda: endpoint.query("a/*", b"", 1.0, print, 1),
        lambda: endpoint.declare_alive("a/*"),
    ):
        with pytest.raises(TransportError, match="is not a key"):
            operation()


def test_only_bytes_cross_the_network(loop) -> None:
    endpoint = VirtualNetwork(loop).endpoint("a")
    endpoint.publish("k", b"known key")
    for payload in ("text", bytearray(b"x"), None):
        with pytest.raises(TypeError, match="bytes"):
            endpoint.publish("k", payload)  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="bytes"):
            endpoint.query("k", payload, 1.0, print, 1)  # type: ignore[arg-type]


def test_nothing_is_delivered_inside_the_call_that_sends_it(loop) -> None:
    network = VirtualNetwork(loop)
    a, b = network.endpoint("a"), network.endpoint("b")
    got: list[Event] = []
    b.subscribe("k", got.append)
    b.serve("q", lambda event: (got.append(event), event.reply(b"r")))  # type: ignore[union-attr]
    b.declare_alive("t")
    for act in (
        lambda: a.publish("k", b""),
        lambda: a.query("q", b"", 1.0, got.append, 1),
        lambda: a.watch_alive("t", got.append),
    ):
        before = len(got)
        act()
        assert len(got) == before
        run(loop)
        assert len(got) > before


def test_a_perfect_network_takes_no_time_and_keeps_the_order_of_sending(loop) -> None:
    network = VirtualNetwork(loop)
    a, b, c = (network.endpoint(name) for name in "abc")
    got: list[tuple[int, bytes]] = []
    c.subscribe("**", lambda event: got.append((loop.now_ns, event.payload)))  # type: ignore[union-attr]
    loop.schedule_ns(7, lambda: (a.publish("k/a", b"1"), b.publish("k/b", b"2"), a.publish("k/c", b"3")))
    run(loop)
    assert got == [(7, b"1"), (7, b"2"), (7, b"3")]


def test_a_subscription_made_later_hears_only_what_comes_later(loop) -> None:
    network = VirtualNetwork(loop)
    a, b = network.endpoint("a"), network.endpoint("b")
    got: list[Event] = []
    a.publish("k", b"before")
    b.subscribe("k", got.append)
    a.publish("k", b"after")
    run(loop)
    assert got == [Sample("k", b"after")]


def test_time_outs_come_exactly_on_time(loop) -> None:
    network = VirtualNetwork(loop)
    a, b = network.endpoint("a"), network.endpoint("b")
    b.serve("k", lambda event: None)
    got: list[tuple[int, Event]] = []
    a.query("k", b"", 0.25, lambda event: got.append((loop.now_ns, event)), 4)
    run(loop)
    assert got == [(250_000_000, Reply(4, "k", None, TIMEOUT))]


def test_killing_drops_requests_queries_and_tokens(loop) -> None:
    network = VirtualNetwork(loop)
    a, b = network.endpoint("a"), network.endpoint("b")
    held: list[Request] = []
    got: list[Event] = []
    alive: list[Event] = []
    lost: list[Event] = []
    b.serve("k", held.append)  # type: ignore[arg-type]
    b.declare_alive("b/alive")
    a.serve("own", lambda event: None)
    a.watch_alive("*/alive", alive.append)
    a.query("k", b"", 0.5, got.append, 1)
    b.query("own", b"", 0.5, lost.append, 2)
    run(loop, 0.1)
    assert alive == [Liveness("b/alive", True)]
    network.kill("b")
    held[0].reply(b"from the grave")
    run(loop)
    assert got == [Reply(1, "k", None, TIMEOUT)]
    assert alive == [Liveness("b/alive", True), Liveness("b/alive", False)]
    assert lost == []
    with pytest.raises(TransportError, match="'b' was killed"):
        b.publish("k", b"")


def test_a_name_is_free_again_after_close_or_kill(loop) -> None:
    network = VirtualNetwork(loop)
    first = network.endpoint("a")
    with pytest.raises(ValueError, match="'a' is open"):
        network.endpoint("a")
    first.close()
    network.endpoint("a")
    network.kill("a")
    second = network.endpoint("a")
    first.close()
    second.publish("k", b"the close of a predecessor is none of its business")
    with pytest.raises(KeyError, match="open are a"):
        network.kill("b")


def test_a_token_held_twice_vanishes_with_its_last_holder(loop) -> None:
    network = VirtualNetwork(loop)
    a, b = network.endpoint("a"), network.endpoint("b")
    got: list[Event] = []
    a.watch_alive("t", got.append)
    first, _ = a.declare_alive("t"), b.declare_alive("t")
    first.undeclare()
    run(loop)
    assert got == [Liveness("t", True)]
    b.close()
    run(loop)
    assert got == [Liveness("t", True), Liveness("t", False)]


def test_a_query_asked_before_the_server_came_finds_nobody(loop) -> None:
    network = VirtualNetwork(loop)
    a, b = network.endpoint("a"), network.endpoint("b")
    got: list[Event] = []
    a.query("k", b"", 0.5, got.append, 1)
    run(loop)
    b.serve("k", lambda event: event.reply(b""))  # type: ignore[union-attr]
    a.query("k", b"", 0.5, got.append, 2)
    run(loop)
    assert got == [Reply(1, "k", None, NO_ANSWER), Reply(2, "k", b"")]


def trace_hash(seed: int) -> str:
    """Run a small traffic over the bad network and hash every message, when, where and what."""
    loop = VirtualLoop()
    digest = hashlib.sha256()

    def tap(*message: object) -> None:
        digest.update(repr(message).encode())

    network = VirtualNetwork(loop, tap)
    rng = np.random.default_rng(seed)
    ends = {
        name: ImpairedTransport(
            network.endpoint(name),
            PROFILES["bad"],
            rng.spawn(1)[0],
            LoopScheduler(loop),
            receiver="module",
        )
        for name in ("a", "b", "c")
    }

    def note(name: str, event: Event) -> None:
        payload = event.payload if isinstance(event, (Sample, Request, Reply)) else None
        digest.update(repr((loop.now_ns, name, type(event).__name__, event.key, payload)).encode())
        if isinstance(event, Request):
            event.reply(event.payload)

    for name, end in ends.items():
        end.subscribe("*/s", lambda event, name=name: note(name, event))
        end.serve(f"{name}/q", lambda event, name=name: note(name, event))

    def tick(number: int) -> None:
        for name, end in ends.items():
            end.publish(f"{name}/s", number.to_bytes(4))
            end.query(f"{'abc'[number % 3]}/q", b"?", 0.1, lambda event, name=name: note(name, event), number)
        loop.call_later(0.004, tick, number + 1)

    tick(0)
    run(loop, 2.0)
    loop.close()
    return digest.hexdigest()


def test_the_same_seed_gives_the_same_trace_and_another_seed_another() -> None:
    assert trace_hash(1) == trace_hash(1)
    assert trace_hash(1) != trace_hash(2)

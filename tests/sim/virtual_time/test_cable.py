"""What a cable does to messages it does in both directions, and to the answers to questions as well."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

from module_agent.network_emulation.impaired_transport import ImpairedTransport
from module_agent.network_emulation.profile import PROFILES
from module_agent.transport.transport import (
    CLOSED,
    LEASE_S,
    TIMEOUT,
    Event,
    Liveness,
    Reply,
    Request,
    Transport,
    TransportError,
)
from sim.virtual_time.cable import Cable, CableState
from sim.virtual_time.loop import LoopScheduler, VirtualLoop
from sim.virtual_time.network import VirtualNetwork

KEY, TIMEOUT_S = "a/b", 0.5
Arrival = tuple[float, Any]


class Ends:
    """A program behind a cable, another on the same perfect network, and what arrives at both, and when."""

    def __init__(self, **state: Any):
        self.loop = VirtualLoop()
        self.network = VirtualNetwork(self.loop)
        self.state = CableState(**state)
        self.near = Cable(self._endpoint("near"), self.loop, self.state)
        self.far = self.network.endpoint("far")
        self.arrived: list[Arrival] = []

    def _endpoint(self, name: str) -> ImpairedTransport:
        scheduler = LoopScheduler(self.loop)
        rng = np.random.default_rng(1)
        perfect = PROFILES["none"]
        return ImpairedTransport(self.network.endpoint(name), perfect, rng, scheduler, receiver="coordinator")

    def note(self, event: Event) -> None:
        value = event.alive if isinstance(event, Liveness) else event.payload
        error = event.error if isinstance(event, Reply) else ""
        self.arrived.append((round(self.loop.time(), 6), error or value))

    def answer(self, event: Event) -> None:
        assert isinstance(event, Request)
        self.note(event)
        event.reply(b"yes")

    def at(self, time_s: float, call: Callable[[], object]) -> None:
        self.loop.call_at(time_s, call)

    def run(self, until_s: float = 3.0) -> list[Arrival]:
        self.loop.call_at(until_s, self.loop.stop)
        self.loop.run_forever()
        return self.arrived


@pytest.fixture
def ends() -> Iterator[Callable[..., Ends]]:
    made: list[Ends] = []

    def make(**state: Any) -> Ends:
        made.append(Ends(**state))
        return made[-1]

    yield make
    for each in made:
        each.loop.close()


def published(ends: Ends, sender: Transport, receiver: Transport) -> list[Arrival]:
    receiver.subscribe(KEY, ends.note)
    ends.at(1.0, lambda: sender.publish(KEY, b"abc"))
    return ends.run()


def asked(ends: Ends, asker: Transport, server: Transport) -> list[Arrival]:
    server.serve(KEY, ends.answer)
    ends.at(1.0, lambda: asker.query(KEY, b"abc", TIMEOUT_S, ends.note, 7))
    return ends.run()


def inverted(payload: bytes, at: int) -> bytes:
    return payload[:at] + bytes([payload[at] ^ 0xFF]) + payload[at + 1 :]


@pytest.mark.parametrize("outward", [True, False])
@pytest.mark.parametrize(
    ("state", "arrivals"),
    [
        ({}, [(1.0, b"abc")]),
        ({"cut": True}, []),
        ({"flip": 4}, [(1.0, inverted(b"abc", 1))]),
        ({"copies": 2}, [(1.0, b"abc")] * 3),
        ({"delay_s": 0.1}, [(1.1, b"abc")]),
        ({"copies": 1, "delay_s": 0.1, "flip": 0}, [(1.1, inverted(b"abc", 0))] * 2),
    ],
)
def test_publications_suffer_on_their_way_out_as_on_their_way_in(
    ends: Callable[..., Ends], state: dict[str, Any], arrivals: list[Arrival], outward: bool
) -> None:
    one = ends(**state)
    way = (one.near, one.far) if outward else (one.far, one.near)
    assert published(one, *way) == arrivals


@pytest.mark.parametrize("outward", [True, False])
@pytest.mark.parametrize(
    ("state", "arrivals"),
    [
        ({}, [(1.0, b"abc"), (1.0, b"yes")]),
        ({"cut": True}, [(1.5, TIMEOUT)]),
        ({"flip": 4}, [(1.0, inverted(b"abc", 1)), (1.0, inverted(b"yes", 1))]),
        # Of two answers to one question there is but one reply.
        ({"copies": 1}, [(1.0, b"abc"), (1.0, b"abc"), (1.0, b"yes")]),
        ({"delay_s": 0.1}, [(1.1, b"abc"), (1.2, b"yes")]),
        # The answer is too late.
        ({"delay_s": 0.3}, [(1.3, b"abc"), (1.5, TIMEOUT)]),
    ],
)
def test_questions_and_their_answers_suffer_in_both_directions(
    ends: Callable[..., Ends], state: dict[str, Any], arrivals: list[Arrival], outward: bool
) -> None:
    one = ends(**state)
    way = (one.near, one.far) if outward else (one.far, one.near)
    assert asked(one, *way) == arrivals


def test_an_answer_is_lost_where_the_cable_is_cut_before_it_comes(ends: Callable[..., Ends]) -> None:
    one = ends()
    requests: list[Any] = []
    one.far.serve(KEY, requests.append)
    one.at(1.0, lambda: one.near.query(KEY, b"abc", TIMEOUT_S, one.note, 7))
    one.at(1.1, partial(setattr, one.state, "cut", True))
    one.at(1.2, lambda: requests[0].reply(b"yes"))
    assert one.run() == [(1.5, TIMEOUT)]


@pytest.mark.parametrize(
    ("lasts_s", "arrivals"),
    [
        (0.9 * LEASE_S, [(0.0, True)]),
        # The session's lease is over: others are there for each other no more, until the cable is whole.
        (1.5 * LEASE_S, [(0.0, True), (1.0 + LEASE_S, False), (1.0 + 1.5 * LEASE_S, True)]),
    ],
)
def test_who_is_cut_off_for_longer_than_a_lease_is_gone_for_the_other(
    ends: Callable[..., Ends], lasts_s: float, arrivals: list[Arrival]
) -> None:
    for inward in (True, False):
        one = ends()
        token, watch = (one.far, one.near) if inward else (one.near, one.far)
        token.declare_alive(KEY)
        watch.watch_alive(KEY, one.note)
        one.at(1.0, partial(setattr, one.state, "cut", True))
        one.at(1.0 + lasts_s, partial(setattr, one.state, "cut", False))
        assert one.run() == arrivals


def test_a_program_that_begins_behind_a_cut_cable_hears_of_the_others_when_it_is_whole(
    ends: Callable[..., Ends],
) -> None:
    one = ends(cut=True)
    one.far.declare_alive(KEY)
    one.near.watch_alive(KEY, one.note)
    one.at(0.5, partial(setattr, one.state, "cut", False))
    assert one.run() == [(0.5, True)]


def test_what_is_in_the_cable_when_its_program_ends_is_lost(ends: Callable[..., Ends]) -> None:
    for end in (lambda one: one.near.close(), lambda one: one.network.kill("near")):
        one = ends(delay_s=0.1)
        one.far.subscribe(KEY, one.note)
        one.at(1.0, lambda one=one: one.near.publish(KEY, b"abc"))
        one.at(1.05, partial(end, one))
        assert one.run() == []


def test_a_question_that_is_in_the_cable_when_it_is_closed_ends(ends: Callable[..., Ends]) -> None:
    one = ends(delay_s=0.1)
    one.far.serve(KEY, one.answer)
    one.at(1.0, lambda: one.near.query(KEY, b"abc", TIMEOUT_S, one.note, 7))
    one.at(1.05, one.near.close)
    assert one.run() == [(1.05, CLOSED)]


def test_what_is_given_to_a_cable_after_its_end_is_refused_at_once(ends: Callable[..., Ends]) -> None:
    one = ends()
    one.near.close()
    with pytest.raises(TransportError):
        one.near.publish(KEY, b"abc")
    with pytest.raises(TransportError):
        one.near.query(KEY, b"abc", TIMEOUT_S, one.note, 7)
    assert one.run() == []


def test_a_cable_tells_when_it_was_given_what_it_sends_on(ends: Callable[..., Ends]) -> None:
    seen: list[tuple[float, float | None]] = []
    one = ends(delay_s=0.1)
    tapped = VirtualNetwork(one.loop, lambda now_ns, *_: seen.append((1e-9 * now_ns, one.near.given_ns)))
    one.network = tapped
    one.near = Cable(one._endpoint("near"), one.loop, one.state)
    one.at(1.0, lambda: one.near.publish(KEY, b"abc"))
    one.run()
    assert seen == [(pytest.approx(1.1), 1_000_000_000)]
    assert one.near.given_ns is None


def test_a_declaration_that_has_ended_delivers_nothing_that_was_delayed(ends: Callable[..., Ends]) -> None:
    one = ends(delay_s=0.1)
    declared = one.near.subscribe(KEY, one.note)
    one.at(1.0, lambda: one.far.publish(KEY, b"abc"))
    one.at(1.05, declared.undeclare)
    assert one.run() == []

"""What the docstrings of `Transport` promise, over every implementation, bare and behind a LAN's delays."""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from itertools import count

import numpy as np
import pytest

from module_agent.network_emulation.impaired_transport import ImpairedTransport
from module_agent.network_emulation.profile import PROFILES
from module_agent.network_emulation.scheduler import Scheduler, TimerThread
from module_agent.transport.transport import (
    CLOSED,
    NO_ANSWER,
    TIMEOUT,
    Event,
    Liveness,
    Reply,
    Request,
    Sample,
    Transport,
    TransportError,
)
from module_agent.transport.zenoh_transport import ZenohConfig, open_zenoh
from sim.virtual_time.loop import LoopScheduler, VirtualLoop
from sim.virtual_time.network import VirtualNetwork

LIMIT_S = 10.0

# Every closed session leaves an idle thread for 10 s in a pool of at most 50; these tests would exhaust it.
os.environ.setdefault("ZENOH_RUNTIME", "(app: (max_blocking_threads: 500), net: (max_blocking_threads: 500))")


class Rig:
    """Two endpoints of one network, and a way to let its time pass."""

    def __init__(
        self,
        a: Transport,
        b: Transport,
        passes: Callable[[], None],
        now_s: Callable[[], float],
        threaded: bool,
    ):
        self.a = a
        self.b = b
        self.threaded = threaded
        self._passes = passes
        self._now_s = now_s
        self._numbers = count()

    def until(self, condition: Callable[[], bool]) -> None:
        end_s = self._now_s() + LIMIT_S
        while not condition():
            assert self._now_s() < end_s, "did not come about"
            self._passes()

    def settle(self) -> None:
        """Wait until each end knows what the other has declared: declarations travel in order."""
        for near, far in ((self.a, self.b), (self.b, self.a)):
            key = f"sync/{next(self._numbers)}"
            seen: list[Event] = []
            token = near.declare_alive(key)
            watch = far.watch_alive(key, seen.append)
            self.until(lambda seen=seen: bool(seen))
            watch.undeclare()
            token.undeclare()

    def flush(self, sender: Transport, receiver: Transport) -> None:
        """Wait until everything sent so far has arrived."""
        key = f"flush/{next(self._numbers)}"
        got: list[Event] = []
        subscription = receiver.subscribe(key, got.append)
        self.settle()
        sender.publish(key, b"")
        self.until(lambda: bool(got))
        subscription.undeclare()
        for _ in range(20):
            self._passes()


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def impaired(inner: Transport, scheduler: Scheduler, seed: int) -> Transport:
    return ImpairedTransport(
        inner, PROFILES["lan"], np.random.default_rng(seed), scheduler, receiver="module"
    )


@pytest.fixture(params=["zenoh", "zenoh-lan", "virtual", "virtual-lan"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    wrapped = request.param.endswith("lan")
    if request.param.startswith("zenoh"):
        endpoint = free_endpoint()
        a: Transport = open_zenoh(ZenohConfig.hub(endpoint))
        b: Transport = open_zenoh(ZenohConfig.spoke(endpoint))
        timer = TimerThread()
        if wrapped:
            a, b = impaired(a, timer, 1), impaired(b, timer, 2)
        yield Rig(a, b, lambda: time.sleep(0.001), time.monotonic, True)
        a.close()
        b.close()
        timer.close()
        return
    loop = VirtualLoop()
    network = VirtualNetwork(loop)
    a, b = network.endpoint("a"), network.endpoint("b")
    if wrapped:
        a, b = impaired(a, LoopScheduler(loop), 1), impaired(b, LoopScheduler(loop), 2)

    def passes() -> None:
        loop.call_later(0.001, loop.stop)
        loop.run_forever()

    yield Rig(a, b, passes, loop.time, False)
    a.close()
    b.close()
    loop.close()


def test_a_sample_reaches_every_matching_subscriber_and_no_other(rig: Rig) -> None:
    exact: list[Event] = []
    star: list[Event] = []
    deep: list[Event] = []
    other: list[Event] = []
    rig.b.subscribe("x5/r/7/feedback", exact.append)
    rig.b.subscribe("x5/r/*/feedback", star.append)
    rig.b.subscribe("x5/**", deep.append)
    rig.b.subscribe("x5/*/feedback", other.append)
    rig.settle()
    rig.a.publish("x5/r/7/feedback", b"\x00one")
    rig.a.publish("x5/r/8/feedback", b"two")
    rig.until(lambda: len(deep) == 2 and len(star) == 2 and len(exact) == 1)
    rig.flush(rig.a, rig.b)
    seven, eight = Sample("x5/r/7/feedback", b"\x00one"), Sample("x5/r/8/feedback", b"two")
    assert exact == [seven]
    assert set(star) == {seven, eight}
    assert set(deep) == {seven, eight}
    assert other == []


def test_an_endpoint_hears_itself(rig: Rig) -> None:
    got: list[Event] = []
    rig.a.subscribe("k", got.append)
    rig.a.publish("k", b"own")
    rig.until(lambda: bool(got))
    assert got == [Sample("k", b"own")]


def test_samples_of_one_key_keep_their_order(rig: Rig) -> None:
    got: list[Event] = []
    rig.b.subscribe("k", got.append)
    rig.settle()
    sent = [Sample("k", str(i).encode()) for i in range(100)]
    for sample in sent:
        rig.a.publish(*sample)
    rig.until(lambda: len(got) >= 100)
    assert got == sent


def test_after_undeclare_nothing_is_delivered(rig: Rig) -> None:
    ended: list[Event] = []
    kept: list[Event] = []
    subscription = rig.b.subscribe("k", ended.append)
    rig.b.subscribe("k", kept.append)
    rig.settle()
    rig.a.publish("k", b"before")
    rig.until(lambda: bool(ended))
    subscription.undeclare()
    subscription.undeclare()
    rig.a.publish("k", b"after")
    rig.until(lambda: len(kept) == 2)
    assert ended == [Sample("k", b"before")]


def test_a_query_gets_the_answer_of_the_server(rig: Rig) -> None:
    got: list[Event] = []
    asked: list[Request] = []

    def serve(event: Event) -> None:
        assert isinstance(event, Request)
        asked.append(event)
        event.reply(b"answer to " + event.payload)

    rig.b.serve("x5/r/*/info", serve)
    rig.settle()
    rig.a.query("x5/r/7/info", b"who", 5.0, got.append, 42)
    rig.until(lambda: bool(got))
    assert got == [Reply(42, "x5/r/7/info", b"answer to who")]
    assert [(r.key, r.payload) for r in asked] == [("x5/r/7/info", b"who")]


def test_an_empty_answer_is_an_answer(rig: Rig) -> None:
    got: list[Event] = []
    rig.b.serve("k", lambda event: event.reply(b""))  # type: ignore[union-attr]
    rig.settle()
    rig.a.query("k", b"", 5.0, got.append, 1)
    rig.until(lambda: bool(got))
    assert got == [Reply(1, "k", b"")]


def test_a_request_may_be_answered_later_and_elsewhere_but_only_once(rig: Rig) -> None:
    got: list[Event] = []
    held: list[Request] = []
    rig.b.serve("k", held.append)  # type: ignore[arg-type]
    rig.settle()
    rig.a.query("k", b"", 5.0, got.append, 1)
    rig.until(lambda: bool(held))
    if rig.threaded:
        answering = threading.Thread(target=held[0].reply, args=(b"first",))
        answering.start()
        answering.join()
    else:
        held[0].reply(b"first")
    held[0].reply(b"second")
    rig.until(lambda: bool(got))
    rig.flush(rig.b, rig.a)
    assert got == [Reply(1, "k", b"first")]


def test_of_two_servers_the_first_answer_is_the_only_reply(rig: Rig) -> None:
    got: list[Event] = []
    held: list[Request] = []
    rig.a.serve("k", held.append)  # type: ignore[arg-type]
    rig.b.serve("k", held.append)  # type: ignore[arg-type]
    rig.settle()
    rig.a.query("k", b"", 5.0, got.append, 1)
    rig.until(lambda: len(held) == 2)
    held[0].reply(b"quick")
    # The other has not answered: the first must not wait for it.
    rig.until(lambda: bool(got))
    held[1].reply(b"slow")
    rig.flush(rig.b, rig.a)
    assert got == [Reply(1, "k", b"quick")]


def test_a_query_on_a_key_without_server_says_so(rig: Rig) -> None:
    got: list[Event] = []
    rig.a.query("unserved", b"", 5.0, got.append, 3)
    rig.until(lambda: bool(got))
    assert got == [Reply(3, "unserved", None, NO_ANSWER)]


def test_an_unanswered_query_times_out_once_and_a_late_answer_is_ignored(rig: Rig) -> None:
    got: list[Event] = []
    held: list[Request] = []
    rig.b.serve("k", held.append)  # type: ignore[arg-type]
    rig.settle()
    rig.a.query("k", b"", 0.1, got.append, 9)
    rig.until(lambda: bool(got and held))
    assert len(held) == 1
    held[0].reply(b"too late")
    rig.flush(rig.b, rig.a)
    assert got == [Reply(9, "k", None, TIMEOUT)]


def test_tokens_are_seen_whether_declared_before_or_after(rig: Rig) -> None:
    rig.b.declare_alive("x5/r/before/alive")
    rig.settle()
    seen: list[Event] = []
    rig.a.watch_alive("x5/r/*/alive", seen.append)
    rig.until(lambda: bool(seen))
    token = rig.b.declare_alive("x5/r/after/alive")
    rig.until(lambda: len(seen) == 2)
    token.undeclare()
    token.undeclare()
    rig.until(lambda: len(seen) == 3)
    assert seen == [
        Liveness("x5/r/before/alive", True),
        Liveness("x5/r/after/alive", True),
        Liveness("x5/r/after/alive", False),
    ]


def test_closing_ends_tokens_services_and_subscriptions(rig: Rig) -> None:
    seen: list[Event] = []
    heard: list[Event] = []
    got: list[Event] = []
    rig.b.declare_alive("alive")
    rig.b.serve("k", lambda event: event.reply(b"here"))  # type: ignore[union-attr]
    rig.b.subscribe("s", heard.append)
    rig.a.watch_alive("alive", seen.append)
    rig.until(lambda: seen == [Liveness("alive", True)])
    rig.b.close()
    rig.b.close()
    rig.until(lambda: seen == [Liveness("alive", True), Liveness("alive", False)])
    rig.a.publish("s", b"")
    rig.a.query("k", b"", 0.2, got.append, 1)
    rig.until(lambda: bool(got))
    assert got[0].payload is None  # type: ignore[union-attr]
    assert heard == []


def test_closing_answers_the_queries_under_way(rig: Rig) -> None:
    got: list[Event] = []
    held: list[Request] = []
    rig.b.serve("k", held.append)  # type: ignore[arg-type]
    rig.settle()
    rig.a.query("k", b"", 5.0, got.append, 1)
    rig.until(lambda: bool(held))
    rig.a.close()
    rig.until(lambda: bool(got))
    held[0].reply(b"too late")
    assert got == [Reply(1, "k", None, CLOSED)]


def test_a_server_that_closed_meanwhile_may_still_call_reply(rig: Rig) -> None:
    got: list[Event] = []
    held: list[Request] = []
    rig.b.serve("k", held.append)  # type: ignore[arg-type]
    rig.settle()
    rig.a.query("k", b"", 0.2, got.append, 1)
    rig.until(lambda: bool(held))
    rig.b.close()
    held[0].reply(b"from the grave")
    rig.until(lambda: bool(got))
    assert len(got) == 1
    assert got[0].payload is None  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "operation",
    [
        lambda t: t.publish("k", b""),
        lambda t: t.subscribe("k", print),
        lambda t: t.serve("k", print),
        lambda t: t.query("k", b"", 1.0, print, 1),
        lambda t: t.declare_alive("k"),
        lambda t: t.watch_alive("k", print),
    ],
    ids=["publish", "subscribe", "serve", "query", "declare_alive", "watch_alive"],
)
def test_a_closed_transport_refuses_everything(rig: Rig, operation: Callable[[Transport], object]) -> None:
    rig.a.publish("k", b"declares the publisher")
    rig.a.close()
    with pytest.raises(TransportError, match="closed"):
        operation(rig.a)

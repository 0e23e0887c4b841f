"""What the impairing wrapper does to an endpoint, over a transport of these tests' own that does nothing."""

import heapq
import threading
from collections.abc import Callable
from itertools import count

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.network_emulation.impaired_transport import ImpairedTransport
from module_agent.network_emulation.profile import PROFILES, NetworkProfile
from module_agent.network_emulation.scheduler import TimerThread
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


class ManualTime:
    """A scheduler whose time passes when the test says so."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._counter = count()

    def call_later(self, delay_s: float, call: Callable[[], None]) -> None:
        heapq.heappush(self._heap, (self.now_s + delay_s, next(self._counter), call))

    def run(self, until_s: float = float("inf")) -> None:
        while self._heap and self._heap[0][0] <= until_s:
            self.now_s, _, call = heapq.heappop(self._heap)
            call()
        self.now_s = max(self.now_s, until_s) if until_s < float("inf") else self.now_s


class Nothing:
    def undeclare(self) -> None:
        pass


class Bare:
    """An inner transport that only remembers: the tests play the network."""

    def __init__(self) -> None:
        self.sinks: dict[str, Sink] = {}
        self.asked: list[tuple[int, Sink]] = []
        self.sent: list[tuple[str, bytes]] = []
        self.closed = False

    def publish(self, key: str, payload: bytes) -> None:
        self.sent.append((key, payload))

    def subscribe(self, key_expr: str, sink: Sink) -> Nothing:
        self.sinks["sample"] = sink
        return Nothing()

    def serve(self, key_expr: str, sink: Sink) -> Nothing:
        self.sinks["request"] = sink
        return Nothing()

    def query(self, key: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        if self.closed:
            raise TransportError("closed")
        self.asked.append((tag, sink))

    def declare_alive(self, key: str) -> Nothing:
        return Nothing()

    def watch_alive(self, key_expr: str, sink: Sink) -> Nothing:
        self.sinks["liveness"] = sink
        return Nothing()

    def close(self) -> None:
        self.closed = True


def make(found: NetworkProfile, seed: int = 0) -> tuple[ImpairedTransport, Bare, ManualTime]:
    inner, clock = Bare(), ManualTime()
    return (
        ImpairedTransport(inner, found, np.random.default_rng(seed), clock, receiver="module"),
        inner,
        clock,
    )


PROBABILITY = st.floats(0.0, 1.0)


def profiles(
    loss: st.SearchStrategy[float] = PROBABILITY, reorder: st.SearchStrategy[float] = PROBABILITY
) -> st.SearchStrategy[NetworkProfile]:
    return st.builds(
        NetworkProfile,
        name=st.just("drawn"),
        delay_ms=st.floats(0.0, 50.0),
        jitter_ms=st.floats(0.0, 50.0),
        jitter_shape=st.floats(0.3, 5.0),
        loss=loss,
        reorder=reorder,
        duplicate=PROBABILITY,
    )


def deliveries(
    found: NetworkProfile, seed: int, messages: list[tuple[float, int]]
) -> list[tuple[float, Event]]:
    """Send numbered samples on a few keys, each a while after the last; return what arrived when."""
    transport, inner, clock = make(found, seed)
    got: list[tuple[float, Event]] = []
    transport.subscribe("**", lambda event: got.append((clock.now_s, event)))
    at_s = 0.0
    for number, (gap_s, key) in enumerate(messages):
        at_s += gap_s
        clock.run(at_s)
        inner.sinks["sample"](Sample(f"k/{key}", str(number).encode()))
    clock.run()
    return got


def messages() -> st.SearchStrategy[list[tuple[float, int]]]:
    return st.lists(st.tuples(st.floats(0.0, 0.05), st.integers(0, 2)), max_size=60)


@settings(deadline=None)
@given(profiles(loss=st.just(0.0)), st.integers(0, 2**32), messages())
def test_without_loss_every_sample_arrives_no_earlier_than_the_least_delay(found, seed, sent) -> None:
    got = deliveries(found, seed, sent)
    assert {int(event.payload) for _, event in got} == set(range(len(sent)))
    sent_s = np.cumsum([gap_s for gap_s, _ in sent])
    for at_s, event in got:
        assert at_s >= sent_s[int(event.payload)] + 1e-3 * found.delay_ms - 1e-9


@settings(deadline=None)
@given(profiles(reorder=st.just(0.0)), st.integers(0, 2**32), messages())
def test_without_reordering_each_key_keeps_its_order(found, seed, sent) -> None:
    got = deliveries(found, seed, sent)
    for key in ("k/0", "k/1", "k/2"):
        numbers = [int(event.payload) for _, event in got if event.key == key]
        assert numbers == sorted(numbers)


@settings(deadline=None)
@given(profiles(), st.integers(0, 2**32), messages())
def test_no_sample_arrives_more_than_twice_and_drops_are_counted(found, seed, sent) -> None:
    transport, inner, clock = make(found, seed)
    got: list[Event] = []
    transport.subscribe("**", got.append)
    for number, (_, key) in enumerate(sent):
        inner.sinks["sample"](Sample(f"k/{key}", str(number).encode()))
    clock.run()
    copies = [sum(event.payload == str(n).encode() for event in got) for n in range(len(sent))]
    assert max(copies, default=0) <= 2
    assert copies.count(0) == transport.drops.samples


@settings(max_examples=30, deadline=None)
@given(profiles(), st.integers(0, 2**32), messages())
def test_the_same_seed_gives_the_same_deliveries(found, seed, sent) -> None:
    assert deliveries(found, seed, sent) == deliveries(found, seed, sent)


def test_another_seed_gives_other_deliveries() -> None:
    sent = [(0.01, 0)] * 20
    assert deliveries(PROFILES["wifi"], 1, sent) != deliveries(PROFILES["wifi"], 2, sent)


@settings(deadline=None)
@given(
    profiles(),
    st.integers(0, 2**32),
    st.lists(
        st.tuples(st.floats(0.001, 0.2), st.sampled_from(["answer", "error", "nothing", "twice"])),
        max_size=30,
    ),
    st.booleans(),
)
def test_every_query_gets_exactly_one_reply(found, seed, queries, close_early) -> None:
    transport, inner, clock = make(found, seed)
    got: list[tuple[float, Event]] = []
    for tag, (timeout_s, fate) in enumerate(queries):
        transport.query("k", b"", timeout_s, lambda event: got.append((clock.now_s, event)), tag)
        asked, sink = inner.asked[-1]
        assert asked == tag
        if fate == "error":
            sink(Reply(tag, "k", None, NO_ANSWER))
        for _ in range({"answer": 1, "twice": 2}.get(fate, 0)):
            sink(Reply(tag, "k", b"yes"))
    if close_early:
        clock.run(0.02)
        transport.close()
    clock.run()
    replies = {event.tag: event for _, event in got}
    assert len(got) == len(replies) == len(queries)
    for at_s, event in got:
        timeout_s, fate = queries[event.tag]
        assert at_s <= timeout_s + 1e-9
        if event.payload is None:
            assert event.error in (TIMEOUT, CLOSED, NO_ANSWER)
        else:
            assert fate in ("answer", "twice")


@settings(deadline=None)
@given(profiles(), st.integers(0, 2**32), st.integers(1, 20))
def test_a_request_is_answered_at_most_once_however_often_it_arrives(found, seed, number) -> None:
    transport, inner, clock = make(found, seed)
    transport.serve("k", lambda event: event.reply(b"yes"))
    answers: list[list[bytes]] = [[] for _ in range(number)]
    for out in answers:
        inner.sinks["request"](Request("k", b"", out.append))
    clock.run()
    assert max(len(out) for out in answers) <= 1
    assert sum(not out for out in answers) == transport.drops.requests


def test_a_lost_request_stays_alive_until_its_asker_has_given_up() -> None:
    """Zenoh would report "no answer" to the asker at once if the request were garbage collected."""
    transport, inner, clock = make(NetworkProfile(name="dead", loss=1.0))
    transport.serve("k", lambda event: None)
    ended: list[float] = []

    class Answer:
        def __call__(self, payload: bytes) -> None:
            pass

        def __del__(self) -> None:
            ended.append(clock.now_s)

    inner.sinks["request"](Request("k", b"", Answer()))
    clock.run(10.0)
    assert ended == []
    clock.run(100.0)
    assert len(ended) == 1


@settings(deadline=None)
@given(profiles(), st.integers(0, 2**32), st.lists(st.booleans(), max_size=30))
def test_liveliness_is_late_but_complete_and_in_order(found, seed, changes) -> None:
    transport, inner, clock = make(found, seed)
    got: list[Event] = []
    transport.watch_alive("**", got.append)
    for alive in changes:
        inner.sinks["liveness"](Liveness("alive", alive))
    if found.delay_ms > 0.0:
        assert got == []
    clock.run()
    assert got == [Liveness("alive", alive) for alive in changes]


def test_delay_and_loss_have_the_statistics_of_the_profile() -> None:
    found = NetworkProfile(
        name="t", delay_ms=2.0, jitter_ms=4.0, jitter_shape=0.7, loss=0.1, duplicate=0.05, reorder=1.0
    )
    number = 20_000
    transport, inner, clock = make(found, 5)
    delays_s: list[float] = []
    transport.subscribe("**", lambda event: delays_s.append(clock.now_s))
    for _ in range(number):
        inner.sinks["sample"](Sample("k", b""))
    clock.run()
    # Five standard deviations: of binomial fractions, and of a gamma's mean (deviation: mean / sqrt(shape)).
    lost = transport.drops.samples
    assert abs(lost / number - 0.1) < 5 * np.sqrt(0.1 * 0.9 / number)
    copies = len(delays_s) - (number - lost)
    assert abs(copies / (number - lost) - 0.05) < 5 * np.sqrt(0.05 * 0.95 / number)
    deviation_s = 4e-3 / np.sqrt(0.7)
    assert abs(np.mean(delays_s) - 6e-3) < 5 * deviation_s / np.sqrt(len(delays_s))
    assert abs(np.std(delays_s) / deviation_s - 1.0) < 0.1


def test_reordering_overtakes() -> None:
    found = NetworkProfile(name="t", jitter_ms=10.0, reorder=0.5)
    numbers = [int(event.payload) for _, event in deliveries(found, 0, [(0.001, 0)] * 200)]
    assert sorted(numbers) == list(range(200))
    assert numbers != sorted(numbers)


def test_over_a_perfect_network_everything_arrives_at_once() -> None:
    transport, inner, _ = make(PROFILES["none"])
    got: list[Event] = []
    transport.subscribe("**", got.append)
    transport.watch_alive("**", got.append)
    transport.serve("**", lambda event: event.reply(b"yes"))
    sample, liveness, answers = Sample("k", b"x"), Liveness("k", True), list[bytes]()
    inner.sinks["sample"](sample)
    inner.sinks["liveness"](liveness)
    inner.sinks["request"](Request("k", b"", answers.append))
    transport.query("k", b"", 1.0, got.append, 3)
    inner.asked[0][1](Reply(3, "k", b"there"))
    assert got == [sample, liveness, Reply(3, "k", b"there")]
    assert answers == [b"yes"]


def test_what_the_endpoint_sends_goes_out_untouched() -> None:
    transport, inner, _ = make(NetworkProfile(name="dead", loss=1.0, delay_ms=100.0))
    transport.publish("k", b"x")
    assert inner.sent == [("k", b"x")]


def test_nothing_is_delivered_after_undeclare_or_close() -> None:
    found = NetworkProfile(name="slow", delay_ms=10.0)
    for end in ("undeclare", "close"):
        transport, inner, clock = make(found)
        got: list[Event] = []
        subscription = transport.subscribe("**", got.append)
        inner.sinks["sample"](Sample("k", b"under way"))
        subscription.undeclare() if end == "undeclare" else transport.close()
        clock.run()
        assert got == []


def test_closing_answers_queries_once_and_later_ones_are_refused() -> None:
    transport, inner, clock = make(NetworkProfile(name="slow", delay_ms=10.0))
    got: list[Event] = []
    transport.query("k", b"", 1.0, got.append, 1)
    inner.asked[0][1](Reply(1, "k", b"under way"))
    transport.close()
    transport.close()
    clock.run()
    assert got == [Reply(1, "k", None, CLOSED)]
    with pytest.raises(TransportError, match="closed"):
        transport.query("k", b"", 1.0, got.append, 2)


def test_many_threads_lose_nothing_and_keep_their_order() -> None:
    timer = TimerThread()
    inner = Bare()
    transport = ImpairedTransport(inner, PROFILES["lan"], np.random.default_rng(0), timer, receiver="module")
    got: list[Event] = []
    all_there = threading.Event()

    def sink(event: Event) -> None:
        got.append(event)
        if len(got) == 4 * 500:
            all_there.set()

    transport.subscribe("**", sink)

    def send(key: str) -> None:
        for number in range(500):
            inner.sinks["sample"](Sample(key, str(number).encode()))

    threads = [threading.Thread(target=send, args=(f"k/{i}",)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all_there.wait(10.0)
    timer.close()
    for i in range(4):
        assert [int(e.payload) for e in got if e.key == f"k/{i}"] == list(range(500))


def test_the_timer_calls_in_the_order_of_time_then_of_scheduling() -> None:
    timer = TimerThread()
    order: list[str] = []
    done = threading.Event()

    # Scheduled from the timer's own thread, so that nothing can fall due in between.
    def plan() -> None:
        timer.call_later(0.02, lambda: order.append("late"))
        timer.call_later(0.0, lambda: order.append("first"))
        timer.call_later(0.0, lambda: order.append("second"))
        timer.call_later(0.03, done.set)

    timer.call_later(0.0, plan)
    assert done.wait(10.0)
    assert order == ["first", "second", "late"]
    timer.close()
    timer.close()
    timer.call_later(0.0, lambda: order.append("after close"))
    assert order[-1] == "late"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_timer_that_died_of_an_exception_says_so() -> None:
    timer = TimerThread("doomed")

    def fail() -> None:
        raise ValueError("bad call")

    timer.call_later(0.0, fail)
    timer._thread.join(10.0)
    with pytest.raises(RuntimeError, match="doomed"):
        timer.call_later(0.0, fail)

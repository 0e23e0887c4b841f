"""Questions, answers, refusals and silence in virtual time; everything that passes is recorded."""

import asyncio
import time
from collections.abc import Callable, Coroutine, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from coordinator.live_robot.messenger import LANE_BYTES, Messenger, NoAnswer, Refused
from coordinator.recording.recording import MAX_MODULES, Entry, Recording
from module_agent.transport.inbox import EVENT_BYTES
from module_agent.transport.transport import Request, Sample, TransportError
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf, every, key
from module_agent.wire.messages import Ack, Identify, LeaseRequest, Message, Stop
from module_agent.wire.refusal import WireError
from sim.virtual_time.loop import VirtualLoop
from sim.virtual_time.network import VirtualEndpoint, VirtualNetwork


class Bench:
    """A messenger, and a module `A` that answers as the test sets."""

    def __init__(self, wire: SimpleNamespace):
        self.wire = wire
        self.loop = VirtualLoop()
        self.network = VirtualNetwork(self.loop)
        self.module: VirtualEndpoint = self.network.endpoint("module")
        self.entries: list[Entry] = []
        self.recording = Recording()
        self.messenger = Messenger(
            self.network.endpoint("coordinator"),
            wire.robot,
            lambda: self.loop.now_ns,
            self.loop.call_soon,
            self._record,
        )

    def _record(self, entry: Entry) -> Message | None:
        self.entries.append(entry)
        try:
            message = self.recording.add(entry)
        except WireError:
            return None
        return message if isinstance(message, Message) else None

    def serve(self, leaf: Leaf, answer: Callable[[Request], bytes | None]) -> None:
        def on_request(event: Any) -> None:
            payload = answer(event)
            if payload is not None:
                event.reply(payload)

        self.module.serve(key(self.wire.robot, "A", leaf), on_request)

    def run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self.loop.run_until_complete(work)

    def stop(self) -> Coroutine[Any, Any, Ack]:
        message = Stop(serial="A", boot=0, seq=self.messenger.next_seq(), sender="tester")
        return self.messenger.command("A", Leaf.STOP, message)


@pytest.fixture
def bench(wire: SimpleNamespace) -> Iterator[Bench]:
    made = Bench(wire)
    yield made
    made.loop.close()


def test_requests_and_replies_are_recorded(bench: Bench) -> None:
    wire = bench.wire
    bench.serve(Leaf.STATUS, lambda _: encode(wire.status(re=1, t_ns=9)))
    message = bench.run(bench.messenger.ask("A", Leaf.STATUS, wire.ask(seq=1)))
    assert message == wire.status(re=1, t_ns=9)
    assert [(e.kind, e.payload) for e in bench.entries] == [
        ("request", encode(wire.ask(seq=1))),
        ("reply", encode(message)),
    ]
    assert len(bench.recording.modules["A"].round_trips) == 1


def test_the_secret_of_a_lease_is_sent_and_not_recorded(bench: Bench) -> None:
    sent: list[bytes] = []

    def grant(request: Request) -> bytes:
        sent.append(request.payload)
        return encode(bench.wire.ack(re=3))

    bench.serve(Leaf.LEASE, grant)
    secret = bytes(range(100, 116))
    command = LeaseRequest(
        serial="A", boot=1, seq=3, sender="tester", action="acquire", token=0, echo_ns=0, secret=secret
    )
    bench.run(bench.messenger.command("A", Leaf.LEASE, command, secret=secret))
    assert decode(LeaseRequest, sent[0]) == command
    request, reply = bench.entries
    # What is recorded is read as ever, and its answer is a round trip.
    assert decode(LeaseRequest, request.payload) == command.model_copy(update={"secret": b""})
    assert not any(secret in entry.payload for entry in bench.entries)
    assert reply.kind == "reply"
    assert bench.recording.refused == {}
    assert len(bench.recording.modules["A"].round_trips) == 1


def test_replies_in_any_order_match_their_requests(bench: Bench) -> None:
    wire = bench.wire

    def later(event: Any) -> None:
        number = len(held)
        held.append(event)
        bench.loop.call_later(0.1 - 0.01 * number, lambda: event.reply(encode(wire.status(re=number))))

    held: list[Any] = []
    bench.module.serve(key(wire.robot, "A", Leaf.STATUS), later)

    async def work() -> list[Any]:
        asks = [bench.messenger.ask("A", Leaf.STATUS, wire.ask(seq=i)) for i in range(5)]
        return await asyncio.gather(*asks)

    assert [status.re for status in bench.run(work())] == [0, 1, 2, 3, 4]


def test_a_missing_answer_is_an_error_with_module_and_key(bench: Bench) -> None:
    bench.serve(Leaf.STATUS, lambda _: None)
    with pytest.raises(NoAnswer, match="module A did not answer on status: Timeout"):
        bench.run(bench.messenger.ask("A", Leaf.STATUS, bench.wire.ask(), timeout_s=0.25))
    assert bench.loop.time() == pytest.approx(0.25, abs=1e-6)


def test_a_module_that_is_not_there_is_not_waited_for(bench: Bench) -> None:
    with pytest.raises(NoAnswer, match="module B did not answer on info"):
        bench.run(bench.messenger.ask("B", Leaf.INFO, bench.wire.ask("B"), timeout_s=60.0))
    assert bench.loop.time() < 1.0


def test_an_answer_that_cannot_be_read_is_no_answer(bench: Bench) -> None:
    wire = bench.wire
    bench.serve(Leaf.STATUS, lambda _: b"noise")
    with pytest.raises(NoAnswer, match="its answer could not be read"):
        bench.run(bench.messenger.ask("A", Leaf.STATUS, wire.ask()))
    bench.serve(Leaf.INFO, lambda _: encode(wire.info("B")))
    with pytest.raises(NoAnswer, match="could not be read"):
        bench.run(bench.messenger.ask("A", Leaf.INFO, wire.ask()))
    assert bench.recording.refused == {"malformed": 1, "wrong_serial": 1}


def test_a_refusal_names_module_command_and_reason(bench: Bench) -> None:
    no = bench.wire.ack(accepted=False).model_copy(update={"reason": "held", "detail": "held by C"})
    bench.serve(Leaf.STOP, lambda _: encode(no))
    with pytest.raises(Refused, match="module A refused stop: held: held by C") as caught:
        bench.run(bench.stop())
    assert caught.value.ack == no
    assert caught.value.serial == "A"


def test_an_accepted_command_returns_its_acknowledgement(bench: Bench) -> None:
    bench.serve(Leaf.STOP, lambda _: encode(bench.wire.ack(re=1)))
    assert bench.run(bench.stop()) == bench.wire.ack(re=1)


@pytest.mark.parametrize(("number", "accepted"), [(7, True), (0, True), (7, False)])
def test_an_acknowledgement_of_another_command_is_no_answer(
    bench: Bench, number: int, accepted: bool
) -> None:
    """As of a command that was answered late; what is refused unread has no number."""
    bench.serve(Leaf.IDENTIFY, lambda _: encode(bench.wire.ack(re=number, accepted=accepted)))
    command = Identify(serial="A", boot=0, seq=1, sender="tester", on=True)
    with pytest.raises(NoAnswer, match=f"it answers command {number}, asked was 1"):
        bench.run(bench.messenger.command("A", Leaf.IDENTIFY, command))


def test_a_stop_that_is_answered_by_the_acknowledgement_of_another_command_is_sent_again(
    bench: Bench,
) -> None:
    asked: list[int] = []

    def answer(request: Request) -> bytes:
        asked.append(decode(Stop, request.payload).seq)
        return encode(bench.wire.ack(re=1))

    bench.messenger.next_seq()
    bench.serve(Leaf.STOP, answer)
    with pytest.raises(NoAnswer):
        bench.run(bench.messenger.stop("A", "tester", "for a test"))
    assert asked == [2, 3, 4]


def test_liveliness_tokens_give_the_modules_present(bench: Bench) -> None:
    bench.messenger.start()
    token = bench.module.declare_alive(key(bench.wire.robot, "A", Leaf.ALIVE))
    bench.module.declare_alive(key(bench.wire.robot, "B", Leaf.ALIVE))
    bench.module.declare_alive(key("other", "C", Leaf.ALIVE))
    bench.run(asyncio.sleep(0.01))
    assert sorted(bench.messenger.alive) == ["A", "B"]
    token.undeclare()
    bench.run(asyncio.sleep(0.01))
    assert sorted(bench.messenger.alive) == ["B"]
    bench.network.kill("module")
    bench.run(asyncio.sleep(0.01))
    assert bench.messenger.alive == set()


def test_liveliness_tokens_that_were_made_up_are_as_many_as_a_robot_may_have(bench: Bench) -> None:
    bench.messenger.start()
    bench.module.declare_alive(key(bench.wire.robot, "A", Leaf.ALIVE))
    for number in range(MAX_MODULES + 100):
        bench.module.declare_alive(key(bench.wire.robot, f"M{number}", Leaf.ALIVE))
    bench.run(asyncio.sleep(0.01))
    assert len(bench.messenger.alive) == MAX_MODULES
    assert "A" in bench.messenger.alive


def test_a_large_burst_is_received_completely_and_in_order(bench: Bench) -> None:
    wire = bench.wire
    bench.messenger.start()
    topic = key(wire.robot, "A", Leaf.STATUS)
    for number in range(10_000):
        bench.module.publish(topic, encode(wire.status(t_ns=number)))
    bench.run(asyncio.sleep(0.01))
    assert len(bench.entries) == 10_000
    assert [e.payload for e in bench.entries[::999]] == [
        encode(wire.status(t_ns=number)) for number in range(0, 10_000, 999)
    ]
    assert bench.messenger.dropped == 0


def test_events_beyond_the_inbox_capacity_are_counted(bench: Bench) -> None:
    wire, posted = bench.wire, []
    messenger = Messenger(bench.network.endpoint("slow"), wire.robot, lambda: 0, posted.append, bench._record)
    messenger.start()
    at, payload = key(wire.robot, "A", Leaf.STATUS), encode(wire.status())
    room = LANE_BYTES // (EVENT_BYTES + len(at) + len(payload))
    for _ in range(room + 7):
        bench.module.publish(at, payload)
    bench.run(asyncio.sleep(0.01))
    assert messenger.dropped == 7
    assert len(posted) == 1  # one call is under way however many events wait


def test_messages_are_recorded_with_the_time_of_their_delivery(wire: SimpleNamespace) -> None:
    bench, posted = Bench(wire), list[Callable[[], None]]()
    endpoint = bench.network.endpoint("slow")
    messenger = Messenger(endpoint, wire.robot, lambda: bench.loop.now_ns, posted.append, bench._record)
    messenger.start()
    bench.loop.run_until_complete(asyncio.sleep(0.005))
    bench.module.publish(key(wire.robot, "A", Leaf.STATUS), encode(wire.status()))
    # The event loop is busy for 0.2 s.
    bench.loop.run_until_complete(asyncio.sleep(0.2))
    posted[0]()
    assert [entry.t_ns for entry in bench.entries] == [5_000_000]
    bench.loop.close()


@pytest.fixture
def coalescing(bench: Bench) -> tuple[Bench, Messenger, list[tuple[int, Entry]]]:
    """A messenger that lets publications wait for 2 ms, and the time at which each entry was recorded."""
    recorded = list[tuple[int, Entry]]()

    def record(entry: Entry) -> Message | None:
        recorded.append((bench.loop.now_ns, entry))
        return bench._record(entry)

    endpoint, clock, post = bench.network.endpoint("patient"), lambda: bench.loop.now_ns, bench.loop.call_soon
    messenger = Messenger(endpoint, bench.wire.robot, clock, post, record, coalesced_s=2e-3)
    messenger.start()
    return bench, messenger, recorded


def _publish_every_us(bench: Bench, period_us: float, count: int) -> None:
    topic = key(bench.wire.robot, "A", Leaf.STATUS)
    for number in range(count):
        payload = encode(bench.wire.status(t_ns=number))
        bench.loop.call_later(1e-6 * period_us * number, bench.module.publish, topic, payload)


def test_of_publications_that_keep_coming_only_the_first_wakes_the_event_loop(
    coalescing: tuple[Bench, Messenger, list[tuple[int, Entry]]],
) -> None:
    bench, _, recorded = coalescing
    _publish_every_us(bench, 300, 100)
    bench.run(asyncio.sleep(0.1))
    assert [entry.t_ns for _, entry in recorded] == [300_000 * n for n in range(100)]
    waited_ns = [at_ns - entry.t_ns for at_ns, entry in recorded]
    assert waited_ns[0] == 0
    assert max(waited_ns) <= 2_000_000
    assert len({at_ns for at_ns, _ in recorded}) == 16  # 30 ms by 2 ms, and the first


def test_a_publication_after_a_pause_wakes_the_event_loop(
    coalescing: tuple[Bench, Messenger, list[tuple[int, Entry]]],
) -> None:
    bench, _, recorded = coalescing
    _publish_every_us(bench, 5000, 4)
    bench.run(asyncio.sleep(0.1))
    assert [at_ns for at_ns, _ in recorded] == [0, 5_000_000, 10_000_000, 15_000_000]


def test_an_answer_does_not_wait_with_publications(
    coalescing: tuple[Bench, Messenger, list[tuple[int, Entry]]],
) -> None:
    bench, messenger, recorded = coalescing
    wire, answered_ns = bench.wire, list[int]()
    bench.serve(Leaf.STATUS, lambda request: encode(wire.status()))
    _publish_every_us(bench, 300, 30)

    async def ask() -> None:
        await asyncio.sleep(3.4e-3)
        await messenger.ask("A", Leaf.STATUS, wire.ask("A"))
        answered_ns.append(bench.loop.now_ns)
        await asyncio.sleep(0.1)

    bench.run(ask())
    assert answered_ns == [3_400_000]
    # Nothing overtakes what came before it.
    assert [entry.t_ns for _, entry in recorded if entry.kind != "request"] == sorted(
        entry.t_ns for _, entry in recorded if entry.kind != "request"
    )
    assert len(recorded) == 32


def test_what_cannot_be_recorded_does_not_hold_up_the_publications_behind_it(bench: Bench) -> None:
    recorded_ns = list[int]()

    def record(entry: Entry) -> Message | None:
        if entry.t_ns == 600_000:
            raise _Unrecordable(entry.topic)
        recorded_ns.append(bench.loop.now_ns)
        return bench._record(entry)

    endpoint, clock = bench.network.endpoint("patient"), lambda: bench.loop.now_ns
    post = bench.loop.call_soon
    messenger = Messenger(endpoint, bench.wire.robot, clock, post, record, coalesced_s=2e-3)
    messenger.start()
    _publish_every_us(bench, 300, 7)
    with pytest.raises(_Unrecordable):
        bench.run(asyncio.sleep(0.1))
    bench.run(asyncio.sleep(0.1))
    assert [entry.t_ns for entry in bench.entries] == [300_000 * n for n in range(7) if n != 2]
    # The first woke the loop; all others were seen when it looked.
    assert recorded_ns == [0, *[2_000_000] * 5]


def test_what_one_drain_leaves_does_not_wait_for_the_next_look(
    coalescing: tuple[Bench, Messenger, list[tuple[int, Entry]]],
) -> None:
    bench, messenger, recorded = coalescing
    wire, answered_ns = bench.wire, list[int]()
    bench.serve(Leaf.STATUS, lambda request: encode(wire.status()))

    async def ask() -> None:
        # The loop looks already, and 500 messages on 100 keys come at once, before an answer.
        bench.module.publish(key(wire.robot, "A", Leaf.STATUS), encode(wire.status()))
        await asyncio.sleep(1e-3)
        for number in range(500):
            serial = f"M{number % 100}"
            bench.module.publish(key(wire.robot, serial, Leaf.STATUS), encode(wire.status(serial)))
        await messenger.ask("A", Leaf.STATUS, wire.ask("A"))
        answered_ns.append(bench.loop.now_ns)
        await asyncio.sleep(0.1)

    bench.run(ask())
    assert answered_ns == [1_000_000]
    assert {at_ns for at_ns, entry in recorded if entry.kind == "publication"} == {0, 1_000_000}
    assert len(recorded) == 503


def test_that_a_module_leaves_does_not_wait_with_publications(
    coalescing: tuple[Bench, Messenger, list[tuple[int, Entry]]],
) -> None:
    bench, messenger, _ = coalescing
    token = bench.module.declare_alive(key(bench.wire.robot, "A", Leaf.ALIVE))
    bench.run(asyncio.sleep(0.01))
    _publish_every_us(bench, 300, 30)

    async def leave() -> None:
        await asyncio.sleep(3.4e-3)
        assert messenger.alive == {"A"}
        token.undeclare()
        await asyncio.sleep(0.0)
        await asyncio.sleep(1e-6)
        assert not messenger.alive

    bench.run(leave())


class _Unrecordable(Exception):
    """What the recording raises: a defect of ours."""


def test_a_stop_goes_out_though_it_cannot_be_recorded(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bytes] = []
    bench.serve(Leaf.STOP, lambda request: asked.append(request.payload))

    def record(entry: Entry) -> Message | None:
        raise _Unrecordable(entry.topic)

    monkeypatch.setattr(bench.messenger, "_record", record)
    with pytest.raises(_Unrecordable):
        bench.run(bench.messenger.stop("A", "tester", "for a test"))
    bench.run(asyncio.sleep(0.01))
    assert [decode(Stop, payload).why for payload in asked] == ["for a test"]


def test_what_cannot_be_recorded_does_not_leave_what_came_with_it_unread(wire: SimpleNamespace) -> None:
    bench, posted = Bench(wire), list[Callable[[], None]]()

    def record(entry: Entry) -> Message | None:
        if entry.topic == key(wire.robot, "M3", Leaf.STATUS):
            raise _Unrecordable(entry.topic)
        return bench._record(entry)

    endpoint = bench.network.endpoint("listener")
    messenger = Messenger(endpoint, wire.robot, lambda: bench.loop.now_ns, posted.append, record)
    messenger.start()
    for number in range(20):
        bench.module.publish(key(wire.robot, f"M{number}", Leaf.STATUS), encode(wire.status(f"M{number}")))
    bench.run(asyncio.sleep(0.01))
    with pytest.raises(_Unrecordable):
        posted.pop(0)()
    # No later message has to come for the rest to be read.
    while posted:
        posted.pop(0)()
    assert sorted(bench.recording.modules) == sorted(f"M{number}" for number in range(20) if number != 3)
    bench.loop.close()


class _OfSinks:
    """A transport of which only the sinks are there, for threads to call."""

    def __init__(self) -> None:
        self.sinks: dict[str, Any] = {}

    def subscribe(self, at: str, sink: Any) -> Any:
        self.sinks[at] = sink
        return SimpleNamespace(undeclare=lambda: None)

    watch_alive = subscribe

    def close(self) -> None:
        pass


def test_no_publication_is_left_behind_whenever_a_thread_publishes_it(wire: SimpleNamespace) -> None:
    """With a real loop and a real thread: pairs, the second about when the loop looks for the last time."""
    transport, numbers, pairs = _OfSinks(), set[int](), 300
    pauses_s = np.random.default_rng(1).uniform(1e-3, 4e-3, pairs).tolist()

    def record(entry: Entry) -> Message | None:
        numbers.add(int(entry.payload))
        return None

    def publish(pair: int) -> None:
        topic = key(wire.robot, "A", Leaf.STATUS)
        for number in (2 * pair, 2 * pair + 1):
            transport.sinks[every(wire.robot, Leaf.STATUS)](Sample(topic, b"%d" % number))
            time.sleep(pauses_s[pair])

    async def listen() -> None:
        post = asyncio.get_running_loop().call_soon_threadsafe
        messenger = Messenger(transport, wire.robot, lambda: 0, post, record, coalesced_s=2e-3)
        messenger.start()
        for pair in range(pairs):
            await asyncio.to_thread(publish, pair)
            # Nothing comes now that would wake the loop for what was left.
            async with asyncio.timeout(10.0):
                while 2 * pair + 1 not in numbers:
                    await asyncio.sleep(1e-3)
        messenger.close()

    asyncio.run(listen())
    assert numbers == set(range(2 * pairs))


def test_sequence_numbers_increase(bench: Bench) -> None:
    numbers = [bench.messenger.next_seq() for _ in range(5)]
    assert numbers == sorted(set(numbers))


def test_a_closed_messenger_neither_receives_nor_sends_requests(bench: Bench) -> None:
    bench.messenger.start()
    bench.messenger.close()
    bench.module.publish(key(bench.wire.robot, "A", Leaf.STATUS), encode(bench.wire.status()))
    bench.run(asyncio.sleep(0.01))
    assert bench.entries == []
    with pytest.raises(TransportError):
        bench.run(bench.messenger.ask("A", Leaf.STATUS, bench.wire.ask()))
    bench.messenger.close()


def test_closing_ends_pending_requests(bench: Bench) -> None:
    bench.serve(Leaf.STATUS, lambda _: None)

    async def work() -> None:
        question = asyncio.create_task(
            bench.messenger.ask("A", Leaf.STATUS, bench.wire.ask(), timeout_s=60.0)
        )
        await asyncio.sleep(0.01)
        bench.messenger.close()
        with pytest.raises(NoAnswer):
            await question

    bench.run(work())
    assert bench.loop.time() < 1.0

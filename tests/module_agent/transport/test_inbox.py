"""A bounded queue that keeps the oldest of every key, and counts what it had to turn away."""

import threading

from hypothesis import given
from hypothesis import strategies as st

from module_agent.transport.inbox import EVENT_BYTES, LANE_BYTES, Inbox
from module_agent.transport.transport import Event, Reply, Sample

# A key of one letter and a payload of ten bytes.
SIZE = EVENT_BYTES + 11


def _event(number: int, key: str = "k") -> Event:
    return Sample(key, b"%010d" % number)


@given(
    capacity=st.integers(1, 8),
    steps=st.lists(st.one_of(st.sampled_from("ab"), st.integers(1, 10)), max_size=60),
)
def test_of_every_key_the_oldest_come_out_once_in_order_and_the_rest_is_counted(
    capacity: int, steps: list[str | int]
) -> None:
    inbox = Inbox(100, lane_bytes=capacity * SIZE)
    waiting: dict[str, list[Event]] = {"a": [], "b": []}
    offered, taken, dropped = 0, 0, 0
    for step in steps:
        if isinstance(step, int):
            got = inbox.drain(limit=step)
            assert got == sorted(got, key=lambda event: event.payload)
            lanes, there = sum(map(bool, waiting.values())), sum(map(len, waiting.values()))
            assert min(step, lanes) <= len(got) <= step
            for key, events in waiting.items():
                own = [event for event in got if event.key == key]
                # All keys have the same share, unless all events or less than one of each may be taken.
                assert own == events[: len(own)]
                share = len(events) if there <= step else step // max(1, lanes)
                assert step < lanes or len(own) == min(len(events), share)
                del events[: len(own)]
            taken += len(got)
        else:
            offered += 1
            inbox.put(_event(offered, step))
            if len(waiting[step]) < capacity:
                waiting[step].append(_event(offered, step))
            else:
                dropped += 1
        assert inbox.waiting == any(waiting.values())
        assert inbox.dropped == dropped
    assert offered == taken + dropped + len(inbox)


def test_few_events_are_taken_all_at_once_however_they_are_shared_among_keys() -> None:
    inbox = Inbox(100)
    for number, name in enumerate("aaab"):
        inbox.put(_event(number, name), stamp=number)
    assert [stamp for stamp, _ in inbox.drain_stamped(limit=4)] == [0, 1, 2, 3]
    assert (len(inbox), inbox.lanes, inbox.waiting) == (0, 0, False)


def test_threads_that_put_at_once_lose_nothing_uncounted() -> None:
    inbox = Inbox(100, lane_bytes=1 << 20)
    threads = [threading.Thread(target=lambda: [inbox.put(_event(i)) for i in range(1000)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(inbox.drain(limit=10_000)) + inbox.dropped == 4000
    assert inbox.dropped == 0


def test_a_flood_on_one_key_pushes_out_nothing_of_another_even_when_all_is_full() -> None:
    inbox = Inbox(100, lane_bytes=90 * SIZE, total_bytes=100 * SIZE + 3 * LANE_BYTES)
    for number in range(1000):
        inbox.put(_event(number, "fg"[number % 2]))
    for number in range(20):
        inbox.put(_event(number, "q"))
    kept = inbox.drain(limit=10_000)
    assert len(kept) == 100
    assert sum(event.key == "q" for event in kept) == 20


def test_many_and_long_keys_are_counted_and_have_their_turns() -> None:
    inbox = Inbox(100, total_bytes=100 * (LANE_BYTES + EVENT_BYTES + 1000))
    for number in range(300):
        inbox.put(Sample(f"{number:03}" + "x" * 997, b""))
    assert len(inbox) == inbox.lanes == 100
    assert inbox.dropped == 200
    turns = [inbox.drain(limit=40) for _ in range(3)]
    assert list(map(len, turns)) == [40, 40, 20]
    # A key of many events does not keep the others waiting.
    inbox = Inbox(100)
    for number in range(50):
        inbox.put(_event(number, "a"))
    for key in "bc":
        inbox.put(_event(0, key))
    assert {event.key for event in [*inbox.drain(limit=2), *inbox.drain(limit=2)]} == {"a", "b", "c"}


def test_what_is_refused_leaves_no_lane_and_what_is_taken_takes_its_lane_along() -> None:
    inbox = Inbox(100, lane_bytes=SIZE, total_bytes=4 * (SIZE + LANE_BYTES))
    for _ in range(3):
        for number in range(5000):
            inbox.put(Sample(f"{number:04}", b"1234567"))
        assert len(inbox) == inbox.lanes == 4
        assert len(inbox.drain(limit=100)) == 4
        assert inbox.lanes == 0
    assert inbox.dropped == 3 * 4996


def test_a_new_key_has_room_where_one_event_of_another_gives_way_with_its_lane() -> None:
    inbox = Inbox(10_000, total_bytes=2 * (LANE_BYTES + EVENT_BYTES + 1001))
    for name in "ab":
        inbox.put(Sample(name, bytes(1000)))
    inbox.put(_event(1, "c"))
    assert inbox.lanes == 2
    assert {event.key for event in inbox.drain()} < {"a", "b", "c"}
    assert inbox.dropped == 1


def test_an_inbox_that_has_refused_lets_in_again_what_fits() -> None:
    inbox = Inbox(10_000, total_bytes=LANE_BYTES + 10 * SIZE)
    for _ in range(3):
        for number in range(20):
            inbox.put(_event(number))
        inbox.put(_event(0, "q"))
        kept = inbox.drain(limit=100)
        # For the lane of the second key events of the first give way.
        assert sum(event.key == "q" for event in kept) == 1
        assert len(kept) == 1 + 10 - -(-(LANE_BYTES + SIZE) // SIZE)


def test_an_answer_is_kept_however_full_it_is() -> None:
    inbox = Inbox(100, lane_bytes=SIZE, total_bytes=2 * SIZE)
    inbox.put(_event(1))
    for tag in range(10):
        inbox.put(Reply(tag, "k", b"answer"))
    assert sum(isinstance(event, Reply) for event in inbox.drain(limit=100)) == 10


def test_a_payload_longer_than_any_message_takes_no_more_room_than_one() -> None:
    inbox = Inbox(100)
    inbox.put(Sample("k", bytes(1 << 20)), stamp=7)
    ((stamp, event),) = inbox.drain_stamped(1)
    assert (stamp, event) == (7, Sample("k", bytes(101)))

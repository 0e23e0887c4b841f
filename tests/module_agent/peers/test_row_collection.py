"""The rows of motions that an agent keeps: fetched until all are there, each motion once, a boot apart."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from module_agent.firmware.feedback import History
from module_agent.peers.motion_listener import ANSWER_TIMEOUT_NS, MAX_MODULES, AskHistory
from module_agent.peers.row_collection import GIVE_UP_NS, MAX_MOTIONS, MAX_ROWS, MotionCollection, OwnRows
from module_agent.wire.information_messages import CollectRequest, RowRange
from module_agent.wire.messages import MAX_ROWS_PER_MOTION, Feedback
from module_agent.wire.refusal import Refusal, WireError

OWN, OTHER = "J1", "J2"


def history(rows: int, slope: float = 0.001) -> History:
    found = History(1000)
    for number in range(rows):
        found.append((4_000_000 * number, 4_000_000 * number, 0, 0, slope * number, *[0.5] * 17))
    return found


def kept(boot: int = 7, **of: History) -> dict[str, OwnRows]:
    return {serial: OwnRows(boot, rows) for serial, rows in of.items()}


def request(
    motion_id: int = 1, first: int = 10, end: int = 600, boot: int = 7, sender: str = "c"
) -> CollectRequest:
    rows = tuple(RowRange(serial=s, boot=boot, first_row=first, end_row=end) for s in (OWN, OTHER))
    return CollectRequest(serial=OWN, boot=boot, seq=1, sender=sender, motion_id=motion_id, rows=rows)


def served(wish: AskHistory, of: History, boot: int = 7) -> Feedback:
    block = of.rows(wish.first_row, wish.end_row).tobytes()
    count = wish.end_row - wish.first_row
    return Feedback(serial=wish.serial, boot=boot, seq=1, first_row=wish.first_row, count=count, rows=block)


def refused(collection: MotionCollection, motion_id: int = 1) -> Refusal:
    with pytest.raises(WireError) as caught:
        collection.tracks(motion_id)
    return caught.value.reason


def test_own_rows_are_copied_and_others_are_asked_for_until_they_have_come() -> None:
    collection, other = MotionCollection(), history(700, 0.002)
    collection.collect(request(), kept(J1=history(700)), 0)
    asked = 0
    assert refused(collection) is Refusal.BUSY
    while collection.has_work:
        for wish in collection.poll(0):
            asked += 1
            assert wish.serial == OTHER
            collection.on_feedback(served(wish, other))
    # 590 rows, 256 to a question.
    assert asked == 3
    tracks = collection.tracks(1)
    assert np.allclose(tracks[OTHER].position_rad, 0.002 * np.arange(10, 600))
    assert np.allclose(tracks[OWN].position_rad, 0.001 * np.arange(10, 600))
    assert list(tracks[OWN].t_ns[:2]) == [40_000_000, 44_000_000]


def test_a_question_that_is_lost_is_asked_again_and_not_before_its_time() -> None:
    collection = MotionCollection()
    collection.collect(request(), kept(J1=history(700)), 0)
    (first,) = collection.poll(0)
    assert collection.poll(ANSWER_TIMEOUT_NS - 1) == []
    assert collection.poll(ANSWER_TIMEOUT_NS) == [first]


def test_the_same_motion_again_is_kept_once_and_fetched_once() -> None:
    collection = MotionCollection()
    own = kept(J1=history(700), J2=history(700))
    collection.collect(request(), own, 0)
    before = collection.tracks(1)
    collection.collect(request(), {}, 0)
    assert collection.tracks(1) == before
    assert collection.poll(0) == []


def test_what_is_kept_stays_when_another_coordinator_goes_on_and_the_histories_have_forgotten() -> None:
    """A session that is resumed asks again for the motions of before, by clocks that it maps anew."""
    collection = MotionCollection()
    collection.collect(request(), kept(J1=history(700), J2=history(700)), 0)
    before = collection.tracks(1)
    later = History(1000)
    for number in range(2500):
        later.append((4_000_000 * number, 4_000_000 * number, 0, 0, 0.0, *[0.5] * 17))
    collection.collect(request(first=12, end=603, sender="another"), kept(J1=later, J2=later), 0)
    assert collection.tracks(1) == before


def test_rows_of_a_module_that_has_booted_anew_take_the_place_of_the_former_ones() -> None:
    collection = MotionCollection()
    own = kept(J1=history(700), J2=history(700))
    collection.collect(request(), own, 0)
    later = kept(8, J1=history(700), J2=history(700))
    collection.collect(request(first=100, end=200, boot=8), later, 0)
    assert len(collection.tracks(1)[OWN].t_ns) == 100


def test_rows_of_another_boot_do_not_count() -> None:
    collection = MotionCollection()
    collection.collect(request(first=10, end=20), kept(J1=history(700)), 0)
    (wish,) = collection.poll(0)
    collection.on_feedback(served(wish, history(700), boot=8))
    assert refused(collection) is Refusal.BUSY
    collection.on_feedback(served(wish, history(700)))
    assert len(collection.tracks(1)[OTHER].t_ns) == 10


@pytest.mark.parametrize("end", ["refused", "silent"])
def test_rows_that_never_come_are_reported_as_lost(end: str) -> None:
    collection = MotionCollection()
    collection.collect(request(), kept(J1=history(700)), 0)
    (asked,) = collection.poll(0)
    if end == "refused":
        collection.on_lost(asked)
    else:
        collection.poll(GIVE_UP_NS)
    assert refused(collection) is Refusal.GONE
    assert collection.poll(GIVE_UP_NS) == []
    assert not collection.has_work


def test_a_motion_of_another_number_is_not_known() -> None:
    collection = MotionCollection()
    collection.collect(request(), kept(J1=history(700), J2=history(700)), 0)
    assert refused(collection, 2) is Refusal.GONE


def test_own_rows_that_are_lost_or_of_another_boot_are_refused_and_leave_nothing_behind() -> None:
    collection = MotionCollection()
    own = kept(J2=history(700), J1=history(700))
    for wrong, reason in ((request(end=701), Refusal.GONE), (request(boot=6), Refusal.WRONG_BOOT)):
        with pytest.raises(WireError) as caught:
            collection.collect(wrong, own, 0)
        assert caught.value.reason is reason
        assert not collection.has_work
        with pytest.raises(WireError, match="motion 1 was not collected here"):
            collection.tracks(1)


def test_what_was_kept_of_a_motion_outlives_a_demand_for_it_that_is_refused() -> None:
    collection = MotionCollection()
    collection.collect(request(), kept(J1=history(700), J2=history(700)), 0)
    before = collection.tracks(1)
    with pytest.raises(WireError):
        collection.collect(request(boot=8), kept(J1=history(700), J2=history(700)), 0)
    assert collection.tracks(1) == before


@pytest.mark.parametrize("length", [0, -1, MAX_ROWS_PER_MOTION + 1])
def test_there_is_no_range_of_no_rows_or_of_more_than_are_kept(length: int) -> None:
    with pytest.raises(ValidationError, match="1 to 100000 rows"):
        RowRange(serial=OWN, boot=7, first_row=10, end_row=10 + length)
    assert RowRange(serial=OWN, boot=7, first_row=10, end_row=10 + MAX_ROWS_PER_MOTION).first_row == 10


def test_a_motion_of_more_modules_than_there_can_be_is_refused_and_leaves_what_is_kept() -> None:
    collection = MotionCollection()
    collection.collect(request(), kept(J1=history(700)), 0)

    def more(first: int, count: int, end: int) -> CollectRequest:
        rows = tuple(
            RowRange(serial=f"M{first + k}", boot=7, first_row=10, end_row=end) for k in range(count)
        )
        return request().model_copy(update={"rows": rows})

    with pytest.raises(WireError, match=r"motion 1 would have \d+ rows of 43 modules"):
        collection.collect(more(0, MAX_ROWS // MAX_ROWS_PER_MOTION + 1, MAX_ROWS_PER_MOTION), {}, 0)
    for first in range(0, MAX_MODULES - 4, 4):
        collection.collect(more(first, 4, 20), {}, 0)
    for too_many in (more(1000, 4, 20), more(1000, 30, 20)):
        with pytest.raises(WireError, match=r"motion 1 would have \d+ rows of \d+ modules") as caught:
            collection.collect(too_many, {}, 0)
        assert caught.value.reason is Refusal.LIMIT
    assert refused(collection) is Refusal.BUSY
    assert set(collection._motions[1]) == {OWN, OTHER} | {f"M{k}" for k in range(MAX_MODULES - 4)}


def test_a_refusal_of_one_range_leaves_the_other_motions_of_the_module_open() -> None:
    collection = MotionCollection()
    for number, first in ((1, 10), (2, 300)):
        collection.collect(request(number, first, first + 200), kept(J1=history(700)), 0)
    one, other = collection.poll(0)
    collection.on_lost(one)
    assert (refused(collection, 1), refused(collection, 2)) == (Refusal.GONE, Refusal.BUSY)
    collection.on_feedback(served(other, history(700)))
    assert len(collection.tracks(2)[OTHER].t_ns) == 200


def test_motions_are_not_more_than_are_kept_however_short_they_are() -> None:
    collection = MotionCollection()
    own = kept(J1=history(700), J2=history(700))
    for number in range(MAX_MOTIONS + 1):
        collection.collect(request(number, 10, 11), own, 0)
    assert refused(collection, 0) is Refusal.GONE
    assert len(collection.tracks(1)[OWN].t_ns) == 1


def test_the_oldest_motions_make_room(monkeypatch: Any) -> None:
    monkeypatch.setattr("module_agent.peers.row_collection.MAX_ROWS", 3000)
    collection = MotionCollection()
    own = kept(J1=history(700), J2=history(700))
    for number in range(4):
        collection.collect(request(number), own, 0)
    assert refused(collection, 0) is Refusal.GONE
    assert refused(collection, 1) is Refusal.GONE
    assert set(collection.tracks(3)) == {OWN, OTHER}

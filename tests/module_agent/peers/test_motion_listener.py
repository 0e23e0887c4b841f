"""A motion is handed over once and complete, in any order of its messages and with any of them lost."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.peers.motion_listener import (
    ANSWER_TIMEOUT_NS,
    FORGET_NS,
    GIVE_UP_NS,
    MAX_BOOTS,
    MAX_MODULES,
    ROWS_PER_QUESTION,
    Action,
    AskHistory,
    JointMotion,
    Listen,
    MotionListener,
)
from module_agent.wire.feedback_rows import ROW
from module_agent.wire.messages import (
    MAX_BATCH_ROWS,
    MAX_ROWS_PER_MOTION,
    ConstantMotion,
    Feedback,
    GoTo,
    MotionRecord,
    Pattern,
    Status,
)
from module_agent.wire.refusal import WireError

MS = 1_000_000
BATCH = 5
CONSTANT = ConstantMotion(velocity_rad_s=1.0, duration_s=0.75)
OWN = {"ME": 0}


def _status(
    motion: MotionRecord | None, seq: int = 1, t_ns: int = 0, boot: int = 1, serial: str = "J"
) -> Status:
    return Status(
        serial=serial,
        boot=boot,
        seq=seq,
        t_ns=t_ns,
        state="moving",
        holder="C",
        lease_left_ns=0,
        token=1,
        next_row=0,
        motion=motion,
        refusals={},
        expiries=0,
        dropped_events=0,
    )


def _record(
    motion_id: int = 1,
    start: int = 100,
    end: int | None = 400,
    outcome: str = "done",
    pattern: Pattern = CONSTANT,
) -> MotionRecord:
    return MotionRecord.model_validate(
        {
            "motion_id": motion_id,
            "pattern": pattern,
            "outcome": outcome,
            "start_ns": start * 4 * MS,
            "start_row": start,
            "end_row": end,
            "origin_rad": 0.0,
        }
    )


def _running(motion_id: int = 1, start: int = 100) -> MotionRecord:
    return _record(motion_id, start, None, "running")


def _feedback(first: int, count: int = BATCH, boot: int = 1, serial: str = "J") -> Feedback:
    rows = np.zeros(count, dtype=ROW)
    rows["t_ns"] = np.arange(first, first + count) * 4 * MS
    rows["position_rad"] = np.arange(first, first + count)
    return Feedback(serial=serial, boot=boot, seq=first, first_row=first, count=count, rows=rows.tobytes())


class Checked(MotionListener):
    """A listener that returns nothing unless it has work."""

    def poll(self, now_ns: int) -> tuple[list[Action], list[JointMotion]]:
        has_work = self.has_work
        said = super().poll(now_ns)
        assert has_work or said == ([], [])
        return said


def _questions(actions: list[Action]) -> list[AskHistory]:
    return [w for w in actions if isinstance(w, AskHistory)]


def _whole(motion: JointMotion, record: MotionRecord) -> bool:
    numbers = np.arange(record.start_row, record.end_row or 0)
    return motion.record == record and bool(np.array_equal(motion.rows["position_rad"], numbers))


# ---------------------------------------------------------------------- one motion, step by step


def test_a_joint_that_moves_is_listened_to_until_its_motion_is_complete() -> None:
    listener = Checked()
    listener.on_status(_status(_running()), 0, OWN)
    assert listener.poll(0) == ([Listen("J", True)], [])
    for first in range(100, 400, BATCH):
        listener.on_feedback(_feedback(first), OWN)
        assert listener.poll(0) == ([], [])
    listener.on_status(_status(_record(), 2), 0, OWN)
    actions, motions = listener.poll(0)
    assert actions == [Listen("J", False)]
    assert [_whole(m, _record()) for m in motions] == [True]
    assert listener.poll(MS) == ([], [])


def test_rows_that_were_dropped_are_asked_for_in_pieces_that_a_message_can_carry() -> None:
    listener = Checked()
    record = _record(end=100 + 600)
    listener.on_status(_status(record), 0, OWN)
    now, asked = 0, []
    for _ in range(3):
        (question,) = _questions(listener.poll(now)[0])
        asked.append(question.end_row - question.first_row)
        listener.on_feedback(_feedback(question.first_row, asked[-1]), OWN, live=False)
    _, motions = listener.poll(now)
    assert asked == [ROWS_PER_QUESTION, ROWS_PER_QUESTION, 600 - 2 * ROWS_PER_QUESTION]
    assert [_whole(m, record) for m in motions] == [True]


def test_a_listener_has_work_after_a_message_and_while_rows_are_missing() -> None:
    listener = Checked()
    assert not listener.has_work
    listener.on_status(_status(_running()), 0, OWN)
    assert listener.has_work
    listener.poll(0)
    assert not listener.has_work
    listener.on_feedback(_feedback(100), OWN)
    assert listener.has_work
    listener.on_status(_status(_record(), 2), 0, OWN)
    listener.poll(0)
    assert listener.has_work


def test_an_unanswered_question_is_asked_again_but_not_at_every_tick() -> None:
    listener = Checked()
    listener.on_status(_status(_record()), 0, OWN)
    questions = [q for now in range(0, 1000 * MS, MS) for q in _questions(listener.poll(now)[0])]
    assert len(questions) == 1000 * MS // ANSWER_TIMEOUT_NS + 1
    assert len(set(questions)) == 1


def test_rows_that_never_come_are_given_up_although_the_status_still_names_the_motion() -> None:
    listener = Checked()
    last_question = 0
    for number, now in enumerate(range(0, 4 * GIVE_UP_NS, 100 * MS)):
        listener.on_status(_status(_record(), 1 + number), now, OWN)
        actions, motions = listener.poll(now)
        assert motions == []
        if _questions(actions):
            last_question = now
    assert last_question <= GIVE_UP_NS


def test_a_long_motion_is_not_given_up_while_it_runs() -> None:
    listener = Checked()
    for number, now in enumerate(range(0, 3 * GIVE_UP_NS, 400 * MS)):
        listener.on_status(_status(_running(), 1 + number), now, OWN)
        listener.poll(now)
    listener.on_status(_status(_record(), 1000), now, OWN)
    assert _questions(listener.poll(now)[0])


def test_a_motion_that_was_stopped_is_dropped() -> None:
    for outcome in ("stopped", "expired", "superseded"):
        listener = Checked()
        listener.on_status(_status(_running()), 0, OWN)
        listener.on_status(_status(_record(outcome=outcome), 2), 0, OWN)
        assert listener.poll(0) == ([Listen("J", True), Listen("J", False)], [])
        # One of which nothing but the end was heard is not even listened to.
        listener.on_status(_status(_record(2, outcome=outcome), 3), 0, OWN)
        assert listener.poll(0) == ([], [])


def test_motions_between_poses_are_no_exploration() -> None:
    listener = Checked()
    journey = GoTo(target_rad=1.0, max_speed_rad_s=1.0)
    listener.on_status(_status(_record(pattern=journey)), 0, OWN)
    listener.on_status(_status(None, 2), 0, OWN)
    assert listener.poll(0) == ([], [])


def test_a_joint_that_boots_anew_in_mid_motion_does_not_mix_its_rows() -> None:
    listener = Checked()
    listener.on_status(_status(_running(), 50), 0, OWN)
    listener.on_feedback(_feedback(100, 250), OWN)
    listener.on_status(_status(_record(start=0, end=100), 1, boot=2), 0, OWN)
    listener.on_feedback(_feedback(0, 50, boot=1), OWN)
    assert listener.poll(0)[1] == []
    # A straggler of the old boot changes nothing.
    listener.on_status(_status(_record(), 51), 0, OWN)
    listener.on_feedback(_feedback(0, 100, boot=2), OWN)
    motions = listener.poll(0)[1]
    assert [(m.boot, len(m.rows)) for m in motions] == [(2, 100)]


def test_joints_that_move_at_once_are_kept_apart() -> None:
    listener = Checked()
    for serial in ("J", "K"):
        listener.on_status(_status(_record(), serial=serial), 0, OWN)
        listener.on_feedback(_feedback(100, 300, serial=serial), OWN)
    assert [m.serial for m in listener.poll(0)[1]] == ["J", "K"]


def test_the_clock_is_mapped_by_the_message_with_the_least_delay() -> None:
    listener = Checked()
    listener.on_status(_status(_record(), t_ns=0), 0, {"ME": 10_000 * MS, "YOU": 20 * MS})
    for first, delay in ((100, 9), (200, 2), (300, 30)):
        sent = (first + 99) * 4 * MS
        own = {"ME": sent + 10_000 * MS + delay * MS, "YOU": sent + delay * MS}
        listener.on_feedback(_feedback(first, 100), own)
    (motion,) = listener.poll(0)[1]
    # The status came without delay for ME, with 20 ms for YOU.
    assert motion.rough_offset_ns == {"ME": 10_000 * MS, "YOU": 2 * MS}


def test_rows_from_history_do_not_map_the_clock() -> None:
    listener = Checked()
    listener.on_status(_status(_record(), t_ns=0), 0, {"ME": 50 * MS})
    listener.on_feedback(_feedback(100, 300), {"ME": 0}, live=False)
    (motion,) = listener.poll(0)[1]
    assert motion.rough_offset_ns == {"ME": 50 * MS}


# ---------------------------------------------------------------------- any network


class _Net:
    """A network that delays, loses and repeats whatever it is given."""

    def __init__(self, rng: np.random.Generator, loss: float):
        self.rng = rng
        self.loss = loss
        self.queue: list[tuple[int, int, Any]] = []
        self.count = 0

    def send(self, now: int, message: Any) -> None:
        for _ in range(1 + int(self.rng.random() < 0.1)):
            self.count += 1
            if self.rng.random() >= self.loss:
                delay = int(self.rng.choice([0, 1, 5, 40, 900, 2500]))
                self.queue.append((now + delay * MS, self.count, message))

    def arrived(self, now: int) -> list[Any]:
        due = sorted(x for x in self.queue if x[0] <= now)
        self.queue = [x for x in self.queue if x[0] > now]
        return [message for _, _, message in due]


def _news(now: int, seq: int) -> Status | None:
    """What the joint says of itself: two constant motions of 1 s, each with a second of quiet after it."""
    row = now // (4 * MS)
    for motion_id, start in ((11, 100), (12, 1100)):
        if start <= row < start + 250:
            return _status(_running(motion_id, start), seq, now)
        if start + 250 <= row < start + 900:
            return _status(_record(motion_id, start, start + 250), seq, now)
    return None


@settings(max_examples=80, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    loss=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
    silent=st.booleans(),
    holes=st.integers(0, 9),
)
def test_over_any_network_a_motion_is_handed_over_complete_and_once_or_not_at_all(
    seed: int, loss: float, silent: bool, holes: int
) -> None:
    rng = np.random.default_rng(seed)
    listener, net = Checked(), _Net(rng, loss)
    found: list[JointMotion] = []
    listening = False
    lost_rows = rng.integers(0, 1400 // 50, holes).tolist()
    for tick in range(900):
        now = tick * 20 * MS
        row = now // (4 * MS)
        status = _news(now, 1 + tick)
        if status is not None and tick % 10 == 0:
            net.send(now, status)
        if listening and row < 1400 and row // 50 not in lost_rows:
            listener.on_feedback(_feedback(row, 5), {"ME": now})
        for message in net.arrived(now):
            if isinstance(message, Status):
                listener.on_status(message, now, {"ME": now})
            elif isinstance(message, AskHistory):
                if not silent and message.end_row <= row:
                    count = message.end_row - message.first_row
                    net.send(now, _feedback(message.first_row, count))
            else:
                listener.on_feedback(message, {"ME": now}, live=False)
        actions, motions = listener.poll(now)
        for wish in actions:
            if isinstance(wish, Listen):
                assert wish.on != listening  # never told twice
                listening = wish.on
            else:
                net.send(now, wish)
        found += motions
    numbers = [m.record.motion_id for m in found]
    assert len(set(numbers)) == len(numbers)
    for motion in found:
        start = 100 if motion.record.motion_id == 11 else 1100
        assert _whole(motion, _record(motion.record.motion_id, start, start + 250))
    # In the end nothing is left to wait for, and no module is subscribed to.
    assert not listening
    if loss == 0.0 and not silent and not lost_rows:
        assert numbers == [11, 12]


def test_modules_and_boots_that_were_made_up_are_remembered_up_to_a_bound() -> None:
    listener, refused = MotionListener(), 0
    for number in range(5000):
        listener.on_status(_status(None, boot=number), 0, OWN)
        try:
            listener.on_status(_status(_record(end=None, outcome="running"), serial=f"M{number}"), 0, OWN)
        except WireError:
            refused += 1
    assert len(listener._newest) == MAX_BOOTS
    assert refused == 5000 - (MAX_MODULES - 1)
    # A module that was heard of before is heard on.
    listener.on_status(_status(_record(2), seq=9, boot=5001), 0, OWN)
    assert listener._tracks["J"].record.motion_id == 2


def test_modules_that_were_made_up_do_not_keep_others_out_for_ever() -> None:
    listener = MotionListener()
    for number in range(MAX_MODULES):
        listener.on_status(_status(_record(end=None, outcome="running"), serial=f"M{number}"), 0, OWN)
    with pytest.raises(WireError, match="J is one module more"):
        listener.on_status(_status(_record()), 1, OWN)
    listener.poll(FORGET_NS)
    listener.on_status(_status(_record()), FORGET_NS, OWN)
    assert "J" in listener._tracks
    assert len(listener._boot) == len(listener._heard_ns) == MAX_MODULES


def test_what_was_heard_of_modules_that_were_made_up_is_forgotten_with_them() -> None:
    listener = MotionListener()
    for number in range(5 * MAX_MODULES):
        serial, now_ns = f"M{number}", number * FORGET_NS
        # A motion without rows is whole at once.
        listener.on_status(_status(_record(start=5, end=5), serial=serial), now_ns, OWN)
        listener.poll(now_ns)
    assert len(listener._finished) == len(listener._boot) == MAX_MODULES


def test_a_module_that_was_forgotten_is_heard_again_and_its_old_words_are_not() -> None:
    listener = MotionListener()
    for boot in (6, 7):
        listener.on_status(_status(_record(1, 5, 5), seq=3, serial="M", boot=boot), 0, OWN)
        listener.poll(0)
    for number in range(MAX_MODULES):
        listener.on_status(_status(None, serial=f"M{number}"), FORGET_NS + number, OWN)
    assert "M" not in listener._boot
    later = 3 * FORGET_NS
    for boot in (6, 7):
        listener.on_status(
            _status(_record(2, end=None, outcome="running"), seq=3, serial="M", boot=boot), later, OWN
        )
    assert "M" not in listener._tracks
    listener.on_status(
        _status(_record(2, end=None, outcome="running"), seq=4, serial="M", boot=7), later, OWN
    )
    assert listener._tracks["M"].record.motion_id == 2


def test_of_a_motion_without_an_end_no_more_rows_are_kept_than_of_any_other() -> None:
    listener = MotionListener()
    listener.on_status(_status(_record(start=1000, end=None, outcome="running")), 0, OWN)
    track = listener._tracks["J"]
    first = track.record.start_row
    for far in (first + MAX_ROWS_PER_MOTION, first - MAX_BATCH_ROWS, 2**60):
        listener.on_feedback(_feedback(far), OWN)
    assert track.log.first_row == track.log.end_row
    listener.on_feedback(_feedback(first), OWN)
    assert track.log.end_row > first

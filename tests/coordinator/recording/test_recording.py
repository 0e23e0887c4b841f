"""What a session has recording, by module, boot, joint and observer; and a hash that notices every change."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import (
    JOURNAL_TOPIC,
    MAX_BOOTS,
    MAX_MODULES,
    STRANGER_ROWS,
    Arrivals,
    Entry,
    Recording,
    RecordingFull,
    RoundTrip,
)
from module_agent.wire.codec import encode
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import Ack, Rest, Status, Stop
from module_agent.wire.refusal import WireError
from tests.other_thread import repeating


@pytest.fixture
def recording() -> Recording:
    return Recording()


def test_rows_out_of_order_and_repeated_are_stored_once_in_order(
    recording: Recording, wire: SimpleNamespace
) -> None:
    for first in (10, 0, 5, 5, 15):
        recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(first=first)))
    np.testing.assert_array_equal(recording.rows("A", 3, 18)["position_rad"], np.arange(3, 18))
    assert recording.modules["A"].rows.missing(0, 20) == []


def test_rows_of_two_boots_of_one_module_are_separate(recording: Recording, wire: SimpleNamespace) -> None:
    recording.add(wire.reply(Leaf.STATUS, wire.status(boot=7)))
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(boot=7, first=1000)))
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(boot=8, first=0)))
    assert recording.modules["A"].boot == 8
    assert (recording.modules["A"].rows.first_row, recording.modules["A"].rows.end_row) == (0, 5)
    old = recording.past["A", 7].rows
    assert (old.first_row, old.end_row) == (1000, 1005)


def test_a_straggler_of_an_old_boot_does_not_bring_that_boot_back(
    recording: Recording, wire: SimpleNamespace
) -> None:
    recording.add(wire.publication(Leaf.STATUS, wire.status(boot=7)))
    recording.add(wire.publication(Leaf.STATUS, wire.status(boot=8)))
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(boot=7, first=20)))
    assert recording.modules["A"].boot == 8
    # It belongs to its own boot all the same.
    assert recording.past["A", 7].rows.end_row == 25


def test_a_round_trip_joins_a_question_to_its_answer_by_key_and_number(
    recording: Recording, wire: SimpleNamespace
) -> None:
    recording.add(wire.request(Leaf.STATUS, wire.ask(seq=3), t_ns=100))
    recording.add(wire.request(Leaf.STATUS, wire.ask(seq=4), t_ns=200))
    recording.add(wire.request(Leaf.STATUS, wire.ask("B", seq=5), t_ns=250))
    recording.add(wire.reply(Leaf.STATUS, wire.status(re=4, t_ns=77), t_ns=300))
    recording.add(wire.reply(Leaf.STATUS, wire.status(re=4, t_ns=77), t_ns=301))  # a copy is no second trip
    recording.add(wire.reply(Leaf.STATUS, wire.status(re=9, t_ns=78), t_ns=302))  # not requested
    assert recording.modules["A"].round_trips == [RoundTrip(200, 300, 77)]
    assert "B" not in recording.modules


def test_round_trips_after_the_settled_event_do_not_count(
    recording: Recording, wire: SimpleNamespace
) -> None:
    def trip(number: int, t_ns: int) -> None:
        recording.add(wire.request(Leaf.STATUS, wire.ask(seq=number), t_ns=t_ns))
        recording.add(wire.reply(Leaf.STATUS, wire.status(re=number, t_ns=77), t_ns=t_ns + 10))

    def journal(what: str) -> None:
        event = JournalEvent.model_validate({"t_ns": 500, "what": what})
        recording.add(Entry("journal", JOURNAL_TOPIC, 500, event.encode()))

    trip(1, 100)
    journal("settled")
    # At the very same time: what counts is the order of the recording.
    trip(2, 490)
    module = recording.modules["A"]
    assert [t.sent_ns for t in module.trips] == [100]
    assert [t.sent_ns for t in module.round_trips] == [100, 490]
    # A session that goes on after a crash settles anew.
    journal("session")
    assert module.trips == module.round_trips


def test_a_published_status_is_no_answer(recording: Recording, wire: SimpleNamespace) -> None:
    recording.add(wire.request(Leaf.STATUS, wire.ask(seq=0), t_ns=100))
    recording.add(wire.publication(Leaf.STATUS, wire.status(t_ns=5, re=0), t_ns=120))
    assert recording.modules["A"].round_trips == []


def test_a_refusal_in_place_of_an_answer_is_understood(recording: Recording, wire: SimpleNamespace) -> None:
    for leaf in (Leaf.HISTORY, Leaf.ESTIMATE, Leaf.INFO, Leaf.STATUS, Leaf.LEASE, Leaf.MOTION):
        assert isinstance(recording.add(wire.reply(leaf, wire.ack(accepted=False))), Ack)


def test_messages_on_another_modules_key_are_counted_and_rejected(
    recording: Recording, wire: SimpleNamespace
) -> None:
    for entry in (
        wire.publication(Leaf.STATUS, wire.status("B"), on="A"),
        wire.publication(Leaf.FEEDBACK, wire.feedback("B"), on="A"),
        wire.reply(Leaf.LEASE, wire.ack("B"), on="A"),
    ):
        with pytest.raises(WireError, match="B speaks on the key of A"):
            recording.add(entry)
    assert recording.refused == {"wrong_serial": 3}
    assert recording.modules == {}


def test_unreadable_messages_are_counted_by_reason(recording: Recording, wire: SimpleNamespace) -> None:
    topic = key(wire.robot, "A", Leaf.STATUS)
    other_version = encode(wire.status().model_copy(update={"v": 2}))
    for payload in (b"", b"\xc1", other_version):
        with pytest.raises(WireError):
            recording.add(Entry("publication", topic, 0, payload))
    with pytest.raises(WireError, match="no publication is defined on info"):
        recording.add(wire.publication(Leaf.INFO, wire.info()))
    assert recording.refused == {"malformed": 3, "version": 1}


def test_the_newest_module_time_never_decreases(recording: Recording, wire: SimpleNamespace) -> None:
    for t_ns in (50, 90, 70):
        recording.add(wire.publication(Leaf.STATUS, wire.status(t_ns=t_ns)))
    assert recording.modules["A"].newest_ns == 90
    recording.add(wire.reply(Leaf.LEASE, wire.ack(t_ns=120)))
    assert recording.modules["A"].newest_ns == 120


def test_only_published_rows_set_the_time_of_the_last_feedback(
    recording: Recording, wire: SimpleNamespace
) -> None:
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(first=10), t_ns=1000))
    recording.add(wire.reply(Leaf.HISTORY, wire.feedback(first=0), t_ns=2000))
    module = recording.modules["A"]
    assert (module.feedback_ns, module.newest_row_ns, module.newest_row_arrival_ns) == (
        1000,
        56_000_000,
        1000,
    )


def test_rows_that_came_on_request_alone_were_lost_and_those_that_never_came_are_missing(
    recording: Recording, wire: SimpleNamespace
) -> None:
    rows = wire.feedback().count
    for message in (0, 1, 3, 5):
        recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(first=message * rows)))
    module = recording.modules["A"]
    assert module.loss == ("A", 4 * rows, 2 * rows, 2 * rows)
    # One of the two that were lost comes on request; what had come already is no loss when it comes again.
    for message in (2, 3):
        recording.add(wire.reply(Leaf.HISTORY, wire.feedback(first=message * rows)))
    assert module.loss == ("A", 5 * rows, 2 * rows, rows)
    # The other one was only late.
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(first=4 * rows)))
    assert module.loss == ("A", 6 * rows, rows, 0)


def test_late_and_repeated_feedback_does_not_change_when_the_newest_row_arrived(
    recording: Recording, wire: SimpleNamespace
) -> None:
    # Session times and first rows: the third message was overtaken, the fourth is the second again.
    for t_ns, first in ((100, 0), (105, 10), (110, 5), (115, 10)):
        recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(first=first), t_ns=t_ns))
    module = recording.modules["A"]
    assert (module.feedback_ns, module.newest_row_arrival_ns) == (115, 105)
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(first=20), t_ns=120))
    assert module.newest_row_arrival_ns == 120


def test_forgetting_retains_the_newest_rows_and_round_trips(
    recording: Recording, wire: SimpleNamespace
) -> None:
    for first in range(0, 100, 5):
        recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(first=first)))
    module = recording.modules["A"]
    module.round_trips.extend(RoundTrip(t, t + 2, t + 1) for t in range(6))
    module.forget(rows=10, round_trips=2)
    assert (module.rows.first_row, module.rows.end_row) == (90, 100)
    assert [trip.sent_ns for trip in module.round_trips] == [4, 5]
    module.forget(rows=10, round_trips=0)
    assert module.round_trips == []


def test_estimates_are_indexed_by_joint_observer_and_motion(
    recording: Recording, wire: SimpleNamespace
) -> None:
    for joint, observer, ids in (("A", "B", (1,)), ("A", "B", (1, 2)), ("A", "C", (1,)), ("B", "A", (3,))):
        recording.add(wire.publication(Leaf.ESTIMATE, wire.estimate(joint, observer, ids=ids)))
    again = wire.estimate("A", "B", ids=(1, 2), rate_ratio=0.25)
    recording.add(wire.reply(Leaf.ESTIMATE, again))
    assert list(recording.estimates) == [("A", "B"), ("A", "C"), ("B", "A")]
    assert list(recording.estimates["A", "B"]) == [(1,), (1, 2)]
    assert recording.estimates["A", "B"][1, 2].rate_ratio == 0.25


def test_the_journal_is_stored_but_is_no_part_of_the_trace(
    recording: Recording, wire: SimpleNamespace
) -> None:
    before = recording.trace_hash
    motion = wire.record(5, Rest(duration_s=1.0), 0, 250)
    recording.add(wire.journal("motion", serial="A", purpose="rest", motion=motion))
    assert [e.motion for e in recording.journal] == [motion]
    assert recording.trace_hash == before


def test_requests_say_what_was_sent_and_make_no_module_known(
    recording: Recording, wire: SimpleNamespace
) -> None:
    stop = Stop(serial="A", boot=0, seq=1, sender="tester", why="test")
    assert recording.add(wire.request(Leaf.STOP, stop)) == stop
    assert recording.modules == {}


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    times=st.lists(st.integers(0, 2**62), min_size=1, max_size=5),
    where=st.integers(0, 10**6),
    change=st.sampled_from(["time", "kind", "topic", "payload", "drop", "repeat"]),
)
def test_the_trace_hash_changes_with_any_change(
    wire: SimpleNamespace, times: list[int], where: int, change: str
) -> None:
    entries = [wire.publication(Leaf.STATUS, wire.status(t_ns=t), t) for t in times]
    index = where % len(entries)
    old = entries[index]
    changed: dict[str, list[Entry]] = {
        "time": [old._replace(t_ns=old.t_ns + 1)],
        "kind": [old._replace(kind="reply")],
        "topic": [old._replace(topic=key(wire.robot, "B", Leaf.STATUS))],
        "payload": [old._replace(payload=encode(wire.status(t_ns=times[index], token=1)))],
        "drop": [],
        "repeat": [old, old],
    }
    others = entries[:index] + changed[change] + entries[index + 1 :]
    hashes = []
    for each in (entries, entries, others):
        recording = Recording()
        for entry in each:
            try:
                recording.add(entry)
            except WireError:
                assert change == "topic"  # what is refused is part of the trace too
        hashes.append(recording.trace_hash)
    assert hashes[0] == hashes[1] != hashes[2]


def test_a_status_is_decoded_as_it_was_sent(recording: Recording, wire: SimpleNamespace) -> None:
    sent = wire.status(refusals={"stale": 3}, note="x" * 512)
    decoded = recording.add(wire.publication(Leaf.STATUS, sent))
    assert isinstance(decoded, Status)
    assert decoded == sent
    assert recording.modules["A"].status == sent


def test_boots_that_were_made_up_are_forgotten_before_those_that_have_answered(
    recording: Recording, wire: SimpleNamespace
) -> None:
    for boot in (6, 7):
        recording.add(wire.reply(Leaf.STATUS, wire.status(boot=boot)))
    for first in range(0, 100, 5):
        recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(boot=7, first=first)))
    for boot in range(1000, 3000):
        recording.add(wire.publication(Leaf.STATUS, wire.status(boot=boot)))
    assert len(recording.past) == MAX_BOOTS
    assert recording.past["A", 7].rows.count == 100
    assert ("A", 6) in recording.past


def test_modules_that_were_made_up_do_not_fill_the_memory(
    recording: Recording, wire: SimpleNamespace
) -> None:
    for number in range(MAX_MODULES + 100):
        recording.accept(wire.publication(Leaf.STATUS, wire.status(f"M{number}")))
    assert len(recording.modules) == MAX_MODULES
    assert recording.refused == {"limit": 100}
    # The modules that were there before go on being recorded.
    assert recording.accept(wire.publication(Leaf.STATUS, wire.status("M5", t_ns=9))) is not None
    assert recording.modules["M5"].newest_ns == 9


def test_of_a_module_that_answers_no_question_only_the_newest_rows_are_kept(
    recording: Recording, wire: SimpleNamespace
) -> None:
    for first in range(0, 10_000, 500):
        # B publishes alike, and was asked before.
        recording.add(wire.reply(Leaf.STATUS, wire.status("B")))
        for serial in ("A", "B"):
            recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(serial, first=first, count=500)))
    made_up, asked = recording.modules["A"], recording.modules["B"]
    assert STRANGER_ROWS <= made_up.rows.count <= 1.1 * STRANGER_ROWS
    assert made_up.rows.end_row == 10_000
    assert asked.rows.count == 10_000
    # Another boot in its name leaves nothing of it, and nothing of what comes late.
    recording.add(wire.publication(Leaf.STATUS, wire.status(boot=2)))
    assert made_up.rows.count == 0
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback(first=10_000)))
    assert made_up.rows.count == 0
    recording.add(wire.publication(Leaf.STATUS, wire.status("B", boot=2)))
    assert asked.rows.count == 10_000


def test_values_that_are_no_numbers_are_counted_of_the_modules_that_are_there(
    recording: Recording, wire: SimpleNamespace
) -> None:
    def send(serial: str) -> None:
        bad = wire.estimate("A", serial).model_copy(update={"rate_ratio": np.nan})
        recording.accept(wire.publication(Leaf.ESTIMATE, bad))

    recording.add(wire.publication(Leaf.STATUS, wire.status("A")))
    for number in range(MAX_MODULES + 100):
        send(f"M{number}")
    send("A")
    assert len(recording.not_finite) == MAX_MODULES + 1
    assert recording.not_finite["A"] == 1
    assert recording.refused == {"not_finite": MAX_MODULES + 101}


def test_a_session_whose_rows_fill_the_memory_is_told_of_which_module_how_many_and_what_to_do(
    recording: Recording, wire: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 1 kHz four million rows are an hour."""
    monkeypatch.setattr("module_agent.wire.row_log.MAX_ROWS", 3000)
    for serial in ("A", "B"):
        recording.add(wire.reply(Leaf.INFO, wire.info(serial)))
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback("A", first=0)))
    # Numbers that were made up fill nothing.
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback("A", first=2990)))
    recording.check_room(("A", "B"))
    for first in range(0, 2900, 100):
        recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback("B", first=first, count=100)))
        if first == 2000:
            recording.check_room(("A", "B"))
    with pytest.raises(RecordingFull, match=r"module B .* 2900 rows of it, 0\.193 min at 250 Hz; .*rate"):
        recording.check_room(("A", "B"))
    monkeypatch.setattr("module_agent.wire.row_log.MAX_ROWS", 10_000)
    recording.check_room(("A", "B"))
    # Each has room, and all together have none.
    monkeypatch.setattr("coordinator.recording.recording.MAX_ROWS_OF_ALL", 2900)
    with pytest.raises(RecordingFull, match=r"2910 rows of 2 modules, most of them of B: 2900, .*rate"):
        recording.check_room(("A", "B"))


def test_a_recording_is_copied_while_another_thread_adds_to_it(wire: SimpleNamespace) -> None:
    """As a session identifies the chain of the robot without some modules while feedback arrives."""
    recording = Recording()

    def write(number: int) -> None:
        # Modules, and what each of them estimated of one joint after the other; rows come and are forgotten.
        serial, first = f"M{number % 100}", 5 * (number // 100)
        recording.accept(wire.publication(Leaf.FEEDBACK, wire.feedback(serial, first=first), t_ns=first))
        recording.accept(wire.publication(Leaf.ESTIMATE, wire.estimate(f"M{number // 100 % 100}", serial)))
        recording.modules[serial].forget(rows=20, round_trips=0)

    with repeating(write):
        for _ in range(100):
            for module in recording.without(("M1",)).modules.values():
                row_ns, arrival_ns = module.arrivals.columns()
                # Of five rows, 4 ms apart, the newest; the message came at the number of its first row.
                assert np.array_equal(row_ns, 4_000_000 * (arrival_ns + 4))
                stored = module.rows.rows(0, module.rows.end_row)["position_rad"]
                assert np.array_equal(stored, np.arange(module.rows.first_row, module.rows.end_row))


def test_both_times_of_an_arrival_come_and_go_at_once() -> None:
    arrivals = Arrivals()

    def write(number: int) -> None:
        arrivals.add(number, -number)
        arrivals.forget(20)

    with repeating(write):
        for _ in range(3000):
            for times in (arrivals.columns(), arrivals.copied().columns()):
                assert np.array_equal(times[0], -times[1])
                assert len(times[0]) <= 21

"""A recording comes back as it was written, up to wherever a crash has cut it."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer

from coordinator.recording.recording import MAX_MODULES, Entry
from coordinator.recording.run_folder import load_recording
from coordinator.recording.session_file import (
    MCAP0_MAGIC,
    SessionFileError,
    SessionWriter,
    read_session,
)
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import Stop

PERIOD_NS = 20_000_000


def _entries(wire: SimpleNamespace, count: int) -> list[Entry]:
    """Entries of every kind, 50 a second: five flushes for every 50."""
    entries = [wire.journal("session", robot="robot")]
    for i in range(1, count):
        t_ns = i * PERIOD_NS
        entries.append(
            (
                wire.publication(Leaf.FEEDBACK, wire.feedback(first=5 * i), t_ns),
                wire.request(Leaf.STATUS, wire.ask(seq=i), t_ns),
                wire.reply(Leaf.STATUS, wire.status(re=i - 1), t_ns),
                wire.reply(Leaf.HISTORY, wire.feedback(first=5 * i, count=200), t_ns),
                wire.journal("note", t_ns, text=f"note {i}"),
            )[i % 5]
        )
    return entries


def _write(path: Path, entries: list[Entry]) -> SessionWriter:
    writer = SessionWriter(path)
    for entry in entries:
        writer.write(entry)
    return writer


def test_what_was_written_is_read_in_the_same_order(tmp_path: Path, wire: SimpleNamespace) -> None:
    entries = _entries(wire, 120)
    # Messages that share an instant keep their order, and a clock that was set back does not sort them.
    entries += [entry._replace(t_ns=0) for entry in entries[:30]]
    _write(tmp_path / "session.mcap", entries).close()
    assert list(read_session(tmp_path / "session.mcap")) == entries


def test_without_being_closed_at_most_a_fifth_of_a_second_is_missing(
    tmp_path: Path, wire: SimpleNamespace
) -> None:
    entries = _entries(wire, 200)
    writer = _write(tmp_path / "session.mcap", entries)
    crashed = tmp_path / "crashed.mcap"
    crashed.write_bytes((tmp_path / "session.mcap").read_bytes())
    writer.close()
    read = list(read_session(crashed))
    assert read == entries[: len(read)]
    assert len(read) >= len(entries) - 200_000_000 // PERIOD_NS


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_file_cut_at_any_byte_is_read_up_to_the_cut(
    tmp_path: Path, wire: SimpleNamespace, data: st.DataObject
) -> None:
    whole = tmp_path / "session.mcap"
    entries = _entries(wire, 60)
    if not whole.exists():
        _write(whole, entries).close()
    content = whole.read_bytes()
    cut = data.draw(st.integers(0, len(content)))
    (tmp_path / "cut.mcap").write_bytes(content[:cut])
    read = list(read_session(tmp_path / "cut.mcap"))
    assert read == entries[: len(read)]
    # Lost are the chunk that the cut goes through, and what comes after it.
    with whole.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = [c for c in summary.chunk_indexes if c.chunk_start_offset + c.chunk_length <= cut]
    last_ns = max((c.message_end_time for c in chunks), default=-1)
    assert len(read) >= sum(entry.t_ns <= last_ns for entry in entries)


@pytest.mark.parametrize("cut", range(12))
def test_a_file_of_a_few_bytes_is_an_empty_recording(tmp_path: Path, cut: int, wire: SimpleNamespace) -> None:
    _write(tmp_path / "session.mcap", _entries(wire, 3)).close()
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "session.mcap").read_bytes()[:cut])
    assert list(read_session(tmp_path / "cut.mcap")) == []


def test_any_mcap_tool_finds_the_schemas_and_the_index(tmp_path: Path, wire: SimpleNamespace) -> None:
    _write(tmp_path / "session.mcap", _entries(wire, 50)).close()
    with (tmp_path / "session.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 50
    assert sorted(s.name for s in summary.schemas.values()) == [
        "x5.Ask",
        "x5.Feedback",
        "x5.JournalEvent",
        "x5.Status",
    ]
    kinds = {(c.topic.rsplit("/")[-1], c.metadata["kind"]) for c in summary.channels.values()}
    assert ("status", "request") in kinds
    assert ("status", "reply") in kinds


def test_foreign_files_are_refused_by_name(tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("no recording")
    with pytest.raises(SessionFileError, match=r"notes\.txt: not an MCAP file; give the session\.mcap"):
        list(read_session(text))
    with pytest.raises(SessionFileError, match=r"missing\.mcap: No such file"):
        list(read_session(tmp_path / "missing.mcap"))
    with pytest.raises(SessionFileError, match="directory"):
        list(read_session(tmp_path))


def test_an_mcap_file_of_something_else_is_refused_by_its_topic(tmp_path: Path) -> None:
    path = tmp_path / "camera.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(topic="/camera", message_encoding="json", schema_id=0)
        writer.add_message(channel, log_time=0, data=b"{}", publish_time=0)
        writer.finish()
    with pytest.raises(SessionFileError, match=r"camera\.mcap: topic /camera is not of a session"):
        list(read_session(path))


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_what_comes_out_of_a_damaged_file_was_recorded_and_what_does_not_is_reported(
    tmp_path: Path, wire: SimpleNamespace, data: st.DataObject
) -> None:
    whole = tmp_path / "session.mcap"
    entries = _entries(wire, 400)
    if not whole.exists():
        _write(whole, entries).close()
    content = bytearray(whole.read_bytes())
    first = data.draw(st.integers(len(MCAP0_MAGIC), len(content) - 1))
    count = data.draw(st.sampled_from([1, 8, 512]))
    noise = data.draw(st.binary(min_size=count, max_size=count))
    content[first : first + count] = noise[: len(content) - first]
    (tmp_path / "damaged.mcap").write_bytes(content)
    reports: list[str] = []
    read = list(read_session(tmp_path / "damaged.mcap", reports.append))
    remaining = iter(entries)
    assert all(entry in remaining for entry in read), "in their order, none invented"
    if len(read) < len(entries):
        assert reports
        assert all("damaged.mcap" in report for report in reports)
    # A place is damaged, not the file: a chunk is a fifth of a second, here 10 entries.
    assert len(read) >= len(entries) - 40


def test_a_whole_file_has_no_damage(tmp_path: Path, wire: SimpleNamespace) -> None:
    reports: list[str] = []
    _write(tmp_path / "session.mcap", _entries(wire, 400)).close()
    assert len(list(read_session(tmp_path / "session.mcap", reports.append))) == 400
    assert reports == []


def test_damage_names_the_place_and_the_time(tmp_path: Path, wire: SimpleNamespace) -> None:
    path = tmp_path / "session.mcap"
    _write(path, _entries(wire, 400)).close()
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 4] = b"\xff" * 4
    path.write_bytes(content)
    recording = load_recording(path)
    (sentence,) = recording.damage
    start, end, after_s = map(
        float, re.findall(r"from byte (\d+) to (\d+): messages after (\S+) s", sentence)[0]
    )
    assert start <= middle < end
    assert 2.0 < after_s < 6.0


def test_a_length_beyond_any_file_is_damage(tmp_path: Path, wire: SimpleNamespace) -> None:
    path, entries = tmp_path / "session.mcap", _entries(wire, 400)
    _write(path, entries).close()
    content = bytearray(path.read_bytes())
    held_at = content.index(b"zstd") + 4
    content[held_at - 4 : held_at + 8] = b"none" + (2**63).to_bytes(8, "little")
    path.write_bytes(content)
    reports: list[str] = []
    read = list(read_session(path, reports.append))
    assert len(reports) == 1
    assert 360 <= len(read) < 400


def test_closing_twice_is_once(tmp_path: Path, wire: SimpleNamespace) -> None:
    writer = _write(tmp_path / "session.mcap", _entries(wire, 10))
    writer.close()
    size = (tmp_path / "session.mcap").stat().st_size
    writer.close()
    assert (tmp_path / "session.mcap").stat().st_size == size


def test_a_full_disk_is_said_and_what_comes_then_is_dropped(tmp_path: Path, wire: SimpleNamespace) -> None:
    writer = SessionWriter(Path("/dev/full"))
    for entry in _entries(wire, 400):
        writer.write(entry)
    writer.close()
    assert writer.failure is not None
    assert "/dev/full cannot be written any more: No space left on device" in str(writer.failure)


def test_a_recording_ends_at_its_limit_and_is_whole_up_to_there(
    tmp_path: Path, wire: SimpleNamespace
) -> None:
    path = tmp_path / "session.mcap"
    entries = _entries(wire, 2000)
    writer = SessionWriter(path, max_bytes=20_000)
    for entry in entries:
        if writer.failure is None:
            writer.write(entry)
    # Of a session that has failed the journal says why.
    writer.write(entries[1])
    writer.write(wire.journal("failed", t_ns=entries[-1].t_ns, text="full"))
    writer.close()
    assert "the limit of --max-disk" in str(writer.failure)
    # A chunk more, and the index.
    assert 20_000 < path.stat().st_size < 60_000
    damage: list[str] = []
    read = list(read_session(path, damage.append))
    assert not damage
    assert read[:-1] == entries[: len(read) - 1]
    assert 50 < len(read) < 2000
    assert read[-1].kind == "journal"


def test_made_up_keys_leave_room_for_modules_and_for_every_stop(
    tmp_path: Path, wire: SimpleNamespace
) -> None:
    """MCAP numbers channels in 16 bits; anybody may publish under more serials than that."""
    path = tmp_path / "session.mcap"
    writer = SessionWriter(path)
    noise = wire.publication(Leaf.STATUS, wire.status())
    made_up = [noise._replace(topic=key("robot", f"M{number}", Leaf.STATUS)) for number in range(2**16 + 8)]
    taken = [entry for entry in made_up if writer.write(entry)]
    assert taken == made_up[:MAX_MODULES]
    assert writer.unrecorded == len(made_up) - MAX_MODULES
    # What is asked and answered has its place, and then all that this module publishes, and what others do.
    own = [
        wire.request(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="tester")),
        wire.reply(Leaf.STOP, wire.ack(re=1)),
        wire.publication(Leaf.STATUS, wire.status("A")),
        wire.publication(Leaf.FEEDBACK, wire.feedback("M0")),
        wire.journal("failed", text="stopped"),
    ]
    assert all(map(writer.write, own))
    assert writer.write(made_up[0])
    writer.close()
    assert writer.failure is None
    damage: list[str] = []
    assert list(read_session(path, damage.append)) == [*taken, *own, made_up[0]]
    assert not damage


def test_a_record_that_is_turned_into_the_end_of_the_data_is_reported(
    tmp_path: Path, wire: SimpleNamespace
) -> None:
    """Byte 8 is the header's opcode; that of the indices after every chunk is one flipped bit away."""
    path, entries = tmp_path / "session.mcap", _entries(wire, 100)
    _write(path, entries).close()
    content = path.read_bytes()
    starts, at = [], len(MCAP0_MAGIC)
    while content[at] != Opcode.DATA_END:
        starts.append(at)
        at += 9 + int.from_bytes(content[at + 1 : at + 9], "little")
    assert starts[0] == 8
    assert {content[start] for start in starts} >= {Opcode.CHUNK, Opcode.MESSAGE_INDEX}
    for start in starts:
        altered = bytearray(content)
        altered[start] = Opcode.DATA_END
        path.write_bytes(altered)
        reports: list[str] = []
        read = list(read_session(path, reports.append))
        (report,) = reports
        assert f"from byte {start} to" in report
        # No more is lost than the chunk itself.
        kept = iter(entries)
        assert all(entry in kept for entry in read)
        assert len(read) >= (85 if content[start] == Opcode.CHUNK else 100)

"""A run's folder is never written over, and a crashed run loses nothing by being resumed, however often."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from coordinator.recording.recording import Entry
from coordinator.recording.run_folder import RESULT, SESSION, RunFolderError, load_recording, open_run_folder
from coordinator.recording.session_file import SessionWriter, read_session
from module_agent.wire.keys import Leaf, key

CRASHED = "session.crashed.mcap"


def _entries(wire: SimpleNamespace, count: int) -> list[Entry]:
    return [
        wire.publication(Leaf.FEEDBACK, wire.feedback(first=5 * i), i * 250_000_000) for i in range(count)
    ]


def _killed(path: Path, entries: list[Entry]) -> None:
    """Write as a process does that is killed right after: what was flushed is on disk, no index is."""
    writer = SessionWriter(path)
    for entry in entries:
        writer.write(entry)
    writer.flush()
    content = path.read_bytes()
    writer.close()
    path.write_bytes(content)


def test_a_new_run_makes_its_folder_and_those_above_it(tmp_path: Path) -> None:
    assert open_run_folder(tmp_path / "runs" / "today", resume=False) is None
    assert (tmp_path / "runs" / "today").is_dir()


@pytest.mark.parametrize("name", [SESSION, CRASHED])
def test_a_run_is_never_written_over(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"precious")
    with pytest.raises(RunFolderError, match="holds a run already: choose another --out, or --resume"):
        open_run_folder(tmp_path, resume=False)
    assert (tmp_path / name).read_bytes() == b"precious"


def test_there_must_be_something_to_resume(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match="no recording to resume"):
        open_run_folder(tmp_path, resume=True)


def test_a_complete_run_is_not_resumed(tmp_path: Path) -> None:
    (tmp_path / SESSION).write_bytes(b"precious")
    (tmp_path / RESULT).write_text("{}")
    with pytest.raises(RunFolderError, match="holds a complete run"):
        open_run_folder(tmp_path, resume=True)
    assert (tmp_path / SESSION).read_bytes() == b"precious"


def test_resuming_sets_the_crashed_recording_aside(tmp_path: Path, wire: SimpleNamespace) -> None:
    entries = _entries(wire, 20)
    _killed(tmp_path / SESSION, entries)
    aside = open_run_folder(tmp_path, resume=True)
    assert aside == tmp_path / CRASHED
    assert list(read_session(aside)) == entries
    assert not (tmp_path / SESSION).exists()


@pytest.mark.parametrize("repeated", [0, 1, 7, 20])
def test_a_crash_while_the_crashed_recording_is_taken_over_loses_nothing(
    tmp_path: Path, wire: SimpleNamespace, repeated: int
) -> None:
    entries = _entries(wire, 20)
    _killed(tmp_path / SESSION, entries)
    assert open_run_folder(tmp_path, resume=True) is not None
    _killed(tmp_path / SESSION, entries[:repeated])
    again = open_run_folder(tmp_path, resume=True)
    assert again is not None
    assert list(read_session(again)) == entries


def test_a_crash_after_having_resumed_goes_on_from_the_longer_recording(
    tmp_path: Path, wire: SimpleNamespace
) -> None:
    entries = _entries(wire, 60)
    _killed(tmp_path / SESSION, entries[:20])
    for reached in (40, 60):
        assert open_run_folder(tmp_path, resume=True) is not None
        _killed(tmp_path / SESSION, entries[:reached])
    last = open_run_folder(tmp_path, resume=True)
    assert last is not None
    assert list(read_session(last)) == entries


def test_a_run_that_died_before_it_wrote_anything_can_be_resumed(tmp_path: Path) -> None:
    (tmp_path / SESSION).write_bytes(b"")
    aside = open_run_folder(tmp_path, resume=True)
    assert aside is not None
    assert list(read_session(aside)) == []


def test_loading_leaves_out_and_counts_unreadable_messages(tmp_path: Path, wire: SimpleNamespace) -> None:
    entries = _entries(wire, 4)
    entries.insert(2, Entry("publication", key(wire.robot, "A", Leaf.STATUS), 1, b"noise"))
    _killed(tmp_path / SESSION, entries)
    recording = load_recording(tmp_path / SESSION)
    assert recording.refused == {"malformed": 1}
    assert recording.modules["A"].rows.missing(0, 20) == []

"""Whatever a bad disk does to a recording: it is read as it was written, or what is wrong is said."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from coordinator.recording.recording import JOURNAL_TOPIC, Entry
from coordinator.recording.run_folder import load_recording
from coordinator.recording.session_file import SessionFileError, SessionWriter
from module_agent.wire.keys import Leaf
from sim.benchmark.damaged_files import DAMAGES


@pytest.fixture
def recorded(tmp_path: Path, wire: SimpleNamespace) -> Path:
    """Twenty seconds of one module, some twenty sectors."""
    draw = np.random.default_rng(3)
    writer = SessionWriter(tmp_path / "session.mcap")
    writer.write(wire.journal("session", robot="robot"))
    for k in range(600):
        t_ns = 33_000_000 * k
        writer.write(wire.publication(Leaf.FEEDBACK, wire.feedback(first=5 * k), t_ns))
        writer.write(wire.journal("note", t_ns, text=draw.bytes(60).hex()))
    writer.write(wire.journal("finished", 20_000_000_000))
    writer.close()
    return tmp_path / "session.mcap"


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_makes_no_difference_or_is_said(recorded: Path, damage: str) -> None:
    whole, content = load_recording(recorded), recorded.read_bytes()
    assert (whole.damage, whole.remarks) == ([], [])
    said = 0
    for seed in range(25):
        recorded.write_bytes(DAMAGES[damage](content, np.random.default_rng(seed)))
        try:
            read = load_recording(recorded)
        except SessionFileError:
            said += 1
            continue
        if read.damage or read.remarks:
            said += 1
        else:
            assert (read.trace_hash, read.journal) == (whole.trace_hash, whole.journal)
    assert said > 5


def test_events_that_this_version_does_not_know_are_said(tmp_path: Path, wire: SimpleNamespace) -> None:
    path = tmp_path / "session.mcap"
    writer = SessionWriter(path)
    writer.write(wire.journal("session", robot="robot"))
    writer.write(Entry("journal", JOURNAL_TOPIC, 1, b'{"t_ns":1,"what":"levitated"}'))
    writer.write(wire.journal("finished", 2))
    writer.close()
    (sentence,) = load_recording(path).damage
    assert sentence == (
        "session.mcap: an event of the journal is unknown to this version of the program, and left out"
    )

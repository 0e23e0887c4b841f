"""The library's part that needs no robot: what a long connection retains."""

from types import SimpleNamespace

from coordinator.api import _recorder
from coordinator.recording.recording import Entry, Recording
from module_agent.wire.keys import Leaf, key


def test_a_long_connection_retains_the_newest_rows_only(wire: SimpleNamespace) -> None:
    recording = Recording()
    record = _recorder(recording, retained_rows=100)
    spans = []
    for first in range(0, 1000, 5):
        assert record(wire.publication(Leaf.FEEDBACK, wire.feedback(first=first))) is not None
        rows = recording.modules["A"].rows
        spans.append(rows.end_row - rows.first_row)
    assert max(spans) <= 110
    assert min(spans[20:]) >= 100
    assert len(rows.rows(0, 1000)) == spans[-1]
    assert rows.end_row == 1000


def test_unreadable_messages_are_counted_and_not_passed_on(wire: SimpleNamespace) -> None:
    recording = Recording()
    entry = Entry("publication", key(wire.robot, "A", Leaf.STATUS), 0, b"\xc1")
    assert _recorder(recording)(entry) is None
    assert recording.refused == {"malformed": 1}

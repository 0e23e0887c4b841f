"""Journal events are encoded without loss; a failed session's journal tells whether the robot is stopped."""

from typing import Any

import pytest

from coordinator.recording.journal import (
    JournalEvent,
    excluded_modules,
    exclusion_event,
    missing_modules,
    standstill,
)
from module_agent.wire.refusal import WireError


def _event(what: str, **fields: Any) -> JournalEvent:
    return JournalEvent.model_validate({"t_ns": 5, "what": what, **fields})


@pytest.mark.parametrize("deaf", [(), ("A",), ("A", "B")])
def test_unconfirmed_modules_are_encoded(deaf: tuple[str, ...]) -> None:
    event = _event("failed", text="stopped: why", deaf=deaf)
    assert JournalEvent.model_validate_json(event.encode()) == event


@pytest.mark.parametrize(
    "journal", [[], [_event("session")], [_event("failed", deaf=["A"]), _event("session")]]
)
def test_a_session_that_did_not_fail_leaves_the_robot_at_rest(journal: list[JournalEvent]) -> None:
    assert standstill(journal) == "the robot was not moving"


def test_a_robot_whose_modules_all_confirmed_is_stopped() -> None:
    # A reason may read like anything, even like what a module is text to have left out.
    why = "stopped: the network is down; no confirmation from any module"
    assert standstill([_event("session"), _event("failed", text=why, deaf=())]) == "the robot is stopped"


def test_unconfirmed_modules_are_named() -> None:
    text = standstill([_event("failed", text="stopped: A is lost", deaf=("A", "B"))])
    assert text == "A, B did not confirm to have stopped: see that the robot stands still"


def test_a_module_that_refuses_by_its_limits_is_excluded_and_not_missing() -> None:
    refuses = exclusion_event(1, "A", "beyond its range", by_limits=True)
    hot = exclusion_event(2, "B", "in protection", by_limits=False)
    journal = [JournalEvent.decode(event.encode()) for event in (refuses, hot)]
    assert excluded_modules(journal) == {"A": "beyond its range", "B": "in protection"}
    assert missing_modules(journal, ("A", "C")) == ("B took no part: in protection",)
    # One of which the tree is not known is not known, well or not.
    assert missing_modules(journal, ("C",)) == (
        "A took no part: beyond its range",
        "B took no part: in protection",
    )
    # An older journal does not tell, and its module is not believed to be well.
    older = hot.model_copy(update={"by_limits": None})
    assert missing_modules([JournalEvent.decode(older.encode())], ("B",)) == (
        "B took no part: in protection",
    )
    # A resumed session has moved it.
    moved = [*journal, _event("motion", serial="B", purpose="windowed_sine")]
    assert missing_modules(moved, ("A", "B")) == ()


def test_an_event_of_another_version_is_refused_in_words_of_the_field() -> None:
    with pytest.raises(WireError, match=r"no event of a journal that this version knows: what: expected "):
        JournalEvent.decode(b'{"t_ns":5,"what":"teleported"}')
    with pytest.raises(WireError, match="no event of a journal"):
        JournalEvent.decode(b"{")


def test_an_older_journal_is_cited() -> None:
    old = b'{"t_ns":5,"what":"failed","text":"stopped: A is lost; no confirmation from A"}'
    text = standstill([JournalEvent.model_validate_json(old)])
    assert text == "stopped: A is lost; no confirmation from A: see that the robot stands still"

"""What a journal says of the robot, and that a line comes back as it was written."""

from typing import Any

import pytest

from coordinator.recording.journal import JournalEvent, standstill


def _event(what: str, **fields: Any) -> JournalEvent:
    return JournalEvent.model_validate({"t_ns": 5, "what": what, **fields})


@pytest.mark.parametrize("deaf", [(), ("A",), ("A", "B")])
def test_the_modules_that_did_not_confirm_are_kept(deaf: tuple[str, ...]) -> None:
    event = _event("failed", text="stopped: why", deaf=deaf)
    assert JournalEvent.model_validate_json(event.encode()) == event


@pytest.mark.parametrize(
    "journal", [[], [_event("session")], [_event("failed", deaf=["A"]), _event("session")]]
)
def test_before_anything_has_failed_nothing_moves(journal: list[JournalEvent]) -> None:
    assert standstill(journal) == "the robot was not moving"


def test_a_robot_of_which_every_module_has_confirmed_is_stopped() -> None:
    # A reason may read like anything, even like what a module is said to have left out.
    why = "stopped: the network is down; no confirmation from nobody"
    assert standstill([_event("session"), _event("failed", text=why, deaf=())]) == "the robot is stopped"


def test_modules_that_did_not_confirm_are_named() -> None:
    said = standstill([_event("failed", text="stopped: A is lost", deaf=("A", "B"))])
    assert said == "A, B did not confirm to have stopped: see that the robot stands still"


def test_a_journal_that_names_them_in_its_text_only_is_cited() -> None:
    old = b'{"t_ns":5,"what":"failed","text":"stopped: A is lost; no confirmation from A"}'
    said = standstill([JournalEvent.model_validate_json(old)])
    assert said == "stopped: A is lost; no confirmation from A: see that the robot stands still"

"""Who is excluded from a session, and whether it is well."""

from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.live_robot.errors import MotionInterrupted
from coordinator.live_robot.excluded_modules import ExcludedModules
from coordinator.live_robot.messenger import Refused
from module_agent.wire.keys import Leaf


class _Group:
    """Modules A and B under lease, with the states that a test sets."""

    def __init__(self) -> None:
        self.serials = ("A", "B")
        self.states: dict[str, str] = dict.fromkeys(self.serials, "armed")

    def module(self, serial: str) -> Any:
        return SimpleNamespace(status=self.status_under_lease(serial))

    def status_under_lease(self, serial: str) -> Any:
        return SimpleNamespace(state=self.states[serial], note="")


@pytest.fixture
def group() -> _Group:
    return _Group()


@pytest.fixture
def noted() -> list[tuple[str, bool]]:
    return []


@pytest.fixture
def excluded(group: Any, noted: list[tuple[str, bool]]) -> ExcludedModules:
    return ExcludedModules(group, lambda serial, why, by_limits: noted.append((serial, by_limits)))


def _refused(serial: str, reason: str) -> Refused:
    ack: Any = SimpleNamespace(reason=reason, detail="", re=1)
    return Refused(serial, Leaf.MOTION, ack)


def test_a_refusal_by_limits_is_told_from_protection(
    group: _Group, excluded: ExcludedModules, noted: list[tuple[str, bool]]
) -> None:
    assert not excluded.without(MotionInterrupted("A", "expired"))
    assert excluded.without(_refused("A", "limit"))
    assert noted == [("A", True)]
    # The last of those that move is not excluded.
    group.states["B"] = "fault"
    assert not excluded.without(MotionInterrupted("B", "ended by its protection"))


def test_a_module_in_protection_is_not_well(
    group: _Group, excluded: ExcludedModules, noted: list[tuple[str, bool]]
) -> None:
    group.states["B"] = "fault"
    assert excluded.without(MotionInterrupted("B", "ended by its protection"))
    assert noted == [("B", False)]


@pytest.mark.parametrize("state", ["fault", "expired"])
def test_a_module_that_holds_its_joint_no_longer_is_noted_once_more(
    group: _Group, excluded: ExcludedModules, noted: list[tuple[str, bool]], state: str
) -> None:
    assert excluded.without(_refused("A", "limit"))
    excluded.look_again()
    assert noted == [("A", True)]
    group.states["A"] = state
    excluded.look_again()
    excluded.look_again()
    assert noted == [("A", True), ("A", False)]
    assert state in excluded.why["A"]

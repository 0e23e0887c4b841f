"""The library's part that needs no process: what a long connection retains, and how a robot is held."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.api import LiveRobot, _recorder
from coordinator.live_robot.messenger import NoAnswer, Refused
from coordinator.recording.recording import Entry, Recording
from module_agent.network_emulation.profile import NetworkProfile
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


def test_a_robot_is_held_that_takes_longer_to_take_than_a_lease_lasts(
    rigs: Callable[..., Any],
) -> None:
    """Four answers of 80 ms each, one after the other, would be longer than the 250 ms of a lease."""
    rig = rigs("a2085_04", NetworkProfile(name="far", delay_ms=40.0))
    messenger, recording, group = rig.group()

    async def hold() -> list[str]:
        await group.meet(rig.serials)
        arm = LiveRobot(messenger, group, recording)
        await arm.hold()
        states = [rig.state(serial) for serial in rig.serials]
        await arm.close()
        return states

    assert rig.run(hold()) == ["armed"] * 4


def test_where_another_program_holds_one_module_the_others_are_held(rigs: Callable[..., Any]) -> None:
    rig = rigs("a2085_04", "lan")
    messenger, recording, group = rig.group()
    _, _, another = rig.group("another")
    last = rig.serials[-1]

    async def hold() -> list[str]:
        for each in (group, another):
            await each.meet(rig.serials)
        other, arm = LiveRobot(messenger, another, recording), LiveRobot(messenger, group, recording)
        await other.hold([last])
        with pytest.raises(Refused, match="another"):
            await arm.hold()
        await group.wait(lambda: False, 1.0)
        states = [rig.state(serial) for serial in rig.serials]
        await arm.close()
        assert [rig.state(serial) for serial in rig.serials] == ["idle"] * 3 + ["armed"]
        await other.close()
        return states

    assert rig.run(hold()) == ["armed"] * 4


def test_the_network_is_left_though_an_agent_has_died(rigs: Callable[..., Any]) -> None:
    rig = rigs("a2085_04", "lan")
    messenger, recording, group = rig.group()

    async def hold() -> None:
        await group.meet(rig.serials)
        arm = LiveRobot(messenger, group, recording)
        await arm.hold()
        rig.kill(rig.serials[0])
        with pytest.raises(NoAnswer, match=f"module {rig.serials[0]} did not answer on lease"):
            await arm.close()

    rig.run(hold())
    assert messenger._closed
    assert [rig.state(serial) for serial in rig.serials[1:]] == ["idle"] * 3

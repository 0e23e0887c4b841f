"""Gains given to modules stay when the lease ends, and links are checked, over the driver too."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest

from coordinator.live_robot.discovery import AS_HUB_S, Search
from coordinator.live_robot.messenger import Sender
from coordinator.live_robot.short_session import ShortSession
from module_agent.model.errors import RobotError
from module_agent.wire.keys import Leaf, parse
from module_agent.wire.messages import GainSet
from sim.virtual_time.network import VirtualEndpoint
from tests.rig import SECRET

ROBOT = "thesis_171_horizontal"
SERIALS = ("X-00010", "X-00009")
ANY = Search()


def softer(present: Sequence[GainSet]) -> list[GainSet]:
    return [
        own.model_copy(update={"position": own.position.model_copy(update={"kp": 0.25 * (k + 1)})})
        for k, own in enumerate(present)
    ]


def session(rig: Any, serials: Sequence[str] = (), search: Search = ANY) -> ShortSession:
    clock = rig.endpoint("tester"), ROBOT, lambda: rig.loop.now_ns, rig.loop.call_soon
    return ShortSession(*clock, Sender("tester", SECRET), search, serials)


@pytest.mark.parametrize("rate_hz", [None, 250.0], ids=["direct", "driver"])
def test_gains_go_to_the_modules_in_the_order_of_the_file_and_stay(
    rigs: Callable[..., Any], rate_hz: float | None
) -> None:
    rig = rigs(ROBOT, "lan", hebi_rate_hz=rate_hz)
    loaded = rig.run(session(rig, SERIALS).load_gains(softer))
    assert loaded == SERIALS
    for number, serial in enumerate(SERIALS, start=1):
        (module,) = rig.hosts[serial].modules
        assert module.firmware.state == "idle"
        assert module.firmware.lease.holder is None
        (told,) = rig.hosts[serial]._hardware.information
        assert told.gains.position.kp == 0.25 * number
        if rig.hebi is not None:
            assert rig.hebi.named("simulated", [serial])[0].gains.position.kp == 0.25 * number


def test_a_module_that_is_not_there_is_named_with_those_that_are(rigs: Callable[..., Any]) -> None:
    rig = rigs(ROBOT, "lan")
    with pytest.raises(RobotError, match=r"^X-1 of robot .* is missing; there are X-00009, X-00010"):
        rig.run(session(rig, ("X-1", "X-00010")).load_gains(softer))
    with pytest.raises(
        RobotError, match=r"^modules of robot .* are missing, 3 are expected; there are X-00009"
    ):
        rig.run(session(rig, ("X-00010",), Search(expect=3)).load_gains(softer))


@pytest.mark.parametrize("named", [(), ("X-00010",)], ids=["all", "named"])
def test_a_module_that_comes_while_agents_look_for_their_hub_is_waited_for(
    rigs: Callable[..., Any], named: tuple[str, ...]
) -> None:
    rig = rigs(ROBOT, "lan")
    rig.kill("X-00010")
    rig.at(1.4, lambda: rig.boot("X-00010"))
    found = rig.run(session(rig, named, Search(min_s=AS_HUB_S)).load_gains(softer))
    assert found == (named or ("X-00009", "X-00010"))


def test_a_module_that_answers_and_sends_no_feedback_is_named(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    publish = VirtualEndpoint.publish

    def mute(self: VirtualEndpoint, key: str, payload: bytes) -> None:
        if parse(key)[1:] != ("X-00010", Leaf.FEEDBACK):
            publish(self, key, payload)

    monkeypatch.setattr(VirtualEndpoint, "publish", mute)
    rig = rigs(ROBOT, "lan")
    with pytest.raises(RobotError, match="no feedback comes from X-00010, which answers"):
        rig.run(session(rig).check_link(1.0, lambda note: None))


@pytest.mark.parametrize("rate_hz", [None, 250.0], ids=["direct", "driver"])
def test_a_link_is_checked_without_a_lease(rigs: Callable[..., Any], rate_hz: float | None) -> None:
    rig = rigs(ROBOT, "lan", hebi_rate_hz=rate_hz)
    told: list[str] = []
    rig.run(session(rig).check_link(1.0, told.append))
    assert [line.split()[0] for line in told] == sorted(SERIALS)
    # 250 rows a second in batches of 5.
    assert all(245.0 <= float(line.split()[2]) <= 255.0 for line in told), told
    assert all(rig.state(serial) == "idle" for serial in SERIALS)

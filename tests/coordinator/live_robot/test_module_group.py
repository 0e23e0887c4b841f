"""Leases, keep-alives and motions on simulated modules, over networks that lose, and modules that vanish."""

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from coordinator.live_robot.commander import KEEP_ALIVE_S, POLL_S
from coordinator.live_robot.errors import ModuleLost, MotionInterrupted
from coordinator.live_robot.messenger import Messenger, NoAnswer, Refused
from coordinator.live_robot.module_group import ModuleGroup
from module_agent.control.motion import effort_profile
from module_agent.network_emulation.profile import NetworkProfile
from module_agent.transport.transport import TransportError
from module_agent.wire.codec import decode
from module_agent.wire.keys import Leaf, parse
from module_agent.wire.messages import (
    Ack,
    ConstantMotion,
    GoTo,
    LeaseRequest,
    Message,
    MotionCommand,
    Rest,
    Setpoint,
)
from tests.rig import SECRET, silent

ARM = "thesis_171_horizontal"
BASE, TIP = "X-00009", "X-00010"
# Sixteen modules.
MANY = "snake16"
# With 30 ms a way in the mean and long tails, the default of 250 ms expires every few seconds.
PATIENT_NS = 500_000_000
SLOW = GoTo(target_rad=1.0, max_speed_rad_s=0.6)


async def _met(group: ModuleGroup, *serials: str) -> None:
    await asyncio.sleep(0.1)
    await group.meet(serials or (BASE, TIP))


async def _armed(group: ModuleGroup, *serials: str) -> None:
    await _met(group, *serials)
    await group.acquire_all()


def test_a_motion_runs_on_the_module_and_its_record_and_rows_come_back(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, recording, group = rig.group()

    async def work() -> None:
        await _armed(group)
        there = await group.run({BASE: GoTo(target_rad=0.4, max_speed_rad_s=0.8)})
        both = await group.run(
            {BASE: ConstantMotion(velocity_rad_s=0.5, duration_s=0.3), TIP: Rest(duration_s=0.2)}
        )
        await group.complete_rows()
        assert list(both) == [BASE, TIP]
        for serial, record in {**there, **both}.items():
            assert record.outcome == "done"
            rows = recording.rows(serial, record.start_row, record.end_row)
            assert len(rows) == record.end_row - record.start_row
            assert set(rows["motion_id"].tolist()) == {record.motion_id}
        await group.release_all()

    rig.run(work())
    assert [rig.state(s) for s in rig.serials] == ["idle", "idle"]


def test_an_expiry_before_the_lease_does_not_end_the_first_motion_under_it(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, recording, group = rig.group()

    async def work() -> None:
        await _armed(group)
        for target in (0.1, 0.0, 0.1, 0.0):
            module = recording.modules[TIP]
            assert module.status is not None
            # What has arrived when the motion begins: the answer to the lease was lost, or is late.
            module.status = module.status.model_copy(update={"state": "expired", "motion": None, "t_ns": 1})
            done = await group.run({TIP: GoTo(target_rad=target, max_speed_rad_s=0.8)})
            assert done[TIP].outcome == "done"
        await group.release_all()

    rig.run(work())


def test_a_module_that_booted_anew_or_twice_and_tells_no_type_is_described_as_such(
    rigs: Callable[..., Any],
) -> None:
    rig = rigs(ARM, "none")
    _, recording, group = rig.group()

    async def work() -> None:
        await _met(group)

    rig.run(work())
    assert group.info(BASE).serial == BASE
    recording.module(BASE, recording.modules[BASE].boot + 1)
    with pytest.raises(NoAnswer, match="not told its type since it booted anew, or a second module has its"):
        group.info(BASE)


@pytest.mark.parametrize("seed", range(4))
def test_on_a_bad_network_every_motion_is_done_and_every_row_arrives(
    rigs: Callable[..., Any], seed: int
) -> None:
    rig = rigs(ARM, "bad", seed, lifetime_ns=PATIENT_NS)
    _, recording, group = rig.group()
    interrupted = 0

    async def work() -> dict[str, int]:
        nonlocal interrupted
        await _armed(group)
        for target in (0.3, 0.0, 0.3, 0.0):
            for _ in range(5):
                try:
                    await group.run({BASE: GoTo(target_rad=target, max_speed_rad_s=0.8)})
                    break
                except MotionInterrupted:
                    interrupted += 1
                    await group.acquire_all()
        end_rows = {serial: recording.modules[serial].rows.end_row for serial in group.serials}
        await group.complete_rows()
        await group.release_all()
        return end_rows

    for serial, end in rig.run(work()).items():
        rows = recording.modules[serial].rows
        assert rows.missing(rows.first_row, end) == []
        assert (np.diff(rows.rows(rows.first_row, end)["t_ns"]) > 0).all()
    assert interrupted == 0
    assert abs(rig.world.plant.q_rad[0]) < 0.05


def test_duplicated_messages_have_no_second_effect(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, NetworkProfile(name="echo", delay_ms=2.0, jitter_ms=5.0, duplicate=1.0))
    _, recording, group = rig.group()

    async def work() -> None:
        await _armed(group)
        for target in (0.3, 0.0):
            assert (await group.run({BASE: GoTo(target_rad=target, max_speed_rad_s=0.8)}))[
                BASE
            ].outcome == "done"
        await group.set_gains(BASE, group.info(BASE).gains)
        assert recording.modules[BASE].status.token == 1
        await group.release_all()

    rig.run(work())


def test_a_second_commander_is_refused_with_holder_and_time_left(
    rigs: Callable[..., Any],
) -> None:
    rig = rigs(ARM, "lan")
    _, _, first = rig.group("first")
    _, _, second = rig.group("second")

    async def work() -> None:
        await _armed(first)
        await _met(second)
        with pytest.raises(Refused, match=r"refused lease: held: held by first for another \d\.\d\d s"):
            await second.acquire(BASE)
        with pytest.raises(Refused, match="held by first, not by second"):
            await second.run({BASE: SLOW})
        # Once the first has died, the second gets it.
        with silent(first):
            await asyncio.sleep(1.2)
            await second.acquire(BASE)
            with pytest.raises(MotionInterrupted):
                await first.run({TIP: SLOW})

    rig.run(work())


def test_a_holder_whose_lease_is_taken_notices(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    _, _, first = rig.group("first")
    _, _, second = rig.group("second")

    async def work() -> None:
        await _armed(first)
        await _met(second)
        with silent(first):
            await asyncio.sleep(1.1)
            await second.acquire(BASE)
        with pytest.raises(ModuleLost, match=f"module {BASE} is lost: its lease was taken: held by second"):
            await first.wait(lambda: False, 1.0)

    rig.run(work())


def test_of_many_modules_eight_in_turn_answer_a_keep_alive_and_all_stay_held(
    rigs: Callable[..., Any],
) -> None:
    said: dict[tuple[str, str], int] = {}

    def tap(_now_ns: int, endpoint: str, kind: str, at: str, _payload: bytes) -> None:
        if endpoint == "tester" and parse(at).leaf is Leaf.LEASE:
            said[parse(at).serial, kind] = said.get((parse(at).serial, kind), 0) + 1

    rig = rigs(MANY, "lossy", tap=tap)
    _, _, group = rig.group()

    async def work() -> None:
        await _met(group, *rig.serials)
        await group.acquire_all()
        await asyncio.sleep(0.5)
        said.clear()
        await group.wait(lambda: False, 50 * KEEP_ALIVE_S)
        assert {rig.state(serial) for serial in rig.serials} == {"armed"}

    rig.run(work())
    # Half of sixteen are asked each time; a lossy network is poor, so that all are renewed twice as often.
    for kind in ("request", "sample"):
        each = [said[serial, kind] for serial in rig.serials]
        assert max(each) - min(each) <= 1
        assert 24 <= min(each) <= 51


def test_on_a_poor_network_each_of_many_running_motions_is_commanded_again_and_its_lease_answered(
    rigs: Callable[..., Any],
) -> None:
    said: dict[tuple[str, Leaf], int] = {}

    def tap(_now_ns: int, endpoint: str, kind: str, at: str, _payload: bytes) -> None:
        if (endpoint, kind) == ("tester", "request"):
            said[parse(at).serial, parse(at).leaf] = said.get((parse(at).serial, parse(at).leaf), 0) + 1

    rig = rigs(MANY, "lossy", tap=tap)
    _, _, group = rig.group()

    async def work() -> None:
        await _met(group, *rig.serials)
        await group.acquire_all()
        await group.wait(lambda: group.is_poor, 5.0)
        running = asyncio.create_task(group.run(dict.fromkeys(rig.serials, Rest(duration_s=3.0))))
        await asyncio.sleep(0.5)
        said.clear()
        await asyncio.sleep(2.0)
        assert group.is_poor
        again = dict(said)
        await running
        # In two seconds 33 keep-alives, of which every second asks.
        for serial in rig.serials:
            assert again[serial, Leaf.MOTION] >= 15
            assert again[serial, Leaf.LEASE] >= 15

    rig.run(work())


def test_of_many_modules_too_a_lease_that_is_taken_is_noticed(rigs: Callable[..., Any]) -> None:
    """At the latest when the module's turn to answer comes."""
    rig = rigs(MANY)
    _, _, first = rig.group("first")
    _, _, second = rig.group("second")

    async def work() -> None:
        for group in (first, second):
            await _met(group, *rig.serials)
        await first.acquire_all()
        taken = rig.serials[-1]
        with silent(first):
            await asyncio.sleep(1.1)
            await second.acquire(taken)
        with pytest.raises(ModuleLost, match=f"module {taken} is lost: its lease was taken: held by second"):
            await first.wait(lambda: False, 2 * KEEP_ALIVE_S + POLL_S)

    rig.run(work())


def test_a_module_whose_lease_was_taken_once_can_be_held_again(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    _, _, first = rig.group("first")
    _, _, second = rig.group("second")

    async def work() -> None:
        await _armed(first, BASE)
        await _met(second, BASE)
        with silent(first):
            await asyncio.sleep(1.1)
            await second.acquire(BASE)
        with pytest.raises(ModuleLost, match="its lease was taken"):
            await first.wait(lambda: False, 1.0)
        await second.release_all()
        await first.acquire(BASE)
        await first.run({BASE: Rest(duration_s=0.3)})
        assert await first.stop_all("for the test") == []
        assert rig.state(BASE) == "stopped"

    rig.run(work())


def test_a_module_that_another_holds_now_is_not_stopped_with_the_others(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    _, _, first = rig.group("first")
    _, _, second = rig.group("second")

    async def work() -> None:
        await _armed(first)
        await _met(second)
        with silent(first):
            await asyncio.sleep(1.1)
            await second.acquire(BASE)
            with pytest.raises(Refused, match="held by second"):
                await first.acquire(BASE)
        assert await first.stop_all("for the test") == []
        assert [rig.state(serial) for serial in (BASE, TIP)] == ["armed", "stopped"]

    rig.run(work())


def test_a_module_that_could_not_be_released_is_not_kept_armed_with_the_next_that_is_taken(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rigs(ARM)
    messenger, _, group = rig.group()

    async def command(serial: str, leaf: Leaf, message: Message, *how: Any) -> Ack:
        if serial == TIP and isinstance(message, LeaseRequest) and message.action == "release":
            raise NoAnswer(serial, leaf, "Timeout")
        return await Messenger.command(messenger, serial, leaf, message, *how)

    monkeypatch.setattr(messenger, "command", command)

    async def work() -> None:
        await _armed(group)
        with pytest.raises(NoAnswer):
            await group.release_all()
        await group.acquire(BASE)
        await asyncio.sleep(0.5)
        assert [rig.state(serial) for serial in (BASE, TIP)] == ["armed", "expired"]
        # But it is this sender's to stop.
        assert await group.stop_all("for the test") == []
        assert [rig.state(serial) for serial in (BASE, TIP)] == ["stopped", "stopped"]

    rig.run(work())


def test_an_error_that_ended_the_keep_alives_is_raised_and_keeps_no_module_from_being_stopped(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rigs(ARM)
    _, _, group = rig.group()

    def broken(**_how: Any) -> None:
        raise ZeroDivisionError

    async def work() -> None:
        await _armed(group)
        monkeypatch.setattr(group.commander, "renew", broken)
        with pytest.raises(ZeroDivisionError):
            await group.wait(lambda: False, 1.0)
        rig.freeze(TIP)
        assert await group.stop_all("for the test") == [TIP]
        assert rig.state(BASE) == "stopped"

    rig.run(work())


def test_every_module_is_given_a_secret_of_its_own(rigs: Callable[..., Any]) -> None:
    """Who serves one module's lease key, and so reads its secret, commands no other in the holder's name."""
    given: dict[str, set[bytes]] = {BASE: set(), TIP: set()}

    def tap(_now_ns: int, _endpoint: str, kind: str, at: str, payload: bytes) -> None:
        if kind == "request" and parse(at).leaf is Leaf.LEASE:
            given[parse(at).serial].add(decode(LeaseRequest, payload).secret)

    rig = rigs(ARM, tap=tap)
    _, _, group = rig.group()

    async def work() -> None:
        await _armed(group)
        await group.run({BASE: Rest(duration_s=0.2)})

    rig.run(work())
    # Renewals have none, but the proof.
    base, tip = (given[serial] - {b""} for serial in (BASE, TIP))
    assert (len(base), len(tip)) == (1, 1)
    assert base != tip
    assert SECRET not in base | tip


def test_one_renewal_that_cannot_be_sent_does_not_end_those_of_the_others(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rigs(MANY)
    messenger, _, group = rig.group()
    publish, failed = messenger.publish, []

    def failing(serial: str, leaf: Leaf, *rest: Any) -> None:
        if not failed:
            failed.append(serial)
            raise TransportError("for the test")
        publish(serial, leaf, *rest)

    monkeypatch.setattr(messenger, "publish", failing)

    async def work() -> None:
        await _met(group, *rig.serials)
        await group.acquire_all()
        await asyncio.sleep(1.0)
        assert failed
        assert {rig.state(serial) for serial in rig.serials} == {"armed"}

    rig.run(work())


def test_a_motion_may_take_as_long_as_from_where_the_joint_stands(rigs: Callable[..., Any]) -> None:
    """The status of the motion before it, which begins elsewhere, is the latest when it is acknowledged."""
    rig = rigs(ARM, "lan")
    _, _, group = rig.group()

    async def work() -> None:
        await _armed(group)
        for target_rad, speed_rad_s in ((1.2, 1.5), (0.0, 1.5), (1.2, 0.3)):
            there = await group.run({BASE: GoTo(target_rad=target_rad, max_speed_rad_s=speed_rad_s)})
            assert there[BASE].outcome == "done"

    rig.run(work())


def test_a_killed_agent_is_noticed_a_third_of_a_second_after_its_token(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, _, group = rig.group()

    async def work() -> int:
        await _armed(group)
        rig.kill(TIP)
        killed = rig.loop.now_ns
        with pytest.raises(ModuleLost, match=f"module {TIP} is lost: its agent has left the network"):
            await group.run({BASE: SLOW})
        return int(rig.loop.now_ns - killed)

    # 300 ms that a token may be gone (a router restarts), one poll, one batch of feedback.
    assert 280e6 < rig.run(work()) < 360e6


def test_a_question_to_an_agent_that_has_just_died_names_the_module_as_lost(
    rigs: Callable[..., Any],
) -> None:
    """The network says at once, to every attempt, that none answers; its silence takes longer to tell."""
    rig = rigs(ARM)
    _, _, group = rig.group()

    async def work() -> None:
        await _met(group)
        rig.kill(TIP)
        with pytest.raises(ModuleLost, match=f"module {TIP} is lost: its agent has left the network"):
            await group.ask_status(TIP)

    rig.run(work())


def test_a_question_that_a_module_refuses_is_answered_with_its_reason(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rigs(ARM)
    messenger, _, group = rig.group()

    async def refuse(serial: str, leaf: Leaf, message: Message, *how: Any) -> Ack:
        head = {"serial": serial, "boot": 1, "seq": 1, "re": message.seq, "t_ns": 1}
        why = {"accepted": False, "reason": "wrong_serial", "detail": "this is Y"}
        return Ack.model_validate(head | why | {"holder": None, "lease_left_ns": 0, "token": 0})

    async def work() -> None:
        await _met(group)
        monkeypatch.setattr(messenger, "ask", refuse)
        with pytest.raises(NoAnswer, match=f"{TIP}.*it refuses: wrong_serial: this is Y"):
            await group.ask_status(TIP)

    rig.run(work())


def test_a_frozen_agent_is_noticed_by_its_missing_feedback(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, _, group = rig.group()

    async def work() -> int:
        await _armed(group)
        rig.freeze(TIP)
        frozen = rig.loop.now_ns
        with pytest.raises(ModuleLost, match=rf"module {TIP} is lost: no feedback for 1\.\d s"):
            await group.run({BASE: SLOW})
        return int(rig.loop.now_ns - frozen)

    assert 0.9e9 < rig.run(work()) < 1.1e9


def test_an_agent_that_boots_anew_is_another_module(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, recording, group = rig.group()

    async def work() -> None:
        await _armed(group)
        rig.kill(TIP)
        rig.boot(TIP)
        with pytest.raises(ModuleLost, match=f"module {TIP} is lost: it has booted anew"):
            await group.run({BASE: SLOW})

    rig.run(work())
    assert [boot for serial, boot in recording.past if serial == TIP] == [102, 103]


def test_commands_to_a_module_that_is_not_there_end_in_a_named_error(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    _, _, group = rig.group()

    async def work() -> None:
        with pytest.raises(NoAnswer, match="module X-99999 did not answer on info"):
            await group.meet(["X-99999"])

    rig.run(work())


def test_a_motion_is_not_started_unarmed(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    _, _, group = rig.group()

    async def work() -> None:
        await _met(group)
        with pytest.raises(MotionInterrupted, match=r"refused: .* holds no lease: acquire it first"):
            await group.run({BASE: SLOW})

    rig.run(work())


def test_a_permanent_refusal_is_raised_at_once(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, recording, group = rig.group()

    async def work() -> None:
        await _armed(group)
        running = asyncio.create_task(group.run({BASE: SLOW}))
        await asyncio.sleep(0.5)
        with pytest.raises(Refused, match=r"refused motion: busy: motion .* is running"):
            await group.run({BASE: Rest(duration_s=0.1)})
        # The motion that runs is none the worse for it.
        assert (await running)[BASE].outcome == "done"
        assert recording.modules[BASE].status.refusals == {"busy": 1}

    rig.run(work())


def test_without_keep_alives_a_motion_expires_and_can_be_done_again(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, _, group = rig.group()

    async def work() -> None:
        await _armed(group)
        # Either may expire first, by the age of its last feedback.
        other = f"interrupted: module {TIP} expired and released its joint"
        why = f"the motion of module {BASE} was (expired|{other})"
        with silent(group):
            with pytest.raises(MotionInterrupted, match=why):
                await group.run({BASE: SLOW})
            await asyncio.sleep(0.05)
            with pytest.raises(MotionInterrupted, match=r"refused: .*; it says: no fresh command for 250 ms"):
                await group.run({BASE: SLOW})
        assert rig.state(BASE) == "expired"
        await group.acquire_all()
        assert (await group.run({BASE: SLOW}))[BASE].outcome == "done"

    rig.run(work())
    assert rig.world.plant.q_rad[0] == pytest.approx(1.0, abs=0.05)


def test_a_motion_that_began_and_expired_while_its_answer_was_lost_can_be_done_again(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rigs(ARM, "lan")
    messenger, recording, group = rig.group()
    lost: list[Ack] = []

    async def command(serial: str, leaf: Leaf, message: Message, *how: Any) -> Ack:
        ack = await Messenger.command(messenger, serial, leaf, message, *how)
        if leaf is Leaf.MOTION and not lost:
            lost.append(ack)
            # The answer is lost, and for longer than a command lives so are the keep-alives.
            rig.cut = True
            await asyncio.sleep(0.4)
            rig.cut = False
            raise NoAnswer(serial, leaf, "Timeout")
        return ack

    monkeypatch.setattr(messenger, "command", command)

    async def work() -> None:
        await _armed(group)
        with pytest.raises(MotionInterrupted, match="was expired: use a new number"):
            await group.run({BASE: SLOW})
        await group.acquire_all()
        assert (await group.run({BASE: SLOW}))[BASE].outcome == "done"

    rig.run(work())
    assert [ack.accepted for ack in lost] == [True]
    assert recording.modules[BASE].status.expiries == 1


def test_stop_reaches_every_module_and_names_those_that_did_not_confirm(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, _, group = rig.group()

    async def work() -> list[str]:
        await _armed(group)
        rig.freeze(TIP)
        return await group.stop_all("enough")

    assert rig.run(work()) == [TIP]
    assert rig.state(BASE) == "stopped"


def test_no_motion_at_all_is_done_at_once(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    _, _, group = rig.group()

    async def work() -> dict[str, Any]:
        await _armed(group)
        return await group.run({})

    assert rig.run(work()) == {}


@pytest.mark.parametrize("own", [True, False])
def test_set_points_of_another_program_with_the_secret_are_named(rigs: Callable[..., Any], own: bool) -> None:
    rig = rigs(ARM, "lan")
    _, _, group = rig.group()

    async def work() -> None:
        await _armed(group)
        for _ in range(10):
            if own:
                group.stream(BASE, None, 0.2, None)
            else:
                aims = {"position_rad": None, "velocity_rad_s": 0.2, "effort_nm": None}
                group.commander.publish(BASE, Leaf.SETPOINT, group.commander.command(Setpoint, BASE, **aims))
            await asyncio.sleep(0.02)
        group.check()

    if own:
        rig.run(work())
    else:
        with pytest.raises(ModuleLost, match=f"module {BASE} is lost: it follows set-points of another"):
            rig.run(work())


def test_lost_feedback_and_estimates_are_fetched(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "bad", 3, lifetime_ns=PATIENT_NS)
    _, recording, group = rig.group()

    async def work() -> None:
        await _armed(group)
        await asyncio.sleep(1.0)
        rows = recording.modules[BASE].rows
        assert rows.missing(rows.first_row, rows.end_row)  # 5 % are lost: the test would test nothing
        records = await group.run(dict.fromkeys(group.serials, Rest(duration_s=1.0)))
        await group.complete_rows()
        for serial, record in records.items():
            assert (
                len(recording.rows(serial, record.start_row, record.end_row))
                == record.end_row - record.start_row
            )
        moved = await group.run({BASE: ConstantMotion(velocity_rad_s=0.5, duration_s=0.5)})
        estimate = await group.estimate(TIP, BASE, moved[BASE].motion_id, 1.0)
        assert estimate is not None
        assert estimate.moved
        assert await group.estimate(TIP, BASE, 12345, 0.01) is None

    rig.run(work())


def test_motion_numbers_grow_from_one_coordinator_to_the_next(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    _, _, first = rig.group("first")
    _, _, second = rig.group("second")

    async def work() -> None:
        await _armed(first, BASE)
        pattern = Rest(duration_s=0.05)
        mine = [(await first.run({BASE: pattern}))[BASE].motion_id for _ in range(3)]
        await first.release_all()
        await _armed(second, BASE)
        theirs = (await second.run({BASE: pattern}))[BASE].motion_id
        assert mine[0] < mine[1] < mine[2] < theirs

    rig.run(work())


def _commands(monkeypatch: pytest.MonkeyPatch, messenger: Messenger) -> list[MotionCommand]:
    """Return a list that fills with the motion commands that go out."""
    sent: list[MotionCommand] = []

    async def command(serial: str, leaf: Leaf, message: Message, *how: Any) -> Ack:
        if isinstance(message, MotionCommand):
            sent.append(message)
        return await Messenger.command(messenger, serial, leaf, message, *how)

    monkeypatch.setattr(messenger, "command", command)
    return sent


def _fed(recording: Any, record: Any, serial: str) -> np.ndarray:
    """Return the effort commands of a motion's rows, NaN where the effort loop was off."""
    rows = recording.rows(serial, record.start_row, record.end_row)
    return np.asarray(rows["effort_command_nm"], dtype=float)


@pytest.mark.parametrize("network", ["none", NetworkProfile(name="slow", delay_ms=52.0)])
def test_efforts_go_with_the_motion_they_are_for_and_with_no_other(
    rigs: Callable[..., Any], network: str | NetworkProfile
) -> None:
    rig = rigs(ARM, network)
    _, recording, group = rig.group()
    # 0 to 1.2 Nm in 0.6 s, and so until the end of 0.8 s.
    ramp = effort_profile(np.linspace(0.0, 1.2, 61), 10_000_000)
    rest = Rest(duration_s=0.8)

    async def work() -> None:
        await _met(group)
        await group.acquire_all()
        both = await group.run({BASE: rest, TIP: rest}, {BASE: ramp})
        after = await group.run({BASE: rest, TIP: rest})
        await group.complete_rows()
        t_s = 4e-3 * np.arange(len(_fed(recording, both[BASE], BASE)))
        # A row tells of the last tick before it.
        wanted = np.minimum(2.0 * t_s, 1.2)
        np.testing.assert_allclose(_fed(recording, both[BASE], BASE)[1:], wanted[1:], atol=2.0 * 4e-3)
        for record, serial in ((both[TIP], TIP), (after[BASE], BASE), (after[TIP], TIP)):
            assert np.isnan(_fed(recording, record, serial)[1:]).all()
        await group.release_all()

    rig.run(work())


def test_efforts_for_a_module_without_a_motion_are_refused_before_anything_moves(
    rigs: Callable[..., Any],
) -> None:
    rig = rigs(ARM)
    _, _, group = rig.group()

    async def work() -> None:
        await _armed(group)
        with pytest.raises(
            KeyError, match=f"efforts for {TIP}, which has no motion; of those that have one: {BASE}"
        ):
            await group.run({BASE: SLOW}, {TIP: effort_profile([0.0, 1.0], 10_000_000)})
        await group.release_all()

    rig.run(work())
    assert abs(rig.world.plant.q_rad[0]) < 1e-2


@pytest.mark.parametrize(("delay_ms", "is_poor"), [(5.0, False), (52.0, True)])
def test_with_slow_renewals_motions_are_commanded_again_and_run_once(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, delay_ms: float, is_poor: bool
) -> None:
    rig = rigs(ARM, NetworkProfile(name="slow", delay_ms=delay_ms))
    messenger, recording, group = rig.group()
    sent = _commands(monkeypatch, messenger)

    async def work() -> None:
        await _met(group)
        await group.acquire_all()
        record = (await group.run({BASE: SLOW}))[BASE]
        assert record.outcome == "done"
        assert group.is_poor == is_poor
        assert {command.motion_id for command in sent} == {record.motion_id}
        assert (len(sent) > 1) == is_poor
        # Newer than each other, as renewals are: a copy that is late has no say.
        assert [command.seq for command in sent] == sorted({command.seq for command in sent})
        await group.complete_rows()

    rig.run(work())
    moved = recording.modules[BASE].rows.rows(0, recording.modules[BASE].rows.end_row)["motion_id"]
    # It begins once, and ends once.
    assert np.count_nonzero(np.diff((moved > 0).astype(int)) > 0) == 1


def test_a_motion_during_which_another_joint_expires_is_interrupted(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rigs(ARM, "lan")
    messenger, _, group = rig.group()

    async def command(serial: str, leaf: Leaf, message: Message, *how: Any) -> Ack:
        if serial == TIP and leaf is Leaf.LEASE and rig.state(BASE) == "moving":
            await asyncio.sleep(0.1)
            raise NoAnswer(serial, leaf, "Timeout")
        return await Messenger.command(messenger, serial, leaf, message, *how)

    monkeypatch.setattr(messenger, "command", command)

    async def work() -> None:
        await _armed(group)
        why = f"the motion of module {BASE} was interrupted: module {TIP} expired and released its joint"
        with pytest.raises(MotionInterrupted, match=why):
            await group.run({BASE: SLOW})
        # Armed again, both move as before.
        await group.acquire_all()

    rig.run(work())


def test_many_gaps_of_all_modules_are_fetched_concurrently(rigs: Callable[..., Any]) -> None:
    """One after the other 40 holes at 60 ms a round trip would take the longer half of a motion."""
    rig = rigs(ARM, NetworkProfile(name="far", delay_ms=30.0))
    _, recording, group = rig.group()

    async def work() -> float:
        await _armed(group)
        await group.complete_rows()
        for _ in range(20):
            rig.cut = True
            await asyncio.sleep(0.02)
            rig.cut = False
            await asyncio.sleep(0.06)
        begun_s = rig.loop.time()
        await group.complete_rows()
        return rig.loop.time() - begun_s

    taken_s = rig.run(work())
    for serial in group.serials:
        log = recording.modules[serial].rows
        assert log.missing(0, log.end_row - 50) == [] or log.first_row > 0
    # A question for the status and at most six rounds of eight holes, each within 80 ms by the ticks.
    assert taken_s < 0.08 * 7

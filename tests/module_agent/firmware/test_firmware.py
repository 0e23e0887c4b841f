"""A module obeys one holder, refuses what is late or wrong and says so, and never moves on its own."""

import itertools
import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.control.motion import effort_profile
from module_agent.control.safety import Safety
from module_agent.firmware.admission import Lease
from module_agent.firmware.config import FirmwareConfig, check_config, config_of
from module_agent.firmware.firmware import Firmware, Incoming, Publication, acknowledgement
from module_agent.firmware.state import COMMANDED, TRANSITIONS
from module_agent.firmware.tick_kernel import BRAKE, FOLLOW, MOTION
from module_agent.hardware.hardware import ModuleInformation, SensorSample
from module_agent.model.catalogue import CATALOGUE
from module_agent.model.errors import UsageError
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.feedback_rows import STATE_NAMES, unpack
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import (
    Ack,
    Ask,
    ConstantMotion,
    Feedback,
    GainsCommand,
    GoTo,
    HistoryRequest,
    Identify,
    Info,
    LeaseRequest,
    Message,
    MotionCommand,
    Rest,
    Setpoint,
    Status,
    Stop,
)
from module_agent.wire.proof import proven
from module_agent.wire.refusal import Refusal, WireError
from tests.module_agent.firmware_bench import BOOT, MS, Bench, refused
from tests.module_agent.wired_firmware import WiredFirmware


def test_without_a_lease_the_motor_is_off() -> None:
    bench = Bench()
    bench.ticks(500)
    assert bench.pwm == 0.0
    assert bench.firmware.state == "idle"


def test_acquiring_arms_and_holds_the_present_position() -> None:
    bench = Bench()
    assert bench.acquire().accepted
    bench.position = 0.1
    bench.tick()
    assert bench.firmware.state == "armed"
    assert bench.pwm > 0.0


def test_a_second_sender_is_refused_with_the_holder_s_name_and_the_time_left() -> None:
    bench = Bench()
    bench.acquire()
    answer = bench.acquire(sender="other")
    assert refused(answer, Refusal.HELD)
    assert "me" in answer.detail
    assert answer.holder == "me"
    assert 0 < answer.lease_left_ns <= 1000 * MS


def test_a_lapsed_lease_goes_to_the_next_sender_under_a_larger_token() -> None:
    bench = Bench()
    first = bench.acquire(duration_ns=300 * MS)
    bench.ticks(400)
    second = bench.acquire(sender="other")
    assert second.accepted
    assert second.token > first.token
    assert refused(bench.move(token=first.token), Refusal.HELD)


def test_an_old_token_of_the_same_sender_is_refused() -> None:
    bench = Bench()
    first = bench.acquire()
    bench.acquire()
    assert refused(bench.move(token=first.token), Refusal.NO_LEASE)


@pytest.mark.parametrize(("action", "pwm_is_zero"), [("motor_off", True), ("hold", False), ("damping", True)])
def test_without_commands_the_expiry_action_runs_one_tick_after_the_lifetime(
    action: str, pwm_is_zero: bool
) -> None:
    bench = Bench(expiry_action=action)
    bench.acquire()
    bench.move(pattern=Rest(duration_s=10.0))
    bench.position = 0.1  # pushed aside, so that holding needs PWM
    # The command echoed the tick before it came: that is what its sender knew.
    bench.ticks(249)
    assert bench.firmware.state == "moving"
    bench.tick()
    assert bench.firmware.state == "expired"
    bench.position = 0.05
    bench.tick()
    assert (bench.pwm == 0.0) == pwm_is_zero
    status = bench.status()
    assert status.motion is not None
    assert status.motion.outcome == "expired"
    assert status.expiries == 1


def test_keep_alives_keep_a_motion_going_and_an_expired_module_needs_re_arming() -> None:
    bench = Bench()
    bench.acquire()
    bench.move(pattern=Rest(duration_s=10.0))
    for _ in range(20):
        bench.ticks(99)
        assert bench.renew().accepted
    assert bench.firmware.state == "moving"
    bench.ticks(300)
    assert bench.firmware.state == "expired"
    assert bench.renew().accepted
    bench.tick()
    assert bench.firmware.state == "expired"
    assert refused(bench.move(2), Refusal.NOT_ARMED)
    assert bench.acquire().accepted
    assert bench.move(3).accepted


def test_the_expiry_refuses_before_commands_of_the_same_tick_are_read() -> None:
    """A thawed module finds its whole backlog in one tick; none of it may move the motor."""
    bench = Bench()
    bench.acquire()
    before = bench.now
    backlog = [
        Incoming(
            Leaf.SETPOINT,
            encode(
                Setpoint(**bench.head(echo_ns=before, position_rad=2.0, velocity_rad_s=None, effort_nm=None))
            ),
            None,
        )
        for _ in range(668)
    ]
    bench.now += 3_000 * MS
    bench.tick(*backlog)
    assert bench.firmware.state == "expired"
    assert bench.pwm == 0.0
    assert bench.firmware.admission.refusals[Refusal.NO_LEASE.value] == 668


def test_a_late_command_is_refused_by_the_time_it_echoes() -> None:
    bench = Bench()
    bench.acquire()
    assert refused(bench.move(echo_ns=bench.now - 251 * MS), Refusal.STALE)
    assert bench.firmware.state == "armed"
    assert bench.move(2, echo_ns=bench.now - 200 * MS).accepted


def test_a_command_that_echoes_the_future_is_refused() -> None:
    bench = Bench()
    bench.acquire()
    assert refused(bench.move(echo_ns=bench.now + 5_000 * MS), Refusal.STALE)


def test_a_replayed_command_is_refused_by_its_sequence() -> None:
    bench = Bench()
    bench.acquire()
    old = encode(Setpoint(**bench.head(position_rad=0.3, velocity_rad_s=None, effort_nm=None)))
    assert bench.ask(Leaf.SETPOINT, old).accepted
    assert refused(bench.ask(Leaf.SETPOINT, old), Refusal.SEQUENCE)


def test_a_keep_alive_that_overtakes_a_motion_does_not_refuse_it() -> None:
    bench = Bench()
    bench.acquire()
    motion = MotionCommand(**bench.head(motion_id=1, pattern=Rest(duration_s=1.0)))
    assert bench.renew().accepted
    assert bench.ask(Leaf.MOTION, motion).accepted


def test_the_same_motion_twice_is_one_motion() -> None:
    bench = Bench()
    bench.acquire()
    assert bench.move(5).accepted
    row = bench.status().motion
    assert bench.move(5).accepted
    again = bench.status().motion
    assert row is not None
    assert again is not None
    assert again.start_row == row.start_row
    assert refused(bench.move(6), Refusal.BUSY)


def test_a_motion_that_is_done_is_not_run_again_by_its_copy() -> None:
    bench = Bench()
    bench.acquire()
    assert bench.move(5, Rest(duration_s=0.05)).accepted
    bench.ticks(60)
    done = bench.status().motion
    assert bench.move(5, Rest(duration_s=0.05)).accepted
    assert bench.firmware.state == "armed"
    assert bench.status().motion == done
    assert done is not None
    assert done.outcome == "done"


def test_a_motion_begins_where_the_joint_is_held_and_not_where_it_is_pushed_to() -> None:
    bench = Bench()
    bench.acquire()
    bench.position = 0.15
    bench.move(1, Rest(duration_s=0.01))
    motion = bench.status().motion
    assert motion is not None
    assert motion.origin_rad == 0.2


def test_a_motion_begins_where_the_joint_is_when_no_position_is_held() -> None:
    bench = Bench()
    bench.acquire()
    bench.setpoint(None, velocity_rad_s=0.1)
    bench.position = 0.15
    bench.move(1, Rest(duration_s=0.01))
    motion = bench.status().motion
    assert motion is not None
    assert motion.origin_rad == 0.15


def test_a_setpoint_does_not_disturb_a_motion() -> None:
    bench = Bench()
    bench.acquire()
    bench.move(1, Rest(duration_s=1.0))
    answer = bench.setpoint()
    assert refused(answer, Refusal.BUSY)
    assert "setpoints are taken when it has ended" in answer.detail
    assert bench.firmware.state == "moving"


def test_a_stream_of_setpoints_is_no_stream_of_statuses() -> None:
    """A status comes with every change of state, and 2.5 times a second."""
    bench = Bench()
    bench.acquire()
    bench.setpoint()
    bench.tick()
    bench.published.clear()
    for _ in range(100):
        bench.setpoint()
    assert [o.leaf for o in bench.published].count(Leaf.STATUS) <= 1


def test_every_expiry_is_counted_and_said() -> None:
    bench = Bench()
    for count in (1, 2):
        bench.acquire()
        bench.ticks(255)
        status = bench.status()
        assert (status.state, status.expiries) == ("expired", count)
        assert status.note == "no fresh command for 250 ms"


def test_a_clock_that_goes_back_is_said_and_is_no_expiry_of_an_idle_module() -> None:
    bench = Bench()
    bench.acquire()
    bench.now -= 701 * MS
    bench.tick()
    assert bench.status().note == "the module's clock went back by 700 ms"
    idle = Bench()
    idle.now -= 701 * MS
    idle.tick()
    assert (idle.firmware.state, idle.status().expiries) == ("idle", 0)


def test_a_command_for_another_boot_or_module_is_refused() -> None:
    bench = Bench()
    assert refused(bench.acquire(boot=BOOT + 1), Refusal.WRONG_BOOT)
    assert refused(bench.acquire(serial="B"), Refusal.WRONG_SERIAL)


def test_stop_needs_no_lease_and_holds_until_the_lease_is_acquired() -> None:
    bench = Bench()
    bench.acquire()
    bench.move()
    stop = Stop(serial="A", boot=0, seq=1, sender="anybody", why="test")
    assert bench.ask(Leaf.STOP, stop).accepted
    assert bench.firmware.state == "stopped"
    bench.ticks(1000)
    assert bench.firmware.state == "stopped"
    assert refused(bench.setpoint(), Refusal.NO_LEASE) or bench.firmware.state == "stopped"
    assert bench.acquire().accepted
    assert bench.firmware.state == "armed"


def test_release_turns_the_motor_off() -> None:
    bench = Bench()
    bench.acquire()
    assert bench.ask(Leaf.LEASE, LeaseRequest(**bench.head(action="release"))).accepted
    bench.tick()
    assert bench.pwm == 0.0
    assert bench.firmware.state == "idle"


def test_release_ends_a_motion_and_says_that_it_was_superseded() -> None:
    bench = Bench()
    bench.acquire()
    bench.move(5)
    assert bench.ask(Leaf.LEASE, LeaseRequest(**bench.head(action="release"))).accepted
    motion = bench.status().motion
    assert motion is not None
    assert (motion.outcome, motion.end_row is not None) == ("superseded", True)


def test_a_motion_beyond_the_position_limits_is_refused_with_both_ranges() -> None:
    bench = Bench(kind="SEA-snake")
    bench.acquire()
    answer = bench.move(pattern=GoTo(target_rad=2.0, max_speed_rad_s=1.0))
    assert refused(answer, Refusal.LIMIT)
    assert "2.000" in answer.detail
    assert "1.5708" in answer.detail
    assert refused(bench.setpoint(1.7), Refusal.LIMIT)


def test_an_overheated_winding_turns_the_motor_off_and_must_cool_before_re_arming() -> None:
    bench = Bench()
    bench.acquire()
    bench.winding_c = 154.5
    bench.tick()
    assert bench.firmware.state == "fault"
    assert bench.pwm == 0.0
    answer = bench.acquire()
    assert refused(answer, Refusal.NOT_ARMED)
    assert "C" in answer.detail
    bench.winding_c = 120.0
    assert bench.acquire().accepted


def test_the_duty_stays_below_the_winding_s_ceiling() -> None:
    """1 - 1/(155 - T), as a real X5-1 log shows: 0.9636 at 127.6 C."""
    bench = Bench()
    bench.acquire()
    bench.winding_c = 127.58
    for _ in range(5):
        bench.setpoint(6.0)
    assert bench.pwm * 48.0 / 24.0 == pytest.approx(0.96353, abs=1e-4)


def test_gains_are_refused_during_a_motion_and_reported_after_a_change() -> None:
    bench = Bench()
    bench.acquire()
    (answer,) = bench.tick(Incoming(Leaf.INFO, encode(Ask(serial="A", boot=0, seq=1, sender="me")), 1))
    gains = decode(Info, answer).gains
    stiff = gains.model_copy(update={"position": gains.position.model_copy(update={"kp": 6.0})})
    assert bench.ask(Leaf.GAINS, GainsCommand(**bench.head(gains=stiff))).accepted
    (answer,) = bench.tick(Incoming(Leaf.INFO, encode(Ask(serial="A", boot=0, seq=1, sender="me")), 1))
    assert decode(Info, answer).gains == stiff
    bench.move()
    assert refused(bench.ask(Leaf.GAINS, GainsCommand(**bench.head(gains=gains))), Refusal.BUSY)


def test_feedback_comes_at_its_rate_without_gaps_and_history_serves_every_row_again() -> None:
    bench = Bench()
    bench.ticks(20)  # rows have fallen into step with the IMU by then
    bench.published.clear()
    first = bench.firmware.history.next_row
    bench.ticks(1000)
    blocks = [
        unpack(decode(Feedback, p.payload, MAX_MESSAGE_BYTES))
        for p in bench.published
        if p.leaf is Leaf.FEEDBACK
    ]
    times = [int(t) for block in blocks for t in block["t_ns"]]
    assert len(times) == pytest.approx(250, abs=5)
    assert {b - a for a, b in pairwise(times)} == {4 * MS}
    request = HistoryRequest(serial="A", boot=BOOT, seq=1, sender="me", first_row=first, end_row=first + 200)
    (answer,) = bench.tick(Incoming(Leaf.HISTORY, encode(request), 1))
    rows = unpack(decode(Feedback, answer, MAX_MESSAGE_BYTES))
    assert len(rows) == 200
    assert set(times[10:150]) <= {int(t) for t in rows["t_ns"]}


def test_a_row_holds_the_sample_and_the_command_field_by_field() -> None:
    kind = CATALOGUE["X5-9"]
    config = FirmwareConfig("A", kind, BOOT, catalogue_limits(kind), feedback_rate_hz=1000.0, batch_rows=1)
    wired = WiredFirmware(config)
    now = 5_000 * MS
    # Every value another one, and all of them exact in four bytes.
    sample = SensorSample(now, now - MS, *(0.25 + 0.5 * n for n in range(6)), 40.0, 24.0, *range(1, 7))  # type: ignore[call-arg]
    head = {"serial": "A", "boot": BOOT, "seq": 1, "sender": "me", "echo_ns": now}
    values = {"position_rad": 0.75, "velocity_rad_s": None, "effort_nm": -0.5}
    acquire, setpoint = LeaseRequest(**head, token=0, action="acquire"), Setpoint(**head, token=1, **values)
    inbox = [Incoming(Leaf.LEASE, encode(acquire), None), Incoming(Leaf.SETPOINT, encode(setpoint), None)]
    pwm, out = wired.tick(sample, inbox)
    (block,) = [o.payload for o in out if isinstance(o, Publication) and o.leaf is Leaf.FEEDBACK]
    (row,) = unpack(decode(Feedback, block, MAX_MESSAGE_BYTES))
    for name in set(SensorSample._fields) & set(row.dtype.names):
        assert row[name] == getattr(sample, name), name
    assert row["gyro_rad_s"].tolist() == [1.0, 2.0, 3.0]
    assert row["accel_m_s2"].tolist() == [4.0, 5.0, 6.0]
    assert (row["position_command_rad"], row["effort_command_nm"]) == (0.75, -0.5)
    assert math.isnan(row["velocity_command_rad_s"])
    assert row["motion_id"] == 0
    assert STATE_NAMES[row["state"]] == "streaming"
    assert pwm != 0.0
    assert row["pwm"] == pytest.approx(pwm * 48.0 / 24.0)


def test_rows_are_taken_when_the_imu_has_a_new_sample() -> None:
    bench = Bench()
    bench.ticks(400)
    history = bench.firmware.history
    rows = history.rows(history.next_row - 50, history.next_row)
    assert (rows["t_ns"] == rows["imu_t_ns"]).all()


def test_rows_that_are_gone_are_refused_with_what_is_kept() -> None:
    bench = Bench(history_s=1.0)
    bench.ticks(3000)
    answer = bench.ask(
        Leaf.HISTORY, HistoryRequest(serial="A", boot=BOOT, seq=1, sender="me", first_row=0, end_row=10)
    )
    assert refused(answer, Refusal.GONE)
    assert str(bench.firmware.history.first_row) in answer.detail


def test_acquiring_again_in_the_middle_of_a_motion_holds_where_it_is() -> None:
    bench = Bench()
    bench.acquire()
    bench.move(pattern=GoTo(target_rad=3.0, max_speed_rad_s=0.5))
    bench.ticks(50)
    assert bench.acquire().accepted
    bench.tick()
    motion = bench.status().motion
    assert motion is not None
    assert motion.outcome == "superseded"
    # 50 ms into a motion of 11 s nothing has moved yet: there is nothing to drive the motor for.
    assert abs(bench.pwm) < 0.01


def test_a_keep_alive_that_was_long_on_the_way_does_not_prolong_the_life_of_a_motion() -> None:
    """The motor may outlive what its commander last knew of it by one lifetime, not by two."""
    bench = Bench()
    bench.acquire()
    bench.move(pattern=Rest(duration_s=10.0))
    sent_ns = bench.now
    bench.ticks(240)
    assert bench.renew(echo_ns=sent_ns).accepted
    bench.ticks(20)
    assert bench.firmware.state == "expired"


def test_a_copy_of_any_acquire_that_was_granted_before_is_refused() -> None:
    bench = Bench()
    first = encode(LeaseRequest(**bench.head(action="acquire")))
    assert bench.ask(Leaf.LEASE, first).accepted
    assert bench.acquire().accepted
    bench.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="anybody"))
    assert refused(bench.ask(Leaf.LEASE, first), Refusal.STALE)
    bench.ticks(5)
    assert refused(bench.ask(Leaf.LEASE, first), Refusal.STALE)
    assert bench.firmware.state == "stopped"


def test_an_acquire_that_was_sent_before_a_stop_does_not_undo_it() -> None:
    bench = Bench()
    bench.acquire()
    early = encode(LeaseRequest(**bench.head(action="acquire")))
    bench.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="anybody"))
    assert refused(bench.ask(Leaf.LEASE, early), Refusal.STALE)
    # What was sensed in the tick of the stop had been sent before it.
    assert refused(bench.acquire(echo_ns=bench.now - MS), Refusal.STALE)
    assert refused(bench.ask(Leaf.LEASE, early), Refusal.STALE)
    bench.ticks(2)
    assert bench.acquire().accepted


def targets(bench: Bench) -> tuple[float, ...]:
    """Return the position, velocity and effort that the module follows."""
    return bench.firmware.quiet_state().targets


@pytest.mark.parametrize("is_moving", [False, True])
def test_acquiring_again_holds_what_was_held_and_not_where_the_joint_is_pushed_to(is_moving: bool) -> None:
    bench = Bench()
    bench.acquire()
    assert targets(bench) == (0.2, 0.0, pytest.approx(math.nan, nan_ok=True))
    if is_moving:
        bench.move(pattern=GoTo(target_rad=0.8, max_speed_rad_s=1.0))
        bench.ticks(200)
    before = targets(bench)
    bench.position = 0.15
    assert bench.acquire().accepted
    assert targets(bench) == (before[0], 0.0, pytest.approx(math.nan, nan_ok=True))
    assert (before[0] > 0.21) is is_moving


def test_a_motion_that_is_done_holds_its_end_and_its_last_effort() -> None:
    bench = Bench()
    bench.acquire()
    efforts = effort_profile([0.5, 1.0, 1.5], 20 * MS)
    assert bench.move(pattern=Rest(duration_s=0.04), effort=efforts).accepted
    bench.position = 0.15
    bench.ticks(50)
    assert bench.firmware.state == "armed"
    assert targets(bench) == (0.2, 0.0, 1.5)


@pytest.mark.parametrize(
    ("pattern", "detail"),
    [
        (GoTo(target_rad=1e6, max_speed_rad_s=1e-6), "would take"),
        (GoTo(target_rad=6.0, max_speed_rad_s=0.01), "would take"),
        (ConstantMotion(velocity_rad_s=1e5, duration_s=1.0), "times"),
    ],
)
def test_an_absurd_motion_is_refused_before_it_is_sampled(pattern: Any, detail: str) -> None:
    bench = Bench()
    bench.acquire()
    answer = bench.move(pattern=pattern)
    assert refused(answer, Refusal.LIMIT)
    assert detail in answer.detail


def test_a_joint_beyond_its_range_is_not_driven_further_out() -> None:
    bench = Bench(kind="SEA-snake")
    bench.acquire()
    outward = Setpoint(**bench.head(position_rad=None, velocity_rad_s=3.0, effort_nm=None))
    bench.position = 1.60
    assert bench.ask(Leaf.SETPOINT, outward).accepted
    bench.tick()
    assert bench.pwm == 0.0
    inward = Setpoint(**bench.head(position_rad=None, velocity_rad_s=-1.0, effort_nm=None))
    assert bench.ask(Leaf.SETPOINT, inward).accepted
    bench.tick()
    assert bench.pwm < 0.0


def test_a_fault_ends_the_motion_that_it_interrupts() -> None:
    bench = Bench()
    bench.acquire()
    bench.move(5)
    bench.winding_c = 154.5
    bench.tick()
    motion = bench.status().motion
    assert motion is not None
    assert (motion.outcome, motion.end_row is not None) == ("fault", True)
    assert not bench.move(5).accepted


def test_an_m_stop_ends_the_motion_and_keeps_the_module_from_being_armed() -> None:
    bench = Bench()
    bench.acquire()
    bench.move(5)
    bench.m_stop = True
    bench.tick()
    assert bench.firmware.state == "stopped"
    status = bench.status()
    assert status.motion is not None
    assert status.motion.outcome == "stopped"
    assert status.note == "M-stop pressed"
    answer = bench.acquire()
    assert refused(answer, Refusal.NOT_ARMED)
    assert "M-stop" in answer.detail
    bench.m_stop = False
    assert bench.acquire().accepted


def test_gains_end_with_the_lease_of_their_sender() -> None:
    bench = Bench()
    bench.acquire()
    factory = bench.gains
    stiff = factory.model_copy(update={"position": factory.position.model_copy(update={"kp": 6.0})})
    assert bench.ask(Leaf.GAINS, GainsCommand(**bench.head(gains=stiff))).accepted
    assert bench.gains == stiff
    assert bench.ask(Leaf.LEASE, LeaseRequest(**bench.head(action="release"))).accepted
    assert bench.gains == factory


def test_gains_that_a_module_is_to_keep_outlive_the_lease_and_the_next_ones_do_not() -> None:
    bench = Bench()
    bench.acquire()
    loop = bench.gains.position
    soft, stiff = (
        bench.gains.model_copy(update={"position": loop.model_copy(update={"kp": kp})}) for kp in (0.2, 6.0)
    )
    assert bench.ask(Leaf.GAINS, GainsCommand(**bench.head(gains=soft, keep=True))).accepted
    assert bench.ask(Leaf.GAINS, GainsCommand(**bench.head(gains=stiff))).accepted
    assert bench.gains == stiff
    assert bench.ask(Leaf.LEASE, LeaseRequest(**bench.head(action="release"))).accepted
    assert bench.gains == soft


def test_a_module_shows_which_one_it_is_without_a_lease_and_stays_idle() -> None:
    bench = Bench()
    for on, marked in ((True, ("A",)), (False, ())):
        message = Identify(serial="A", boot=0, seq=1, sender="anybody", on=on)
        assert bench.ask(Leaf.IDENTIFY, message).accepted
        assert bench.identified == marked
    assert bench.firmware.state == "idle"


SEND: dict[Leaf, Callable[[Bench], Message]] = {
    Leaf.LEASE: lambda b: LeaseRequest(**b.head(action="renew")),
    Leaf.MOTION: lambda b: MotionCommand(**b.head(motion_id=9, pattern=Rest(duration_s=1.0))),
    Leaf.SETPOINT: lambda b: Setpoint(**b.head(position_rad=1.0, velocity_rad_s=None, effort_nm=None)),
    Leaf.GAINS: lambda b: GainsCommand(**b.head(gains=b.gains)),
    Leaf.STOP: lambda b: Stop(serial="A", boot=0, seq=1, sender="me"),
}


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(sorted(SEND)), st.binary(max_size=300), st.data())
def test_garbage_is_counted_and_changes_nothing(leaf: Leaf, noise: bytes, data: st.DataObject) -> None:
    """Random bytes, and valid messages with one byte changed, either act as valid ones or are refused."""
    bench = Bench()
    bench.acquire()
    good = encode(SEND[leaf](bench))
    at = data.draw(st.integers(0, len(good) - 1))
    broken = good[:at] + bytes([good[at] ^ data.draw(st.integers(1, 255))]) + good[at + 1 :]
    refusals = sum(bench.firmware.admission.refusals.values())
    assert not bench.ask(leaf, noise).accepted
    assert sum(bench.firmware.admission.refusals.values()) == refusals + 1
    answer = bench.ask(leaf, broken)
    if not answer.accepted:
        assert sum(bench.firmware.admission.refusals.values()) == refusals + 2
        assert bench.firmware.state == "armed"


ACTIONS = ["acquire", "renew", "move", "setpoint", "stop", "wait", "hot"]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from(ACTIONS), max_size=40))
def test_no_sequence_of_commands_drives_a_motor_that_is_not_commanded(actions: list[str]) -> None:
    bench = Bench()
    for number, action in enumerate(actions, start=1):
        bench.winding_c = 155.0 if action == "hot" else 40.0
        match action:
            case "acquire":
                bench.acquire()
            case "renew":
                bench.renew()
            case "move":
                bench.move(number)
            case "setpoint":
                bench.setpoint()
            case "stop":
                bench.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=number, sender="x"))
            case _:
                bench.ticks(120)
        bench.tick()
        if bench.firmware.state not in COMMANDED:
            assert bench.pwm == 0.0


# What every command and event makes of every state; "-" is a refusal.
AFTERWARDS = """
           acquire  release  move    setpoint   stop     hot    wait
idle       armed    -        -       -          stopped  fault  idle
armed      armed    idle     moving  streaming  stopped  fault  expired
moving     armed    idle     -       -          stopped  fault  expired
streaming  armed    idle     moving  streaming  stopped  fault  expired
expired    armed    expired  -       -          stopped  fault  expired
stopped    armed    stopped  -       -          stopped  fault  stopped
fault      armed    fault    -       -          fault    fault  fault
"""
EVENTS, *STATES = [line.split() for line in AFTERWARDS.strip().splitlines()]
WAYS: dict[str, tuple[str, ...]] = {
    "idle": (),
    "armed": ("acquire",),
    "moving": ("acquire", "move"),
    "streaming": ("acquire", "setpoint"),
    "expired": ("acquire", "wait"),
    "stopped": ("acquire", "stop"),
    "fault": ("acquire", "hot"),
}


@pytest.mark.parametrize(
    ("state", "action", "after"),
    [(state, action, after) for state, *row in STATES for action, after in zip(EVENTS, row, strict=True)],
)
def test_what_a_module_does_in_each_state_with_each_command(state: str, action: str, after: str) -> None:
    bench, numbers = Bench(), itertools.count(1)
    does: dict[str, Callable[[], Ack | None]] = {
        "acquire": lambda: bench.acquire(duration_ns=10_000 * MS),
        "release": lambda: bench.ask(Leaf.LEASE, LeaseRequest(**bench.head(action="release"))),
        "move": lambda: bench.move(next(numbers)),
        "setpoint": bench.setpoint,
        "stop": lambda: bench.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="anybody")),
        "hot": lambda: heat(155.0),
        "wait": lambda: bench.ticks(255),
    }

    def heat(winding_c: float) -> None:
        bench.winding_c = winding_c
        bench.tick()

    for one in WAYS[state]:
        does[one]()
    heat(40.0)
    assert bench.firmware.state == state
    answer = does[action]()
    assert bench.firmware.state == (state if after == "-" else after)
    if answer is not None:
        assert answer.accepted == (after != "-")


def test_every_transition_leads_to_a_state_that_can_be_left_again() -> None:
    for targets in TRANSITIONS.values():
        assert set(targets.values()) <= set(TRANSITIONS)
        assert targets["acquire"] in COMMANDED


@pytest.mark.parametrize(
    "settings",
    [
        {"lifetime_ns": 0},
        {"lifetime_ns": 2_000 * MS},
        {"lifetime_ns": 3 * MS},
        {"feedback_rate_hz": 2000.0},
        {"batch_rows": 0},
    ],
)
def test_a_configuration_that_cannot_be_run_is_refused(settings: dict[str, Any]) -> None:
    kind = CATALOGUE["X5-1"]
    with pytest.raises(UsageError, match="must be"):
        check_config(FirmwareConfig("A", kind, 1, catalogue_limits(kind), **settings))


def test_there_are_no_more_rows_than_ticks() -> None:
    """A module that is read 100 times a second has 100 rows a second, and says so."""
    kind = CATALOGUE["X5-1"]
    slow = ModuleInformation(
        "A", "", "", "X5-1", default_gains(kind, 3), catalogue_limits(kind), 10 * MS, 10 * MS
    )
    assert config_of(slow, 1, feedback_rate_hz=250.0).feedback_rate_hz == 100.0
    assert config_of(slow, 1, feedback_rate_hz=50.0).feedback_rate_hz == 50.0


# ------------------------------------------------------------------ sensors and clocks that fail

READINGS = [name for name in SensorSample._fields if not name.endswith("t_ns")]


def test_one_bad_sample_costs_a_driven_motor_nothing() -> None:
    bench, healthy = Bench(), Bench()
    for one in (bench, healthy):
        one.acquire()
        for _ in range(5):
            one.setpoint(0.3)
    bench.wrong = {"velocity_rad_s": math.nan, "effort_nm": math.inf}
    bench.setpoint(0.3)
    bench.wrong = {}
    healthy.setpoint(0.3)
    assert bench.pwm == healthy.pwm != 0.0
    assert bench.firmware.state == "streaming"


@pytest.mark.parametrize("name", READINGS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -1e12])
def test_a_sensor_that_stays_bad_is_a_fault_with_its_name_until_it_is_good_again(
    name: str, value: float
) -> None:
    bench = Bench()
    bench.acquire()
    bench.setpoint(0.3)
    bench.wrong = {name: value}
    bench.ticks(8)
    assert bench.firmware.state == "fault"
    assert bench.pwm == 0.0
    assert name in bench.status().note
    answer = bench.acquire()
    assert refused(answer, Refusal.NOT_ARMED)
    assert name in answer.detail
    bench.wrong = {}
    bench.tick()
    assert bench.acquire().accepted


def test_a_module_whose_first_samples_are_bad_does_not_arm() -> None:
    fresh = WiredFirmware(FirmwareConfig("A", CATALOGUE["X5-9"], BOOT, catalogue_limits(CATALOGUE["X5-9"])))
    sample = SensorSample(MS, MS, math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 40.0, 24.0, 0, 0, 0, 0, 0, 9.8)
    pwm, _ = fresh.tick(sample)
    assert (pwm, fresh.firmware.state) == (0.0, "fault")


@given(
    st.lists(
        st.dictionaries(st.sampled_from(READINGS), st.floats(allow_nan=True, allow_infinity=True)),
        max_size=30,
    )
)
@settings(max_examples=60, deadline=None)
def test_whatever_sensors_read_the_pwm_is_finite_and_within_its_range(ticks: list[dict[str, float]]) -> None:
    bench = Bench()
    bench.acquire()
    for wrong in ticks:
        bench.wrong = wrong
        bench.setpoint(0.3)
        assert -1.0 <= bench.pwm <= 1.0


@pytest.mark.parametrize("back_ms", [0, 1, 700, 4_000])
def test_a_clock_that_goes_back_expires_the_command_and_the_lease_at_once(back_ms: int) -> None:
    bench = Bench()
    bench.acquire(duration_ns=10_000 * MS)
    bench.move()
    bench.ticks(200)
    bench.renew()
    assert bench.pwm != 0.0
    # A tick is 1 ms: with 0 the clock stands still.
    bench.now -= (1 + back_ms) * MS
    bench.tick()
    assert bench.pwm == 0.0
    assert bench.firmware.state == "expired"
    assert bench.firmware.lease.holder is None
    bench.published.clear()
    assert bench.acquire().accepted
    assert bench.setpoint().accepted
    bench.ticks(40)
    # Rows go on, and do not wait for the clock to be where it was.
    assert [o.leaf for o in bench.published].count(Leaf.FEEDBACK) >= 2


@pytest.mark.parametrize("step_ns", [0, 1_000, 250_000, 400_000])
@pytest.mark.parametrize("start_ms", [0, 5_000])
def test_a_motor_is_off_soon_after_its_commander_died_however_slowly_its_clock_runs(
    start_ms: int, step_ns: int
) -> None:
    bench = Bench()
    bench.acquire(duration_ns=10_000 * MS)
    bench.setpoint()
    assert bench.pwm
    # A tick adds a millisecond.
    bench.now = start_ms * MS or -MS
    if not start_ms:
        bench.tick()
        bench.acquire(duration_ns=10_000 * MS)
        bench.setpoint()
    driven = 0
    for k in range(2_000):
        bench.now += step_ns - MS
        bench.tick()
        driven = k + 1 if bench.pwm else driven
    # At a quarter of its rate its own lifetime takes as long as the clock's fault takes to show.
    assert driven <= (0 if not step_ns else 4 * 250 + 2)
    assert bench.firmware.state == "fault" or step_ns == 400_000
    assert bench.firmware.state != "streaming"


def test_a_clock_that_stands_is_a_fault_until_it_runs_again() -> None:
    bench = Bench()
    bench.acquire()
    bench.setpoint()

    def stand(ticks: int) -> None:
        for _ in range(ticks):
            bench.now -= MS
            bench.tick()

    stand(1)
    bench.now -= MS
    assert bench.status().note == "the module's clock stands"
    # Nothing is sent over and over, nor is a module armed for longer than a tick.
    bench.published.clear()
    stand(3_000)
    assert len(bench.published) <= 3
    why = "the module's clock stands, or runs slower than at half its rate"
    statuses = [decode(Status, one.payload) for one in bench.published if one.leaf is Leaf.STATUS]
    assert [(status.state, status.note) for status in statuses][-1:] == [("fault", why)]
    bench.now -= MS
    refusal = bench.acquire()
    assert (refusal.accepted, refusal.detail) == (False, why)
    bench.ticks(498)
    assert not bench.acquire().accepted
    assert bench.acquire().accepted


@pytest.mark.parametrize(("jump_ms", "state"), [(125, "moving"), (126, "expired"), (240, "expired")])
def test_a_clock_that_jumps_by_over_half_the_lifetime_expires_the_command_at_once(
    jump_ms: int, state: str
) -> None:
    """Else the target would leap by as much of the motion; the lease is not over, as its holder lives."""
    bench = Bench()
    bench.acquire(duration_ns=10_000 * MS)
    bench.move()
    bench.ticks(200)
    bench.renew()
    bench.tick()
    bench.now += (jump_ms - 1) * MS
    bench.tick()
    assert bench.firmware.state == state
    assert (bench.pwm == 0.0) == (state == "expired")
    assert bench.firmware.lease.holder is not None
    if state == "expired":
        assert bench.status().note == f"no tick for {jump_ms} ms: the clock jumped, or the module hung"


def test_a_holder_cannot_command_what_no_module_should_do() -> None:
    bench = Bench()
    bench.acquire()
    for values in (
        {"position": 10_000.0},
        {"position": 0.3, "effort_nm": 1e6},
        {"position": None, "velocity_rad_s": 1e3},
    ):
        position = values.pop("position")
        wanted = {"position_rad": position, "velocity_rad_s": None, "effort_nm": None, **values}
        answer = bench.ask(Leaf.SETPOINT, Setpoint(**bench.head(**wanted)))
        assert refused(answer, Refusal.LIMIT), wanted
    efforts = effort_profile([0.0, 1e4], 10 * MS)
    assert refused(bench.move(effort=efforts), Refusal.LIMIT)
    for field in ("kp", "ki", "kd", "feed_forward", "punch", "max_output"):
        wild = bench.gains.velocity.model_copy(update={field: 9e5})
        gains = bench.gains.model_copy(update={"velocity": wild})
        answer = bench.ask(Leaf.GAINS, GainsCommand(**bench.head(gains=gains)))
        assert refused(answer, Refusal.LIMIT)
        assert field in answer.detail
    assert bench.firmware.state == "armed"


def proven_ask(bench: Bench, leaf: Leaf, message: Message, secret: bytes) -> Ack:
    return bench.ask(leaf, proven(encode(message), secret))


def test_of_a_lease_with_a_secret_only_proven_commands_are_taken() -> None:
    """Holder, token, boot, sequence and time are all published: they do not make a commander."""
    bench = Bench()
    assert bench.acquire(secret=b"secret").accepted
    aims = {"position_rad": 0.3, "velocity_rad_s": None, "effort_nm": None}
    commands: list[tuple[Leaf, type[Message], dict[str, Any]]] = [
        (Leaf.SETPOINT, Setpoint, aims),
        (Leaf.GAINS, GainsCommand, {"gains": bench.gains}),
        (Leaf.LEASE, LeaseRequest, {"action": "renew"}),
        (Leaf.MOTION, MotionCommand, {"motion_id": 1, "pattern": Rest(duration_s=1.0)}),
        (Leaf.LEASE, LeaseRequest, {"action": "release"}),
    ]
    for leaf, kind, fields in commands:
        for secret in (b"", b"guess"):
            forged = kind(**bench.head(**fields, seq=10**6))
            assert refused(proven_ask(bench, leaf, forged, secret), Refusal.UNPROVEN)
    assert bench.firmware.state == "armed"
    for leaf, kind, fields in commands:
        # The forged sequence numbers, far ahead, have not made the holder's own too small.
        assert proven_ask(bench, leaf, kind(**bench.head(**fields)), b"secret").accepted
    assert bench.firmware.state == "idle"


def test_a_changed_byte_of_a_proven_command_is_refused() -> None:
    bench = Bench()
    bench.acquire(secret=b"secret")
    aims = {"position_rad": 0.3, "velocity_rad_s": None, "effort_nm": None}
    payload = proven(encode(Setpoint(**bench.head(**aims))), b"secret")
    for place in range(len(payload)):
        changed = payload[:place] + bytes([payload[place] ^ 1]) + payload[place + 1 :]
        assert not bench.ask(Leaf.SETPOINT, changed).accepted
    assert bench.ask(Leaf.SETPOINT, payload).accepted


def test_nobody_acquires_in_the_holders_name_without_its_secret() -> None:
    bench = Bench()
    bench.acquire(secret=b"secret")
    for secret in (b"", b"guess"):
        assert refused(bench.acquire(secret=secret), Refusal.UNPROVEN)
    assert bench.acquire(secret=b"secret").accepted


def test_the_secret_ends_with_the_lease() -> None:
    bench = Bench()
    bench.acquire(secret=b"secret", duration_ns=300 * MS)
    bench.ticks(310)
    assert bench.acquire(sender="other").accepted
    assert bench.setpoint(sender="other").accepted


def test_a_motion_that_others_estimate_from_is_announced_to_them_until_five_seconds_after_its_end() -> None:
    bench = Bench()

    def announced() -> list[Status]:
        out = [decode(Status, o.payload) for o in bench.published if o.leaf is Leaf.MOTION]
        bench.published.clear()
        return out

    def moved(number: int, pattern: Any, ticks: int) -> None:
        bench.acquire()
        assert bench.move(number, pattern).accepted
        for _ in range(ticks // 50):
            bench.renew()
            bench.ticks(50)

    assert announced() == []
    moved(1, ConstantMotion(velocity_rad_s=0.1, duration_s=0.5, ramp_s=0.1), 1000)
    statuses = announced()
    outcomes = [status.motion.outcome for status in statuses if status.motion is not None]
    assert outcomes[0] == "running"
    assert outcomes[-1] == "done"
    # Neither more nor less than what everyone hears at that time.
    assert len(statuses) == len({status.seq for status in statuses}) >= 3
    bench.ticks(10_000)
    times = [status.t_ns for status in announced()]
    assert 4_000 * MS < times[-1] - times[0] < 5_000 * MS
    # How a joint goes from one motion to the next is of no interest to the others.
    moved(2, GoTo(target_rad=0.3, max_speed_rad_s=1.0), 500)
    assert announced() == []


def test_a_clock_before_its_zero_is_a_fault_that_is_named_and_not_the_end() -> None:
    bench = Bench()
    bench.acquire()
    bench.now = -5_000 * MS
    for _ in range(10):
        bench.tick()
        assert bench.pwm == 0.0
    status = bench.status()
    assert (status.state, status.t_ns) == ("fault", 0)
    assert "before its zero" in status.note
    assert refused(bench.acquire(echo_ns=0), Refusal.NOT_ARMED)
    assert bench.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=9, sender="me")).accepted
    # When zero has passed it is a module like any other.
    bench.now = 100 * MS
    bench.ticks(20)
    assert bench.acquire().accepted
    published = len(bench.published)
    bench.ticks(100)
    assert len(bench.published) > published


# ------------------------------------------------------------------ what it says, and from when on


def test_a_fresh_module_has_nothing_to_say() -> None:
    bench = Bench()
    status = bench.status()
    assert (status.dropped_events, status.expiries, status.refusals, status.note) == (0, 0, {}, "")
    assert (status.motion, bench.firmware.last_rest) == (None, None)
    (first,) = [decode(Status, o.payload) for o in bench.published if o.leaf is Leaf.STATUS]
    assert (first.limits, first.note, first.seq) == ((), "", 1)
    bench.acquire()
    assert bench.status().note == ""


def test_an_answer_names_the_command_that_was_taken_and_a_refusal_its_reason() -> None:
    bench = Bench()
    answer = bench.acquire()
    assert (answer.re, answer.reason, answer.detail) == (bench.seq, "", "")
    answer = bench.setpoint(1e6)
    assert (answer.re, answer.reason) == (0, "limit")


def test_messages_are_counted_one_by_one_and_a_status_names_its_question() -> None:
    question = Incoming(Leaf.STATUS, encode(Ask(serial="A", boot=0, seq=9, sender="me")), 1)
    first, second = (decode(Status, answer) for answer in Bench().tick(question, question))
    assert second.seq == first.seq + 1
    assert (first.re, second.re) == (9, 9)


def test_a_long_story_is_cut_to_what_a_message_holds() -> None:
    head = {"serial": "A", "boot": BOOT, "seq": 1}
    answer = acknowledgement(head, Lease(), 0, 1, WireError(Refusal.LIMIT, 600 * "x"))
    assert answer.detail == 512 * "x"
    bench = Bench()
    bench.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="me", why=512 * "y"))
    assert bench.status().note == f"stopped by me: {512 * 'y'}"[:512]


def test_a_command_lives_its_lifetime_from_the_zero_of_the_clock_to_the_nanosecond() -> None:
    kind = CATALOGUE["X5-9"]
    config = FirmwareConfig("A", kind, BOOT, catalogue_limits(kind))
    wired, rest = WiredFirmware(config), Bench()
    acquire = LeaseRequest(**rest.head(action="acquire", token=0, echo_ns=0))
    for late_ns, state in ((0, "armed"), (1, "expired")):
        sample = SensorSample(config.lifetime_ns + late_ns, 0, *(0.0,) * 6, 40.0, 24.0, *(0.0,) * 6)  # type: ignore[call-arg]
        wired.tick(sample, [] if late_ns else [Incoming(Leaf.LEASE, encode(acquire), None)])
        assert wired.firmware.state == state


def test_at_the_first_nanoseconds_a_clock_is_a_clock() -> None:
    """At 0 a status is sent as at any first time, and a clock that stands still at 1 ns ends the command."""
    kind = CATALOGUE["X5-9"]
    wired, rest = WiredFirmware(FirmwareConfig("A", kind, BOOT, catalogue_limits(kind))), Bench()
    sample = SensorSample(0, 0, *(0.0,) * 6, 40.0, 24.0, *(0.0,) * 6)  # type: ignore[call-arg]
    _, out = wired.tick(sample)
    assert Leaf.STATUS in [o.leaf for o in out if isinstance(o, Publication)]
    assert wired.firmware.state == "idle"
    acquire = encode(LeaseRequest(**rest.head(action="acquire", token=0, echo_ns=0)))
    wired.tick(sample._replace(t_ns=1), [Incoming(Leaf.LEASE, acquire, None)])
    assert wired.firmware.state == "armed"
    wired.tick(sample._replace(t_ns=1))
    assert wired.firmware.state == "expired"


def test_that_a_lease_ended_is_said_at_once_by_a_clock_that_stands_at_its_zero() -> None:
    rest = Bench()
    kind = CATALOGUE["X5-9"]
    wired = WiredFirmware(FirmwareConfig("A", kind, BOOT, catalogue_limits(kind)))
    sample = SensorSample(0, 0, *(0.0,) * 6, 40.0, 24.0, *(0.0,) * 6)  # type: ignore[call-arg]
    acquire = encode(LeaseRequest(**rest.head(action="acquire", token=0, echo_ns=0)))
    wired.tick(sample, [Incoming(Leaf.LEASE, acquire, None)])
    assert wired.firmware.state == "armed"
    _, out = wired.tick(sample)
    said = [decode(Status, o.payload) for o in out if isinstance(o, Publication) and o.leaf is Leaf.STATUS]
    assert [(status.state, status.holder) for status in said] == [("expired", None)]


@pytest.mark.parametrize("is_hot", [False, True])
def test_a_clock_before_its_zero_is_said_at_once(is_hot: bool) -> None:
    """Whatever the module was: at a time of 0 no status waits for its turn."""
    bench = Bench()
    bench.winding_c = 155.0 if is_hot else 40.0
    bench.ticks(10)
    assert (bench.firmware.state == "fault") is is_hot
    bench.published.clear()
    bench.now = -5_000 * MS
    bench.tick()
    (status,) = [decode(Status, o.payload) for o in bench.published if o.leaf is Leaf.STATUS]
    assert (status.state, status.t_ns) == ("fault", 0)
    # And once: that it stays there is no news.
    bench.published.clear()
    bench.ticks(10)
    assert bench.published == []


def test_a_motion_is_announced_for_five_seconds_to_the_nanosecond() -> None:
    bench = Bench()
    bench.acquire()
    bench.move(1, ConstantMotion(velocity_rad_s=0.1, duration_s=0.1, ramp_s=0.02))
    while bench.firmware.state == "moving":
        bench.tick()
    bench.now += 5_000 * MS - 2 * MS
    for announced in (True, False):
        bench.published.clear()
        # An expiry and a stop: each of them has a status.
        bench.tick(*(() if announced else (Incoming(Leaf.STOP, encode(SEND[Leaf.STOP](bench)), None),)))
        leaves = {o.leaf for o in bench.published}
        assert Leaf.STATUS in leaves
        assert (Leaf.MOTION in leaves) is announced


def test_a_stop_in_the_first_tick_finds_a_motor_that_is_off() -> None:
    kind = CATALOGUE["X5-9"]
    config = FirmwareConfig("A", kind, BOOT, catalogue_limits(kind), feedback_rate_hz=1000.0, batch_rows=1)
    sample = SensorSample(5 * MS, 5 * MS, *(0.0,) * 6, 40.0, 24.0, *(0.0,) * 6)  # type: ignore[call-arg]
    stop = encode(Stop(serial="A", boot=0, seq=1, sender="me"))
    _, out = WiredFirmware(config).tick(sample, [Incoming(Leaf.STOP, stop, None)])
    (block,) = [o.payload for o in out if isinstance(o, Publication) and o.leaf is Leaf.FEEDBACK]
    (row,) = unpack(decode(Feedback, block, MAX_MESSAGE_BYTES))
    assert STATE_NAMES[row["state"]] == "stopped"
    for name in ("position_command_rad", "velocity_command_rad_s", "effort_command_nm"):
        assert math.isnan(row[name]), name


# ------------------------------------------------------------------ what quiet ticks are told


def told(bench: Bench) -> tuple[Any, ...]:
    state = bench.firmware.quiet_state()
    return state.source, state.commanded, state.in_fault, state.motion is not None, state.motion_id


def test_quiet_ticks_follow_a_motion_until_it_is_done() -> None:
    bench = Bench()
    assert told(bench) == (FOLLOW, False, False, False, 0)
    bench.acquire()
    assert told(bench) == (FOLLOW, True, False, False, 0)
    bench.move(5, Rest(duration_s=0.05))
    assert told(bench) == (MOTION, True, False, True, 5)
    bench.ticks(60)
    assert told(bench) == (FOLLOW, True, False, False, 0)
    bench.setpoint(0.25)
    assert told(bench) == (FOLLOW, True, False, False, 0)
    state = bench.firmware.quiet_state()
    assert state.state_number == STATE_NAMES.index("streaming")
    assert (state.fresh_ns, state.now_ns, state.lifetime_ns) == (bench.now - MS, bench.now, 250 * MS)
    assert (state.lease_until_ns, state.winding_c) == (bench.firmware.lease.until_ns, 154.0)
    assert (state.targets[0], state.limited) == (0.25, 0)
    assert bench.now < state.status_due_ns <= bench.now + 400 * MS
    bench.winding_c = 155.0
    bench.tick()
    assert told(bench) == (FOLLOW, False, True, False, 0)


@pytest.mark.parametrize(("action", "source"), [("motor_off", FOLLOW), ("hold", FOLLOW), ("damping", BRAKE)])
def test_quiet_ticks_brake_after_an_expiry_that_damps(action: str, source: int) -> None:
    bench = Bench(expiry_action=action)
    bench.acquire()
    bench.move(5)
    bench.ticks(255)
    assert bench.firmware.state == "expired"
    assert told(bench) == (source, False, False, False, 0)
    # A lease that is held again, by which nothing expires, has nothing to brake.
    bench.acquire()
    assert told(bench)[0] == FOLLOW


@pytest.mark.parametrize(("m_stop", "source"), [(None, BRAKE), ("motor_off", FOLLOW)])
def test_quiet_ticks_brake_while_stopped_unless_the_motor_is_to_be_off(
    m_stop: str | None, source: int
) -> None:
    bench = Bench(safety=Safety(m_stop=m_stop))
    bench.m_stop = True
    bench.tick()
    assert (bench.firmware.state, told(bench)[0]) == ("stopped", source)
    bench.m_stop = False
    bench.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="me"))
    assert told(bench)[0] == BRAKE


def test_a_firmware_begins_with_the_gains_of_its_module_unless_a_strategy_is_configured() -> None:
    bench = Bench()
    modules, config = bench._wired.modules, bench.firmware.config
    own = default_gains(config.kind, 4)
    modules.set_gains(0, own)
    assert Firmware(config, modules)._info().gains == own
    assert modules.information[0].gains == own
    other = default_gains(config.kind, 2)
    assert Firmware(config._replace(strategy=2), modules)._info().gains == other
    assert modules.information[0].gains == other

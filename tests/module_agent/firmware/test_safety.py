"""The firmware under a safety configuration: what it refuses, what it says, and the M-stop."""

from typing import Any

import pytest

from module_agent.control.safety import Safety
from module_agent.firmware.firmware import Incoming, Publication
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ask, EstimateRequest, GoTo, Info, LeaseRequest, Rest, Status, Stop
from module_agent.wire.refusal import Refusal
from tests.module_agent.firmware_bench import BOOT, Bench, refused

NARROW = Safety(position_rad=(-0.5, 0.5))


def bench(**limits: Any) -> Bench:
    return Bench(safety=Safety(**limits))


def last_status(one: Bench) -> Status:
    payloads = [o.payload for o in one.published if isinstance(o, Publication) and o.leaf is Leaf.STATUS]
    return decode(Status, payloads[-1])


# ------------------------------------------------------------------ ranges


def test_the_planner_is_told_of_the_configured_limits() -> None:
    one = bench(position_rad=(-0.5, 0.5), velocity_rad_s=0.3, effort_nm=2.0)
    (answer,) = one.tick(Incoming(Leaf.INFO, encode(Ask(serial="A", boot=0, seq=1, sender="me")), 1))
    limits = decode(Info, answer).limits
    assert (limits.min_position_rad, limits.max_position_rad) == (-0.5, 0.5)
    assert (limits.max_speed_rad_s, limits.max_effort_nm) == (0.3, 2.0)


def test_what_leads_beyond_a_configured_limit_is_refused_with_both_ranges() -> None:
    one = Bench(safety=NARROW)
    one.acquire()
    for answer in (
        one.setpoint(0.6),
        one.setpoint(-0.6),
        one.move(pattern=GoTo(target_rad=0.6, max_speed_rad_s=1.0)),
    ):
        assert refused(answer, Refusal.LIMIT)
        assert "-0.5 .. 0.5" in answer.detail
    assert one.setpoint(0.45).accepted


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_beyond_its_limit_may_be_moved_back_and_no_farther_out(sign: float) -> None:
    one = Bench(safety=NARROW)
    one.position = sign * 0.8
    one.tick()
    one.acquire()
    assert refused(one.move(1, GoTo(target_rad=sign * 0.81, max_speed_rad_s=1.0)), Refusal.LIMIT)
    assert refused(one.move(2, GoTo(target_rad=-sign * 0.8, max_speed_rad_s=1.0)), Refusal.LIMIT)
    assert one.move(3, GoTo(target_rad=sign * 0.3, max_speed_rad_s=1.0)).accepted


def test_limits_that_act_are_named_in_the_next_status_and_not_for_ever() -> None:
    one = bench(position_rad=(-0.5, 0.5), effort_nm=0.05)
    one.acquire()
    assert last_status(one).limits == ()
    one.position = 0.495
    for _ in range(5):
        one.tick()
        one.setpoint(0.5)
    one.wrong = {"effort_nm": 0.0}
    for _ in range(500):
        one.setpoint(0.5)
    # The joint of the bench stays beyond where the motor aims, driven back by no more than 0.05 Nm.
    assert last_status(one).limits == ("position", "effort")
    one.position = 0.0
    for _ in range(900):
        one.setpoint(0.0)
    assert last_status(one).limits == ()


def test_a_limit_that_acted_for_a_moment_is_in_the_next_status() -> None:
    one = bench(effort_nm=0.05)
    one.acquire()
    for _ in range(3):
        one.setpoint(2.0)
    for _ in range(10):
        one.setpoint(0.2)
    assert one.pwm == 0.0
    assert one.status().limits == ("effort",)


def test_an_answered_question_does_not_take_the_limits_from_the_next_status() -> None:
    one = bench(effort_nm=0.05)
    one.acquire()
    one.ticks(2)
    for _ in range(5):
        one.setpoint(2.0)
    assert one.status().limits == ("effort",)
    assert one.status().limits == ("effort",)


# ------------------------------------------------------------------ motor off at a limit


def test_a_motor_off_at_its_limit_stays_off_until_the_joint_is_back_and_acquired() -> None:
    one = bench(position_rad=(-0.5, 0.5), at_limit="motor_off")
    one.acquire()
    one.move(7, Rest(duration_s=1.0))
    one.position = 0.5
    one.tick()
    assert (one.firmware.state, one.pwm) == ("fault", 0.0)
    status = one.status()
    assert "motor off at the limit 0.5 rad" in status.note
    assert status.motion is not None
    assert status.motion.outcome == "fault"
    answer = one.acquire()
    assert refused(answer, Refusal.NOT_ARMED)
    assert "limit 0.5 rad" in answer.detail
    one.position = 0.4
    one.ticks(10)
    assert (one.firmware.state, one.pwm) == ("fault", 0.0)
    assert one.acquire().accepted
    assert one.firmware.state == "armed"


def test_a_refusal_without_a_fault_gives_no_reason_in_brackets() -> None:
    one = bench()
    one.acquire()
    one.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="anybody", why="test"))
    answer = one.move(7, Rest(duration_s=1.0))
    assert refused(answer, Refusal.NOT_ARMED)
    assert answer.detail == "motion is not possible while stopped: acquire first"


# ------------------------------------------------------------------ winding


def test_a_winding_limit_is_a_fault_and_must_cool_by_14_k() -> None:
    one = bench(winding_c=90.0)
    one.acquire()
    one.winding_c = 89.9
    one.setpoint(0.3)
    assert one.firmware.state == "streaming"
    one.winding_c = 90.0
    one.tick()
    assert (one.firmware.state, one.pwm) == ("fault", 0.0)
    answer = one.move(7, Rest(duration_s=1.0))
    assert refused(answer, Refusal.NOT_ARMED)
    assert answer.detail == "motion is not possible while fault (winding at 90 C): acquire first"
    one.winding_c = 76.1
    answer = one.acquire()
    assert refused(answer, Refusal.NOT_ARMED)
    assert "below 76 C" in answer.detail
    one.winding_c = 76.0
    assert one.acquire().accepted


@pytest.mark.parametrize(("winding_c", "arms"), [(89.9, True), (90.0, False)])
def test_a_winding_that_was_not_too_hot_is_armed_up_to_its_limit(winding_c: float, arms: bool) -> None:
    one = bench(winding_c=90.0)
    one.winding_c = winding_c
    answer = one.acquire()
    assert answer.accepted is arms
    assert arms or refused(answer, Refusal.NOT_ARMED)


# ------------------------------------------------------------------ M-stop


def test_an_m_stop_with_motor_off_leaves_the_motor_without_brake_until_acquired() -> None:
    one = bench(m_stop="motor_off")
    one.acquire()
    one.m_stop = True
    one.wrong = {"motor_velocity_rad_s": 500.0}
    one.tick()
    assert (one.firmware.state, one.pwm) == ("stopped", 0.0)
    one.m_stop = False
    one.ticks(50)
    assert (one.firmware.state, one.pwm) == ("stopped", 0.0)
    assert one.acquire().accepted
    # A stop by message brakes, as ever.
    assert one.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="x")).accepted
    one.tick()
    assert one.pwm < 0.0


def test_an_m_stop_without_configuration_brakes() -> None:
    one = Bench()
    one.acquire()
    one.m_stop = True
    one.wrong = {"motor_velocity_rad_s": 500.0}
    one.tick()
    assert one.firmware.state == "stopped"
    assert one.pwm < 0.0


@pytest.mark.parametrize("state", ["armed", "moving", "streaming"])
def test_an_m_stop_that_holds_resumes_when_it_is_released(state: str) -> None:
    one = bench(m_stop="hold")
    one.acquire()
    if state == "moving":
        one.move(1, GoTo(target_rad=1.0, max_speed_rad_s=1.0))
        one.ticks(100)
    if state == "streaming":
        one.setpoint(0.9)
    assert one.firmware.state == state
    one.m_stop = True
    one.tick()
    assert one.firmware.state == "armed"
    if state != "armed":
        assert one.status().note == "M-stop pressed"
    if state == "moving":
        motion = one.status().motion
        assert motion is not None
        assert motion.outcome == "stopped"
    # It holds where it was, against a push.
    one.position = 0.1
    one.tick()
    assert one.pwm > 0.0
    for answer in (one.setpoint(0.3), one.move(2), one.acquire()):
        assert refused(answer, Refusal.NOT_ARMED)
        assert "M-stop" in answer.detail
    assert one.renew().accepted
    one.m_stop = False
    assert one.setpoint(0.3).accepted
    assert one.firmware.state == "streaming"


def test_an_m_stop_that_holds_ends_with_the_lifetime_of_commands() -> None:
    one = bench(m_stop="hold")
    one.acquire()
    one.m_stop = True
    one.ticks(260)
    assert (one.firmware.state, one.pwm) == ("expired", 0.0)


def test_a_disabled_m_stop_does_nothing() -> None:
    one = bench(m_stop="disabled")
    one.m_stop = True
    assert one.acquire().accepted
    assert one.move(1, Rest(duration_s=1.0)).accepted
    one.tick()
    assert one.firmware.state == "moving"


@pytest.mark.parametrize("action", [None, "motor_off"])
def test_a_pressed_m_stop_stays_the_reason_of_the_first_stop(action: str | None) -> None:
    one = bench(m_stop=action)
    one.acquire()
    one.wrong = {"motor_velocity_rad_s": 500.0}
    one.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=1, sender="x", why="first"))
    one.m_stop = True
    one.ticks(3)
    assert one.firmware.state == "stopped"
    assert "first" in one.status().note
    # A stop by message while it is pressed takes nothing back.
    one.ask(Leaf.STOP, Stop(serial="A", boot=0, seq=2, sender="x", why="second"))
    assert (one.pwm == 0.0) is (action == "motor_off")


def test_a_fault_stays_the_reason_while_an_m_stop_is_pressed() -> None:
    one = Bench()
    one.winding_c = 155.0
    one.tick()
    one.m_stop = True
    one.ticks(3)
    assert one.firmware.state == "fault"
    assert "winding" in one.status().note


def test_a_module_in_fault_says_so_as_often_while_an_m_stop_is_pressed() -> None:
    said = []
    for pressed in (False, True):
        one = Bench()
        one.winding_c = 155.0
        one.tick()
        one.m_stop = pressed
        one.published.clear()
        one.ticks(1000)
        said.append([sent.leaf for sent in one.published].count(Leaf.STATUS))
    assert said[0] == said[1] > 0


@pytest.mark.parametrize("state", ["fault", "expired"])
def test_what_led_to_a_state_stays_its_reason_when_its_lease_is_released(state: str) -> None:
    one = Bench()
    one.acquire()
    if state == "fault":
        one.winding_c = 155.0
        one.tick()
        assert one.ask(Leaf.STOP, Stop(**one.head(), why="module B is lost")).accepted
    else:
        one.ticks(260)
    assert one.firmware.state == state
    reason = one.status().note
    assert reason in ("winding at 155 C", "no fresh command for 250 ms")
    assert one.ask(Leaf.LEASE, LeaseRequest(**one.head(action="release"))).accepted
    assert (one.firmware.state, one.status().note) == (state, reason)


def test_a_second_stop_is_the_reason_of_a_stop() -> None:
    one = Bench()
    for why in ("first", "second"):
        assert one.ask(Leaf.STOP, Stop(**one.head(), why=why)).accepted
        assert one.status().note.endswith(why)


@pytest.mark.parametrize("letter", ["a", "ä", "漢"])
def test_a_long_text_in_any_script_leaves_the_status_readable(letter: str) -> None:
    """A text is bounded by its bytes."""
    one = Bench()
    why = letter * (512 // len(letter.encode()))
    assert one.ask(Leaf.STOP, Stop(**one.head(), why=why)).accepted
    assert one.status().note.startswith(f"stopped by {one.head()['sender']}: {letter}")


def test_release_needs_no_m_stop_to_be_released() -> None:
    one = bench(m_stop="hold")
    one.acquire()
    one.m_stop = True
    one.tick()
    assert one.ask(Leaf.LEASE, LeaseRequest(**one.head(action="release"))).accepted
    assert one.firmware.state == "idle"


# ------------------------------------------------------------------ what is left


def test_a_motion_that_is_no_rest_leaves_the_last_rest() -> None:
    one = Bench()
    one.acquire()
    one.move(1, Rest(duration_s=0.05))
    one.ticks(60)
    one.move(2, GoTo(target_rad=0.21, max_speed_rad_s=1.0))
    one.ticks(200)
    assert one.status().motion is not None
    assert one.firmware.last_rest is not None
    assert one.firmware.last_rest.motion_id == 1


def test_a_message_that_the_firmware_does_not_answer_is_refused() -> None:
    one = Bench()
    question = EstimateRequest(serial="A", boot=BOOT, seq=1, sender="x", joint="B")
    answer = one.ask(Leaf.ESTIMATE, question)
    assert refused(answer, Refusal.MALFORMED)
    assert "estimate is not answered by the firmware" in answer.detail


def test_a_copy_of_an_acquisition_changes_nothing() -> None:
    one = Bench()
    grant = encode(LeaseRequest(**one.head(action="acquire")))
    assert one.ask(Leaf.LEASE, grant).accepted
    one.setpoint(0.3)
    assert one.ask(Leaf.LEASE, grant).accepted
    assert one.firmware.state == "streaming"
    assert one.firmware.lease.token == 1

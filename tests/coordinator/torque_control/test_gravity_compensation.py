"""The course of a float, step by step: a pendulum of one joint, held, set free, and held again."""

import numpy as np
import pytest

from coordinator.torque_control.gains import (
    HOLDING_TIMES,
    compensation_gains,
    holding_gains,
    max_damping_nm_s_rad,
)
from coordinator.torque_control.gravity_compensation import (
    MAX_LOADING_MOTION_RAD,
    MAX_OFFSET_OF_EFFORT,
    MAX_OFFSET_OF_WEIGHT,
    MAX_RELEASE_MOTION_RAD,
    CompensationRefused,
    CompensationSettings,
    GravityCompensator,
    Reading,
    StaleFeedback,
    Targets,
)
from coordinator.torque_control.gravity_model import GravityModel
from module_agent.control.gains import catalogue_limits
from module_agent.model.catalogue import CATALOGUE
from module_agent.model.chain import Chain
from module_agent.model.errors import UsageError
from module_agent.wire.messages import Limits
from sim.benchmark.cases.gravity_compensation import true_weight
from sim.robot.robot_file import load_robot

X5_4 = CATALOGUE["X5-4"]
G_M_S2, MASS_KG, REACH_M = 9.81, 0.8, 0.3
LEVEL_NM = -MASS_KG * REACH_M * G_M_S2
SETTINGS = CompensationSettings(ramp_s=0.8, hold_s=0.4, stale_s=0.12)


def pendulum(mass_kg: float = MASS_KG) -> GravityModel:
    """A mass on the x axis that turns about y: turning about +y lowers it, so that its weight helps."""
    chain = Chain(
        serials=("J",),
        parent=(-1,),
        reversed=(False,),
        axis=np.array([[0.0, 1.0, 0.0]]),
        point=np.zeros((1, 3)),
        imu_home=np.eye(4)[None],
        gravity=np.array([0.0, 0.0, G_M_S2]),
    )
    inertia = mass_kg * REACH_M**2
    phi = np.array([mass_kg, mass_kg * REACH_M, 0.0, 0.0, 0.0, 0.0, 0.0, inertia, 0.0, inertia])
    return GravityModel("pendulum", ("X5-4",), chain, phi)


def limits(low: float | None = None, high: float | None = None) -> Limits:
    return catalogue_limits(X5_4).model_copy(update={"min_position_rad": low, "max_position_rad": high})


def reading(q: float = 0.0, rate: float = 0.0, effort: float = LEVEL_NM, age_s: float = 0.01) -> Reading:
    return Reading(*(np.array([value]) for value in (age_s, q, rate, effort)))


def compensator(of: Limits | None = None, settings: CompensationSettings = SETTINGS) -> GravityCompensator:
    return GravityCompensator(pendulum(), (of or limits(),), settings)


def loaded() -> GravityCompensator:
    found = compensator()
    for t_s in (10.0, 10.8):
        found.step(t_s, reading())
    assert found.phase == "loaded"
    return found


def free() -> GravityCompensator:
    found = loaded()
    found.release(11.0)
    found.step(11.8, reading())
    assert found.phase == "compensating"
    return found


def place(targets: Targets) -> float:
    assert targets.position_rad is not None
    return float(targets.position_rad[0])


# --------------------------------------------------------------------------- set free


def test_before_it_is_set_free_the_joint_goes_over_from_the_torque_that_it_bears_to_its_weight() -> None:
    it = compensator()
    borne = LEVEL_NM + 0.32
    first, middle = it.step(10.0, reading(effort=borne)), it.step(10.4, reading(effort=borne))
    assert first.effort_nm[0] == pytest.approx(borne)
    assert middle.effort_nm[0] == pytest.approx(0.5 * (borne + LEVEL_NM))
    assert (place(first), place(middle)) == (0.0, 0.0)
    assert it.step(10.7, reading(effort=borne)).effort_nm[0] == pytest.approx(LEVEL_NM + 0.04)
    it.step(10.8, reading(effort=borne))
    assert it.phase == "loaded"


def test_what_a_sensor_reads_beside_the_weight_before_it_is_free_is_borne_with_the_weight() -> None:
    it = compensator()
    rng = np.random.default_rng(1)
    for t_s in np.arange(10.0, 10.81, 0.005):
        # 0.3 Nm of offset and some noise.
        it.step(float(t_s), reading(effort=LEVEL_NM + 0.3 + rng.normal(0.0, 0.05)))
    it.release(11.0)
    it.step(11.8, reading())
    # The mean of some fifty readings.
    led = it.step(12.0, reading(q=0.9, effort=0.0)).effort_nm[0]
    assert led == pytest.approx(LEVEL_NM * np.cos(0.9) + 0.3, abs=0.03)


def test_where_it_has_given_while_it_was_held_softly_it_is_not_snatched_back() -> None:
    it = compensator()
    it.step(10.0, reading())
    it.step(10.8, reading(q=0.05))
    assert it.phase == "loaded"
    assert place(it.step(10.9, reading(q=0.05))) == pytest.approx(0.05)


def test_the_position_loop_lets_go_little_by_little_and_pulls_to_where_it_held() -> None:
    it = loaded()
    it.release(11.0)
    # The joint has given by 0.06 rad; half way the pull is half of what it was, and in the end there is none.
    assert place(it.step(11.0, reading(q=0.06))) == pytest.approx(0.0)
    assert place(it.step(11.4, reading(q=0.06))) == pytest.approx(0.03)
    assert it.step(11.8, reading(q=0.06)).position_rad is None
    assert it.phase == "compensating"


def test_free_it_is_asked_for_its_weight_wherever_it_is_led() -> None:
    it = free()
    for k, q in enumerate((0.3, 0.9, -0.5)):
        found = it.step(12.0 + k, reading(q=q, rate=0.4, effort=0.0))
        assert found.position_rad is None
        assert found.effort_nm[0] == pytest.approx(LEVEL_NM * np.cos(q))


@pytest.mark.parametrize("velocity_forces", [False, True])
def test_velocity_forces_are_borne_if_asked_for(velocity_forces: bool) -> None:
    arm = true_weight(load_robot("a2085_03"))
    settings = SETTINGS._replace(velocity_forces=velocity_forces, max_speed_rad_s=5.0)
    it = GravityCompensator(arm, (limits(),) * 3, settings)
    q, rate = np.array([0.1, 0.4, -0.6]), np.array([1.0, 1.5, -1.0])
    at_rest = arm.effort_nm(q, np.zeros(3))
    still = Reading(np.full(3, 0.01), q, np.zeros(3), at_rest)
    for t_s in (10.0, 10.8):
        it.step(t_s, still)
    it.release(11.0)
    it.step(11.8, still)
    found = it.step(12.0, still._replace(qd_rad_s=rate)).effort_nm
    # Newton metres by the tens of milli, of a small arm at a good speed.
    assert np.abs(arm.effort_nm(q, rate) - at_rest).max() > 5e-3
    np.testing.assert_allclose(found, arm.effort_nm(q, rate) if velocity_forces else at_rest, atol=1e-12)


def test_only_what_has_the_gains_of_torque_control_is_set_free() -> None:
    it = compensator()
    it.release(10.0)
    assert it.phase == "loading"


# --------------------------------------------------------------------------- held again


def test_asked_to_hold_it_holds_where_it_is_with_a_grip_that_grows() -> None:
    it = free()
    it.hold(20.0, "asked")
    assert place(it.step(20.0, reading(q=0.7))) == pytest.approx(0.7)
    # It is pushed on while it is taken hold of.
    assert place(it.step(20.2, reading(q=0.9))) == pytest.approx(0.8)
    held = it.step(20.41, reading(q=0.9))
    assert (it.phase, place(held), it.why) == ("held", pytest.approx(0.7), "asked")
    assert not it.is_fault
    # The weight is borne all the time, so that nothing drops.
    assert held.effort_nm[0] == pytest.approx(LEVEL_NM * np.cos(0.9))


def test_the_first_reason_to_hold_is_the_one_that_is_told() -> None:
    it = free()
    it.hold(20.0, "first")
    it.hold(20.1, "second")
    assert it.why == "first"


@pytest.mark.parametrize(
    ("now", "words"),
    [
        (reading(rate=-1.6), "joint J: moved at 1.60 rad/s, at most 1.50 rad/s are allowed"),
        (
            reading(q=1.95),
            "joint J: position 1.95 rad is within 0.10 rad of the end of its range, -2.00 to 2.00",
        ),
        (reading(q=-1.95), "joint J: position -1.95 rad is within 0.10 rad of the end"),
    ],
)
def test_a_joint_beyond_a_limit_is_held_where_it_is_and_named(now: Reading, words: str) -> None:
    it = GravityCompensator(pendulum(), (limits(-2.0, 2.0),), SETTINGS)
    for t_s in (10.0, 10.8):
        it.step(t_s, reading())
    it.release(11.0)
    it.step(11.8, reading())
    found = it.step(12.0, now)
    assert it.phase == "holding"
    assert it.is_fault
    assert words in it.why
    assert place(found) == pytest.approx(now.q_rad[0])


def test_a_pose_that_is_too_heavy_for_the_joint_is_held_at_what_it_can_bear() -> None:
    heavy = pendulum(mass_kg=3.0)
    # Straight down it weighs nothing, level 8.8 Nm, of 7 Nm.
    down = reading(q=np.pi / 2, effort=0.0)
    it = GravityCompensator(heavy, (limits(),), SETTINGS)
    for t_s in (10.0, 10.8):
        it.step(t_s, down)
    it.release(11.0)
    it.step(11.8, down)
    assert it.phase == "compensating"
    found = it.step(12.0, reading(q=0.2, effort=-7.0))
    assert "joint J: this pose needs -8.65 Nm, the limit is 7.00 Nm" in it.why
    assert found.effort_nm[0] == -7.0


def test_held_before_it_is_free_it_keeps_its_full_grip_and_bears_what_it_bore() -> None:
    # The measured torque is 0.3 Nm above the model's; half of the difference is released half way.
    borne = LEVEL_NM - 0.3
    it = compensator()
    it.step(10.0, reading(effort=borne))
    before = it.step(10.4, reading(effort=borne))
    assert before.effort_nm[0] == pytest.approx(borne + 0.15)
    it.hold(10.4, "asked")
    # The position loop holds the place that it held, however far the joint has sunk, and no effort steps:
    # 5 ms of a ramp of 0.4 s are 1/80 of it.
    after = it.step(10.405, reading(q=0.02, effort=borne))
    assert place(after) == place(before) == 0.0
    assert abs(after.effort_nm[0] - before.effort_nm[0]) < 0.15 / 79
    held = it.step(10.81, reading(q=0.02, effort=borne))
    assert (it.phase, place(held), it.is_fault) == ("held", 0.0, False)
    assert held.effort_nm[0] == pytest.approx(borne)


def test_an_unknown_load_is_found_at_the_first_step_and_borne_from_then_on() -> None:
    # A tool as heavy as the arm: by the weight that is known it would sink.
    borne = 2.0 * LEVEL_NM
    it = compensator()
    for t_s in (10.0, 10.02, 10.3, 10.5, 10.9):
        now = it.step(t_s, reading(q=0.02 * (t_s - 10.0), effort=borne))
        assert it.is_fault
        assert (place(now), now.effort_nm[0]) == (0.0, pytest.approx(borne))
    assert it.phase == "held"


def test_held_before_its_first_step_it_bears_what_it_bore() -> None:
    it = compensator()
    it.hold(10.0, "asked")
    first = it.step(10.0, reading(effort=2.0 * LEVEL_NM))
    assert (place(first), first.effort_nm[0]) == (0.0, pytest.approx(2.0 * LEVEL_NM))


def test_an_unknown_load_that_shows_in_the_end_of_loading_is_borne_and_held_where_it_was() -> None:
    it = compensator()
    it.step(10.0, reading(q=0.05))
    for t_s in np.arange(10.05, 10.8, 0.05):
        last = it.step(float(t_s), reading(q=0.05, effort=LEVEL_NM - 1.0))
    first = it.step(10.8, reading(q=0.06, effort=LEVEL_NM - 1.0))
    assert it.is_fault
    assert "Remove any payload or contact" in it.why
    assert place(first) == place(last) == pytest.approx(0.05)
    assert first.effort_nm[0] == pytest.approx(last.effort_nm[0], abs=0.05)


def test_taken_hold_of_while_it_is_being_set_free_the_pull_goes_on_as_it_is() -> None:
    it = loaded()
    it.release(11.0)
    before = it.step(11.4, reading(q=0.06))
    it.hold(11.4, "asked")
    after = it.step(11.405, reading(q=0.06))
    # Half of the way to the place that it held, and full grip on that from here on.
    assert place(before) == place(after) == pytest.approx(0.03)
    assert place(it.step(11.41, reading(q=0.08))) == pytest.approx(0.03)


@pytest.mark.parametrize("is_releasing", [False, True])
def test_a_joint_that_sinks_before_it_is_free_is_held(is_releasing: bool) -> None:
    it = loaded() if is_releasing else compensator()
    if is_releasing:
        it.release(11.0)
    most = MAX_RELEASE_MOTION_RAD if is_releasing else MAX_LOADING_MOTION_RAD
    it.step(11.0, reading())
    it.step(11.2, reading(q=0.9 * most))
    assert not it.is_fault
    it.step(11.3, reading(q=1.1 * most))
    assert (it.phase, it.is_fault) == ("holding", True)
    reported = (
        "5.5 degrees from its held position before the release, at most 5.0"
        if is_releasing
        else "16.5 degrees from"
    )
    assert f"joint J: {reported}" in it.why


# --------------------------------------------------------------------------- led back


def returning() -> GravityCompensator:
    """Led from 0 to 0.8 rad, held there, and on its way back from 30 s on."""
    it = free()
    it.hold(20.0, "asked")
    for t_s in (20.0, 20.5):
        it.step(t_s, reading(q=0.8))
    it.return_to(30.0, np.zeros(1))
    return it


def test_led_back_it_goes_to_where_it_stood_at_the_speed_that_is_promised() -> None:
    it = returning()
    times = np.arange(30.0, 33.2, 0.005)
    q, rates = [0.8], []
    for t_s in times:
        now = it.step(float(t_s), reading(q=q[-1]))
        q.append(place(now))
        rates.append(float(now.velocity_rad_s[0]))
        # The weight where it is.
        assert now.effort_nm[0] == pytest.approx(LEVEL_NM * np.cos(q[-2]))
    assert (it.phase, q[-1], it.why, it.is_fault) == ("held", 0.0, "asked", False)
    assert np.abs(rates).max() == pytest.approx(0.5, rel=1e-3)
    np.testing.assert_allclose(np.diff(q[1:]) / 0.005, rates[:-1], atol=0.01)


def test_a_float_with_a_low_speed_limit_is_led_back_below_it() -> None:
    it = GravityCompensator(pendulum(), (limits(),), SETTINGS._replace(max_speed_rad_s=0.4))
    it.step(10.0, reading(q=0.5, effort=LEVEL_NM))
    it.hold(10.0, "asked")
    for t_s in (10.1, 10.5):
        it.step(t_s, reading(q=0.5))
    it.return_to(11.0, np.zeros(1))
    # Half way it is the fastest: 15/8 of 0.5 rad in 4.7 s.
    half_s = 11.0 + 0.5 * 1.875 * 0.5 / 0.2
    assert it.step(half_s, reading(q=0.25)).velocity_rad_s[0] == pytest.approx(-0.2)


def test_asked_to_hold_on_its_way_back_it_stops_where_it_is() -> None:
    it = returning()
    here = place(it.step(31.5, reading(q=0.4)))
    it.hold(31.5, "asked again")
    stopped = it.step(31.505, reading(q=0.4))
    assert (it.phase, it.why) == ("holding", "asked")
    assert place(stopped) == pytest.approx(here)
    assert stopped.velocity_rad_s[0] == 0.0
    # With full grip, and there it stays.
    assert place(it.step(33.0, reading(q=0.45))) == pytest.approx(here)


def test_what_stops_it_on_its_way_back_is_not_pushed_against() -> None:
    it = returning()
    for t_s in (30.0, 30.5):
        it.step(t_s, reading(q=0.79))
    assert it.phase == "returning"
    stopped = it.step(31.0, reading(q=0.76))
    assert (it.phase, it.is_fault) == ("holding", True)
    assert "degrees behind on the way back, at most 4.6 are allowed" in it.why
    assert place(stopped) == pytest.approx(0.76)


# --------------------------------------------------------------------------- not set free


def test_a_robot_too_heavy_where_it_stands_or_at_its_end_is_refused_before_it_is_taken() -> None:
    with pytest.raises(CompensationRefused, match=r"joint J: this pose needs -8.83 Nm, the limit is 7.00 Nm"):
        GravityCompensator(pendulum(mass_kg=3.0), (limits(),), SETTINGS).check_start(reading())
    with pytest.raises(
        CompensationRefused, match=r"joint J: position 0.95 rad is within 0.10 rad of the end"
    ):
        compensator(limits(-1.0, 1.0)).check_start(reading(q=0.95))
    compensator(limits(-1.0, 1.0)).check_start(reading(q=0.85, effort=LEVEL_NM * np.cos(0.85)))


@pytest.mark.parametrize(("share", "is_free"), [(0.9, True), (1.1, False)])
@pytest.mark.parametrize("q", [0.0, np.pi / 2])
def test_a_robot_that_bears_another_load_than_the_known_one_is_not_set_free(
    share: float, is_free: bool, q: float
) -> None:
    model = LEVEL_NM * np.cos(q)
    most = MAX_OFFSET_OF_WEIGHT * abs(model) + MAX_OFFSET_OF_EFFORT * X5_4.max_effort_nm
    # 0.33 Nm level, 0.14 Nm hanging: a third of a kilogram at the end of the one of 0.8 kg is 1 Nm.
    assert most < 0.35
    unknown = reading(q=q, effort=model - share * most)
    it = compensator()
    for t_s in (10.0, 10.8, 10.9):
        it.step(t_s, unknown)
    assert it.is_fault != is_free
    assert it.phase == ("loaded" if is_free else "held")
    assert is_free or "Remove any payload or contact" in it.why
    if is_free:
        compensator().check_start(unknown)
    else:
        with pytest.raises(CompensationRefused, match=r"measured .* Nm, model predicts .* Nm"):
            compensator().check_start(unknown)


def test_feedback_that_is_too_old_ends_it_in_any_phase_and_names_the_module() -> None:
    for it in (compensator(), loaded(), free()):
        with pytest.raises(StaleFeedback, match="module J: newest feedback is 130 ms old, at most 120 ms"):
            it.step(20.0, reading(age_s=0.13))
        it.step(20.0, reading(age_s=0.11))


# --------------------------------------------------------------------------- gains


def test_under_the_gains_of_floating_nothing_but_the_damper_answers_a_velocity() -> None:
    gains = compensation_gains(X5_4, 0.7)
    assert gains.strategy == 2
    assert (gains.velocity.kp, gains.velocity.ki, gains.velocity.kd) == (0.7, 0.0, 0.0)
    assert gains.velocity.feed_forward == 0.0
    assert compensation_gains(X5_4, 0.0).velocity.kp == 0.0
    # The factory's 10 Nm/rad.
    assert holding_gains(X5_4).position.kp == 10.0 * HOLDING_TIMES
    assert holding_gains(X5_4).velocity.kp > 0.0


@pytest.mark.parametrize("damping", [-0.1, float("nan"), float("inf"), 1e6, 1.3])
def test_a_damping_that_no_module_can_give_makes_no_gains(damping: float) -> None:
    with pytest.raises(UsageError, match=r"module type X5-4 takes 0 to 1\.2 Nm s/rad"):
        compensation_gains(X5_4, damping)
    assert compensation_gains(X5_4, max_damping_nm_s_rad(X5_4)).velocity.kp == pytest.approx(1.2)

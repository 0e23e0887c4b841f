"""The course of a float, step by step: a pendulum of one joint, held, set free, and held again."""

import numpy as np
import pytest

from coordinator.floating import (
    HOLDING_TIMES,
    MOST_UNKNOWN,
    Floater,
    FloatRefused,
    FloatSettings,
    Reading,
    StaleFeedback,
    Targets,
    floating_gains,
    holding_gains,
)
from coordinator.known_weight import KnownWeight
from module_agent.catalogue import CATALOGUE
from module_agent.dynamics.chain import Chain
from module_agent.firmware.config import catalogue_limits
from module_agent.wire.messages import Limits
from sim.experiments.floating import true_weight
from sim.robot_file import load_robot

X5_4 = CATALOGUE["X5-4"]
G_M_S2, MASS_KG, REACH_M = 9.81, 0.8, 0.3
LEVEL_NM = -MASS_KG * REACH_M * G_M_S2
SETTINGS = FloatSettings(ramp_s=0.8, hold_s=0.4, stale_s=0.12)


def pendulum(mass_kg: float = MASS_KG) -> KnownWeight:
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
    return KnownWeight("pendulum", ("X5-4",), chain, phi)


def limits(low: float | None = None, high: float | None = None) -> Limits:
    return catalogue_limits(X5_4).model_copy(update={"min_position_rad": low, "max_position_rad": high})


def reading(q: float = 0.0, rate: float = 0.0, effort: float = LEVEL_NM, age_s: float = 0.01) -> Reading:
    return Reading(*(np.array([value]) for value in (age_s, q, rate, effort)))


def floater(of: Limits | None = None, settings: FloatSettings = SETTINGS) -> Floater:
    return Floater(pendulum(), (of or limits(),), settings)


def loaded() -> Floater:
    found = floater()
    for t_s in (10.0, 10.8):
        found.step(t_s, reading())
    assert found.phase == "loaded"
    return found


def free() -> Floater:
    found = loaded()
    found.let_go(11.0)
    found.step(11.8, reading())
    assert found.phase == "floating"
    return found


def place(targets: Targets) -> float:
    assert targets.position_rad is not None
    return float(targets.position_rad[0])


# --------------------------------------------------------------------------- set free


def test_before_it_is_set_free_the_joint_goes_over_from_the_torque_that_it_bears_to_its_weight() -> None:
    it = floater()
    borne = LEVEL_NM + 0.4
    first, middle = it.step(10.0, reading(effort=borne)), it.step(10.4, reading(effort=borne))
    assert first.effort_nm[0] == pytest.approx(borne)
    assert middle.effort_nm[0] == pytest.approx(0.5 * (borne + LEVEL_NM))
    assert (place(first), place(middle)) == (0.0, 0.0)
    assert it.step(10.7, reading(effort=borne)).effort_nm[0] == pytest.approx(LEVEL_NM + 0.05)
    it.step(10.8, reading(effort=borne))
    assert it.phase == "loaded"


def test_what_a_sensor_reads_beside_the_weight_before_it_is_free_is_borne_with_the_weight() -> None:
    it = floater()
    rng = np.random.default_rng(1)
    for t_s in np.arange(10.0, 10.81, 0.005):
        # 0.3 Nm of offset and some noise.
        it.step(float(t_s), reading(effort=LEVEL_NM + 0.3 + rng.normal(0.0, 0.05)))
    it.let_go(11.0)
    it.step(11.8, reading())
    # The mean of some fifty readings.
    led = it.step(12.0, reading(q=0.9, effort=0.0)).effort_nm[0]
    assert led == pytest.approx(LEVEL_NM * np.cos(0.9) + 0.3, abs=0.03)


def test_where_it_has_given_while_it_was_held_softly_it_is_not_snatched_back() -> None:
    it = floater()
    it.step(10.0, reading())
    it.step(10.8, reading(q=0.2))
    assert it.phase == "loaded"
    assert place(it.step(10.9, reading(q=0.2))) == pytest.approx(0.2)


def test_the_position_loop_lets_go_little_by_little_and_pulls_to_where_it_held() -> None:
    it = loaded()
    it.let_go(11.0)
    # The joint has given by 0.2 rad; half way the pull is half of what it was, and in the end there is none.
    assert place(it.step(11.0, reading(q=0.2))) == pytest.approx(0.0)
    assert place(it.step(11.4, reading(q=0.2))) == pytest.approx(0.1)
    assert it.step(11.8, reading(q=0.2)).position_rad is None
    assert it.phase == "floating"


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
    it = Floater(arm, (limits(),) * 3, settings)
    q, rate = np.array([0.1, 0.4, -0.6]), np.array([1.0, 1.5, -1.0])
    at_rest = arm.effort_nm(q, np.zeros(3))
    still = Reading(np.full(3, 0.01), q, np.zeros(3), at_rest)
    for t_s in (10.0, 10.8):
        it.step(t_s, still)
    it.let_go(11.0)
    it.step(11.8, still)
    found = it.step(12.0, still._replace(qd_rad_s=rate)).effort_nm
    # Newton metres by the tens of milli, of a small arm at a good speed.
    assert np.abs(arm.effort_nm(q, rate) - at_rest).max() > 5e-3
    np.testing.assert_allclose(found, arm.effort_nm(q, rate) if velocity_forces else at_rest, atol=1e-12)


def test_only_what_has_the_gains_of_torque_control_is_set_free() -> None:
    it = floater()
    it.let_go(10.0)
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
        (reading(rate=-1.6), "joint J went 1.60 rad/s, at most 1.50 rad/s are allowed"),
        (reading(q=1.95), "joint J is at 1.95 rad, within 0.10 rad of the end of its range, -2.00 to 2.00"),
        (reading(q=-1.95), "joint J is at -1.95 rad, within 0.10 rad of the end"),
    ],
)
def test_a_joint_beyond_a_limit_is_held_where_it_is_and_named(now: Reading, words: str) -> None:
    it = Floater(pendulum(), (limits(-2.0, 2.0),), SETTINGS)
    for t_s in (10.0, 10.8):
        it.step(t_s, reading())
    it.let_go(11.0)
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
    it = Floater(heavy, (limits(),), SETTINGS)
    for t_s in (10.0, 10.8):
        it.step(t_s, down)
    it.let_go(11.0)
    it.step(11.8, down)
    assert it.phase == "floating"
    found = it.step(12.0, reading(q=0.2, effort=-7.0))
    assert "joint J would have to bear -8.65 Nm here, it can bear 7.00 Nm" in it.why
    assert found.effort_nm[0] == -7.0


# --------------------------------------------------------------------------- not set free


def test_a_robot_too_heavy_where_it_stands_or_at_its_end_is_refused_before_it_is_taken() -> None:
    with pytest.raises(FloatRefused, match=r"joint J would have to bear -8.83 Nm here, it can bear 7.00 Nm"):
        Floater(pendulum(mass_kg=3.0), (limits(),), SETTINGS).check_start(reading())
    with pytest.raises(FloatRefused, match=r"joint J is at 0.95 rad, within 0.10 rad of the end"):
        floater(limits(-1.0, 1.0)).check_start(reading(q=0.95))
    floater(limits(-1.0, 1.0)).check_start(reading(q=0.85))


@pytest.mark.parametrize(("share", "is_free"), [(0.9, True), (1.1, False)])
def test_a_robot_that_bears_another_load_than_the_known_one_is_not_set_free(
    share: float, is_free: bool
) -> None:
    it = floater()
    strange = reading(effort=LEVEL_NM - share * MOST_UNKNOWN * X5_4.max_effort_nm)
    for t_s in (10.0, 10.8, 10.9):
        it.step(t_s, strange)
    assert it.is_fault != is_free
    assert it.phase == ("loaded" if is_free else "holding")
    assert is_free or "it carries something, leans on something" in it.why


def test_feedback_that_is_too_old_ends_it_in_any_phase_and_names_the_module() -> None:
    for it in (floater(), loaded(), free()):
        with pytest.raises(StaleFeedback, match="module J was last heard 130 ms ago, at most 120 ms"):
            it.step(20.0, reading(age_s=0.13))
        it.step(20.0, reading(age_s=0.11))


# --------------------------------------------------------------------------- gains


def test_under_the_gains_of_floating_nothing_but_the_damper_answers_a_velocity() -> None:
    gains = floating_gains(X5_4, 0.7)
    assert gains.strategy == 2
    assert (gains.velocity.kp, gains.velocity.ki, gains.velocity.kd) == (0.7, 0.0, 0.0)
    assert gains.velocity.feed_forward == 0.0
    assert floating_gains(X5_4, 0.0).velocity.kp == 0.0
    # The factory's 10 Nm/rad.
    assert holding_gains(X5_4).position.kp == 10.0 * HOLDING_TIMES
    assert holding_gains(X5_4).velocity.kp > 0.0

"""Motions of all joints at once differ in frequency, stay within limits, and rest at both ends."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.excitation.joint_limits import (
    JointLimits,
    NoExcitation,
    continuous_torque_nm,
    joint_limits,
    least_accel_rad_s2,
    likely_inertia_kg_m2,
)
from coordinator.excitation.multisine import simultaneous_duration_s, simultaneous_patterns
from module_agent.control.gains import catalogue_limits
from module_agent.control.motion import Motion, check_motion
from module_agent.control.waveform import duration_s, waveform
from module_agent.model.catalogue import CATALOGUE, GRAVITY_M_S2, ModuleType
from module_agent.wire.messages import MultiSine

TYPES = list(CATALOGUE.values())
STEP_S = 2e-3


def limits_of(kinds: list[ModuleType], inertia: float, rest_torque_nm: float) -> dict[str, JointLimits]:
    return {f"M{k:02d}": joint_limits(kind, rest_torque_nm, inertia) for k, kind in enumerate(kinds)}


def sampled(pattern: MultiSine) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t = np.arange(0.0, duration_s(pattern, 0.0), STEP_S)
    found = waveform(pattern, 0.0, t)
    return found.offset_rad, found.velocity_rad_s, np.gradient(found.velocity_rad_s, t)


@settings(deadline=None, max_examples=40)
@given(
    st.lists(st.sampled_from(TYPES), min_size=1, max_size=8),
    st.floats(0.003, 5.0),
    st.floats(-12.0, 12.0),
    st.floats(-0.8, 0.8),
)
def test_no_joint_is_asked_for_more_speed_torque_or_room_than_it_has(
    kinds: list[ModuleType], inertia: float, torque: float, home: float
) -> None:
    asked = limits_of(kinds, inertia, torque)
    if any(one.accel_rad_s2 <= 0.0 for one in asked.values()):
        with pytest.raises(NoExcitation, match="cannot move about"):
            simultaneous_patterns(asked, home)
        return
    for kind, (serial, pattern) in zip(
        kinds, sorted(simultaneous_patterns(asked, home).items()), strict=True
    ):
        offset, velocity, acceleration = sampled(pattern)
        limits = asked[serial]
        assert np.abs(velocity).max() <= 1.001 * limits.speed_rad_s < 0.75 * kind.max_speed_rad_s
        # Samples miss the peaks by a thousandth at most.
        assert np.abs(acceleration).max() <= 1.001 * limits.accel_rad_s2
        assert limits.low_rad < home + offset.min()
        assert home + offset.max() < limits.high_rad
        check_motion(Motion(pattern, home, 0), catalogue_limits(kind))


@pytest.mark.parametrize("count", [2, 6, 7, 16])
def test_the_rates_of_any_two_joints_are_nearly_orthogonal(count: int) -> None:
    kinds = [TYPES[k % len(TYPES)] for k in range(count)]
    patterns = simultaneous_patterns(limits_of(kinds, likely_inertia_kg_m2(kinds), 0.0), 0.0)
    rates = np.array([sampled(p)[1] for p in patterns.values()])
    alike = np.abs(rates @ rates.T) / np.outer(*[np.linalg.norm(rates, axis=1)] * 2)
    np.fill_diagonal(alike, 0.0)
    # The regression takes out what is left: correlations of 0.9 are where it refuses to.
    assert alike.max() < 0.6
    accelerations = np.array([sampled(p)[2] for p in patterns.values()])
    alike = np.abs(accelerations @ accelerations.T)
    size = np.linalg.norm(accelerations, axis=1)
    np.fill_diagonal(alike, 0.0)
    assert (alike / np.outer(size, size)).max() < 0.4


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.name)
def test_the_motion_begins_and_ends_at_rest_where_it_began(kind: ModuleType) -> None:
    (pattern,) = simultaneous_patterns(limits_of([kind], 0.1, 0.0), 0.0).values()
    ends = waveform(pattern, 0.0, np.array([0.0, pattern.duration_s]))
    assert ends.offset_rad == pytest.approx([0.0, 0.0], abs=1e-12)
    assert ends.velocity_rad_s == pytest.approx([0.0, 0.0], abs=1e-12)


def test_six_joints_take_eleven_seconds_and_sixteen_somewhat_longer() -> None:
    assert simultaneous_duration_s(6) == 11.0
    assert 15.0 < simultaneous_duration_s(16) < 20.0


def test_a_joint_at_its_end_stop_is_named() -> None:
    asked = limits_of([CATALOGUE["SEA-snake"]], 0.1, 0.0)
    with pytest.raises(NoExcitation, match=r"M00 cannot move about 1\.50 rad: its range is -1\.41 "):
        simultaneous_patterns(asked, 1.5)


def test_a_motion_never_takes_the_torque_that_holds_the_arm() -> None:
    kind = CATALOGUE["X5-9"]
    assert continuous_torque_nm(kind) < kind.max_effort_nm
    light, heavy = joint_limits(kind, 0.0, 1.0), joint_limits(kind, 8.0, 1.0)
    assert light.accel_rad_s2 == pytest.approx(continuous_torque_nm(kind))
    # Gravity alone takes more than the continuous torque: a tenth of the type's is left to a short motion.
    assert heavy.accel_rad_s2 == pytest.approx(0.1 * kind.max_effort_nm)
    assert joint_limits(kind, 12.0, 1.0).accel_rad_s2 == 0.0


def test_the_continuous_torque_warms_the_winding_to_its_limit() -> None:
    for kind in TYPES:
        motor = kind.motor
        current = continuous_torque_nm(kind) / (
            motor.torque_constant_nm_a * kind.gear_ratio * motor.efficiency
        )
        # 13.6 K/W to the room and 51 % more resistance at 155 C, see the module's text.
        rise_k = current**2 * motor.resistance_ohm * 1.51 * 13.63
        assert rise_k < 131.0


@pytest.mark.parametrize("count", [2, 7, 16])
def test_an_arm_that_holds_itself_level_can_always_move_a_little(count: int) -> None:
    level_nm, inertia = (
        1.0,
        1.0 / (0.5 * GRAVITY_M_S2) * (0.12 * count) / 3.0,
    )  # per m g L / 2 of a uniform arm
    assert least_accel_rad_s2(count) * inertia == pytest.approx(0.05 * level_nm)
    # Fast enough for the slow sine's rate to stand out of a gyro's errors of some mrad/s.
    limits = JointLimits(1.0, least_accel_rad_s2(count), -3.0, 3.0)
    asked = {f"M{k:02d}": limits for k in range(count)}
    for pattern in simultaneous_patterns(asked, 0.0).values():
        assert np.sqrt(np.mean(sampled(pattern)[1] ** 2)) > 0.02


def test_an_inertia_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="it must be positive"):
        joint_limits(CATALOGUE["X5-1"], 0.0, 0.0)


def test_limits_leave_room_on_both_sides() -> None:
    limits = JointLimits(1.0, 1.0, -1.0, 2.0)
    assert limits.room_rad(0.0) == 1.0
    assert limits.room_rad(1.5) == 0.5

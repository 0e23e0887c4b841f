"""The motions of a joint are the most informative of those within its limits and time budget."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.excitation.joint_limits import JointLimits, NoExcitation, joint_limits, motion_peaks
from coordinator.excitation.single_joint import JointTask, design_joint, predicted_sigma_m
from module_agent.control.gains import catalogue_limits
from module_agent.control.motion import Motion, check_motion
from module_agent.control.waveform import duration_s, waveform
from module_agent.model.catalogue import CATALOGUE, ModuleType
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import CALIBRATED, UNCALIBRATED
from module_agent.wire.messages import WindowedSine

TYPES = list(CATALOGUE.values())
TASK = JointTask(
    limits=JointLimits(2.0, 10.0, -3.0, 3.0),
    along=0.0,
    prior=CALIBRATED,
    home_rad=0.0,
    travel_speed_rad_s=1.0,
    settle_s=0.3,
    budget_s=8.0,
)


@settings(deadline=None, max_examples=20)
@given(
    st.sampled_from(TYPES),
    st.floats(0.005, 3.0),
    st.floats(-5.0, 5.0),
    st.floats(-0.5, 0.5),
    st.floats(7.0, 12.0),
)
def test_no_type_is_asked_for_more_than_it_can_do_and_the_time_is_kept(
    kind: ModuleType, inertia: float, torque: float, home: float, budget: float
) -> None:
    limits = joint_limits(kind, torque, inertia)
    task = TASK._replace(limits=limits, home_rad=home, budget_s=budget)
    if limits.accel_rad_s2 <= 0.0:
        with pytest.raises(NoExcitation, match="no motion fits"):
            design_joint(task)
        return
    try:
        found = design_joint(task)
    except DataError:
        # A joint that hardly accelerates does not get through its sweep in time.
        assert limits.accel_rad_s2 < 0.7
        return
    assert found.time_s <= budget + 1e-9
    travel = found.constant.velocity_rad_s * (found.constant.duration_s + found.constant.ramp_s)
    for pattern, origin in ((found.constant, home - 0.5 * travel), (found.sine, home)):
        speed, accel = motion_peaks(pattern, origin)
        assert speed <= 1.001 * limits.speed_rad_s < 0.75 * kind.max_speed_rad_s
        assert accel <= 1.01 * limits.accel_rad_s2
        t = np.linspace(0.0, duration_s(pattern, origin), 2001)
        samples = waveform(pattern, origin, t)
        assert limits.low_rad <= origin + samples.offset_rad.min() + 1e-9
        assert origin + samples.offset_rad.max() <= limits.high_rad + 1e-9
        assert samples.velocity_rad_s[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-12)
        check_motion(Motion(pattern, origin, 0), catalogue_limits(kind))


def test_no_other_frequency_or_sweep_within_the_limits_leaves_less_error() -> None:
    best = design_joint(TASK)
    for frequency_hz in (0.8, 1.0, 1.4, 2.0):
        other = best.sine.model_copy(update={"frequency_hz": frequency_hz})
        speed, accel = motion_peaks(other)
        scale = min(1.0, TASK.limits.speed_rad_s / speed, TASK.limits.accel_rad_s2 / accel)
        other = other.model_copy(update={"amplitude": scale * other.amplitude})
        give = TASK.radius_m * (frequency_hz / 13.0) ** 2
        assert np.hypot(predicted_sigma_m(TASK, [best.constant, other]), give) >= best.error_m


def test_a_second_of_the_same_motion_makes_noise_less_by_the_root_of_two_and_errors_of_scale_not() -> None:
    sine = WindowedSine(amplitude=0.2, frequency_hz=0.8, centre_s=2.0, sigma_s=0.7)
    # Biases of which nothing is known beforehand: a prior would count once, and a second motion for less.
    open_bias = TASK._replace(prior=TASK.prior._replace(accel_bias_m_s2=1.0))
    once, twice = (predicted_sigma_m(open_bias, [sine] * n) for n in (1, 2))
    assert twice == pytest.approx(once / np.sqrt(2.0), rel=0.1)
    flat = TASK._replace(prior=UNCALIBRATED, along=1.0)
    once, twice = (predicted_sigma_m(flat, [sine] * n) for n in (1, 2))
    assert twice > 0.85 * once


def test_a_level_axis_lets_gravity_calibrate_what_an_upright_one_leaves_open() -> None:
    level, upright = (design_joint(TASK._replace(prior=UNCALIBRATED, along=a)) for a in (0.0, 1.0))
    assert level.sigma_m < 0.6 * upright.sigma_m


def test_a_joint_that_hardly_accelerates_is_given_a_slower_sweep() -> None:
    weak = TASK._replace(limits=TASK.limits._replace(accel_rad_s2=0.8), budget_s=10.0)
    assert design_joint(weak).constant.velocity_rad_s < design_joint(TASK).constant.velocity_rad_s


def test_without_time_or_room_that_is_said_with_the_figures() -> None:
    with pytest.raises(NoExcitation, match=r"no motion fits: 2\.0 s, 3\.00 rad to either side"):
        design_joint(TASK._replace(budget_s=2.0))
    with pytest.raises(NoExcitation, match=r"0\.10 rad to either side"):
        design_joint(TASK._replace(home_rad=2.9))

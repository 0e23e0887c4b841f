"""The joint regression on the simulated one-joint arm, against the thesis' estimator and the bound."""

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from module_agent.estimate.observed_motion import observed_motions
from module_agent.model.imu_prior import CALIBRATED, UNCALIBRATED
from sim.imperfections.noise_profile import NOISE_PROFILES, switched
from sim.robot.robot_file import load_robot
from sim.test_bench.one_joint_rig import OneJointRig, TrialRows, regress, windows
from sim.thesis.kinematics.joint_trial import (
    JointTrial,
    bound_m,
    imu_knowledge,
    joint_trial,
    trial_plan,
    white_noise,
)
from sim.thesis.published import Alignment, thesis_length

SOLID = switched(NOISE_PROFILES["x5"], off=("base-shake",))


def judged(found: JointTrial) -> None:
    assert abs(found.ours_error_m) < 4.0 * found.ours_sigma_m
    assert found.thesis_error_m is not None
    assert abs(found.ours_error_m) < abs(found.thesis_error_m)


@pytest.mark.parametrize(("length_mm", "alignment"), [(484, "horizontal"), (171, "vertical")])
def test_on_a_solid_base_the_length_is_found_to_the_bound(length_mm: int, alignment: Alignment) -> None:
    found = joint_trial(length_mm, alignment, SOLID, seed=3)
    judged(found)
    assert 2e-5 < found.bound_m < 2e-4
    assert abs(found.ours_error_m) < 4.0 * found.bound_m
    assert found.ours_sigma_m < 2.0 * found.bound_m
    assert found.axis_error_deg < 0.1
    # Rest, three ways, slow and fast motion.
    assert 10.0 < found.robot_time_s < 20.0


def test_the_length_ends_where_the_imu_sits_and_not_where_the_catalogue_has_it() -> None:
    built = SOLID.model_copy(update={"imu_place_m": 0.02, "housing_axis_m": 1e-3, "housing_axis_rad": 0.01})
    found = joint_trial(171, "vertical", built, seed=3)
    judged(found)
    assert abs(found.ours_error_m) < 4.0 * found.bound_m
    assert found.axis_error_deg < 0.1


def test_a_tall_base_that_rocks_is_seen_by_the_joints_own_module_and_taken_off() -> None:
    robot = load_robot("thesis_484_vertical")
    plan = trial_plan(thesis_length("vertical", 484), NOISE_PROFILES["x5"])
    with OneJointRig(robot, 3, "x5") as rig:
        trial = rig.trial(plan)
    assert all(motion.base is not None and motion.base.shakes for motion in observed_motions(windows(trial)))
    found = regress(trial)
    assert found.base_shakes
    # It rocks by 3 % of the joint's angle: 5 to 10 mm of error unless it is taken off (measured).
    assert found.distance_m == pytest.approx(0.484, abs=1.5e-3)
    blind = regress(without_carrier(trial))
    assert not blind.base_shakes
    assert abs(blind.distance_m - 0.484) > 3e-3


def test_where_gravity_tells_no_direction_the_fit_settles_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with OneJointRig(load_robot("thesis_484_horizontal"), 11, "x5") as rig:
        trial = rig.trial(trial_plan(thesis_length("horizontal", 484), NOISE_PROFILES["x5"]))
    found = regress(trial)
    assert found.base_shakes
    monkeypatch.setattr("module_agent.estimate.joint_regression.ITERATIONS", 40)
    assert regress(trial).distance_m == pytest.approx(found.distance_m, abs=1e-6)


def without_carrier(trial: TrialRows) -> TrialRows:
    """The same trial with a joint whose own IMU is dead."""
    motions = []
    for motion in (trial.constant, trial.sine):
        rows = motion.joint.copy()
        rows["gyro_rad_s"], rows["accel_m_s2"] = 0.0, 0.0
        motions.append(motion._replace(joint=rows))
    return trial._replace(constant=motions[0], sine=motions[1])


def test_noise_of_the_gears_is_not_taken_for_a_shaking_base() -> None:
    with OneJointRig(load_robot("thesis_245_horizontal"), 5, SOLID) as rig:
        trial = rig.trial(Plan(sine_amplitude_rad=0.2))
    assert not any(
        motion.base is not None and motion.base.shakes for motion in observed_motions(windows(trial))
    )
    assert not regress(trial).base_shakes


def test_an_arm_with_an_imu_as_delivered_swings_about_where_gravity_can_calibrate_it() -> None:
    delivered = NOISE_PROFILES["x5-uncalibrated"]
    assert trial_plan(thesis_length("vertical", 350), delivered).home_rad == pytest.approx(-np.pi / 2)
    assert trial_plan(thesis_length("horizontal", 350), delivered).home_rad == 0.0
    assert trial_plan(thesis_length("vertical", 350), SOLID).home_rad == 0.0
    assert (imu_knowledge(delivered), imu_knowledge(SOLID)) == (UNCALIBRATED, CALIBRATED)
    found = joint_trial(350, "vertical", delivered, seed=2)
    # One such trial of the thesis' may be right by chance: its errors and the scale's may cancel.
    assert abs(found.ours_error_m) < 4.0 * found.ours_sigma_m
    # The scale is wrong by 1 % rms. Gravity's strength is believed to 0.2 %.
    assert abs(found.ours_error_m) < 0.005 * 0.350
    assert found.ours_sigma_m < 0.005 * 0.350


def test_the_bound_falls_with_the_noise() -> None:
    """Everything else unknown is estimated from the same readings, so the bound is in proportion to them."""
    with OneJointRig(load_robot("thesis_171_horizontal"), 1, SOLID) as rig:
        trial = rig.trial(Plan(sine_amplitude_rad=0.2))
    halved = SOLID.model_copy(
        update={
            name: 0.5 * getattr(SOLID, name)
            for name in ("accel_white_m_s2", "gyro_white_rad_s", "accel_step_m_s2", "gyro_step_rad_s")
        }
    )
    assert white_noise(halved) == pytest.approx(tuple(0.5 * size for size in white_noise(SOLID)))
    # What is believed beforehand does not shrink with the noise.
    assert 0.5 * bound_m(trial, SOLID) <= bound_m(trial, halved) < 0.7 * bound_m(trial, SOLID)

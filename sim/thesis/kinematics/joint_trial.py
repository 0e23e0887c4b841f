"""The Cramer-Rao bound of one joint's radial distance, for one recording.

The bound is that of an estimator that knows the noise of the IMU and the joint's true motion. Its unknowns
are those of `joint_regression`: axis, radial vector, gravity, biases, delays, the link's compliance, and
scales and axes of the sensors with their prior (which makes it the Bayesian bound of van Trees). The prior of
a calibrated IMU is 1e-4, while the simulated one has no error of scale and axes at all; with that knowledge
the bound is lower by a third at 484 mm, and by a hundredth to a tenth at 171 mm. The hinge of a bent link is
known.
"""

from math import acos, degrees, pi
from typing import NamedTuple

import numpy as np

from coordinator.excitation.plan import Plan
from module_agent.estimate.circle_point_analysis import rest_reading
from module_agent.estimate.joint_regression import distance_bound_m
from module_agent.estimate.observed_motion import observed_motions
from module_agent.estimate.windows import imu_window
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import CALIBRATED, IMU_PRIORS, ImuPrior
from sim.imperfections.noise_profile import NoiseProfile, imu_kind
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import sensing_chain
from sim.robot.variants import at_random_site
from sim.scoring.chain_score import link_length_m
from sim.test_bench.one_joint_rig import IMU, JOINT, OneJointRig, TrialRows, analyse, regress, windows
from sim.thesis.published import Alignment, ThesisLength, thesis_length

# Passes 2 Hz with 0.998, and removes the encoder's counts, which would look like information.
_LIGHTLY_S = 0.010


def imu_knowledge(profile: NoiseProfile) -> ImuPrior:
    """Return the prior of an IMU under this profile."""
    return IMU_PRIORS[imu_kind(profile)]


def white_noise(profile: NoiseProfile) -> tuple[float, float]:
    """Return the white noise of one sample of gyro [rad/s] and accelerometer [m/s^2], with its steps.

    That is an IMU whose own motor stands: vibration is what its own gears make.
    """
    gyro = np.hypot(profile.gyro_white_rad_s, profile.gyro_step_rad_s / np.sqrt(12.0))
    accel = np.hypot(profile.accel_white_m_s2, profile.accel_step_m_s2 / np.sqrt(12.0))
    return float(gyro), float(accel)


def bound_m(trial: TrialRows, profile: NoiseProfile) -> float:
    """Return the bound of the distance [m] for one trial.

    Raises:
        ValueError: too little motion, with what would be enough.
    """
    rest = rest_reading(imu_window(trial.rest))
    motions = observed_motions(windows(trial), _LIGHTLY_S)
    return distance_bound_m(motions, rest, imu_knowledge(profile), white_noise(profile))


class JointTrial(NamedTuple):
    """Errors of the radial distance from the joint's axis to the second IMU, all of the same recording.

    thesis_error_m, ours_error_m: estimated less true; of the thesis None where its analysis found too little
        motion.
    ours_sigma_m: as our estimator states it. bound_m: Cramer-Rao (`joint_bound`).
    axis_error_deg: between our axis and the true one, in the IMU's frame.
    robot_time_s: of the trial, travel between its motions included.
    """

    thesis_error_m: float | None
    ours_error_m: float
    ours_sigma_m: float
    bound_m: float
    axis_error_deg: float
    robot_time_s: float


def trial_plan(arm: ThesisLength, profile: NoiseProfile) -> Plan:
    """Return the thesis' motions for an arm, at the thesis' amplitude.

    An IMU that is not calibrated is calibrated by gravity, if the slow motion lets gravity change along the
    tangent of the IMU's circle: an arm about a horizontal axis then swings about where it hangs, and not
    about the horizontal, where +-0.5 rad change that pull by a tenth. It hangs at -pi/2 (thesis_*.toml).
    """
    delivered = imu_knowledge(profile) != CALIBRATED
    home_rad = -0.5 * pi if delivered and arm.alignment == "vertical" else 0.0
    return Plan(sine_amplitude_rad=arm.amplitude_rad, home_rad=home_rad)


def joint_trial(length_mm: int, alignment: Alignment, profile: NoiseProfile, seed: int) -> JointTrial:
    """Run one trial on a new rig, and compare the estimated distance with the rig's truth.

    Args:
        length_mm, alignment: one of the thesis' eight arms (`thesis_lengths`).
        profile: noise.
        seed: of the rig's modules, their noise, and the site.

    Raises:
        UsageError: the thesis had no such arm.
        ExperimentFailed: a module refused a motion, or broke it off.
        ValueError: too little motion, with what would be enough.
    """
    robot = at_random_site(load_robot(f"thesis_{length_mm}_{alignment}"), seed)
    with OneJointRig(robot, seed, profile) as rig:
        rows = rig.trial(trial_plan(thesis_length(alignment, length_mm), profile))
        robot_time_s = 1e-9 * rig.world.t_ns
        # As built: a circle's radius ends where the IMU sits, wherever the catalogue has it.
        chain = sensing_chain(rig.world.robot)
    true_m = link_length_m(chain, child=IMU)
    true_axis = chain.imu_home[IMU, :3, :3].T @ chain.axis[JOINT]
    try:
        thesis_error_m: float | None = analyse(rows).distance_m - true_m
    except DataError:
        thesis_error_m = None
    ours = regress(rows, imu_knowledge(profile))
    return JointTrial(
        thesis_error_m=thesis_error_m,
        ours_error_m=ours.distance_m - true_m,
        ours_sigma_m=ours.sigma_distance_m,
        bound_m=bound_m(rows, profile),
        axis_error_deg=degrees(acos(float(np.clip(ours.axis @ true_axis, -1.0, 1.0)))),
        robot_time_s=robot_time_s,
    )


def rms(values: Array) -> float:
    """Return the root mean square of all entries."""
    return float(np.sqrt(np.mean(np.square(values))))

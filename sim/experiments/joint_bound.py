"""The Cramer-Rao bound of one joint's radial distance, for one recording.

The bound is that of an estimator that knows the noise of the IMU and the joint's true motion, and nothing
else that `joint_regression` does not know either: axis, radial vector, gravity, biases, delays, the link's
compliance, and the sensors' scales and axes within what is believed of them beforehand (then it is the
Bayesian bound of van Trees). A calibrated IMU is believed to 1e-4, while the simulated one has no error of
scale and axes at all: whoever knew that had a bound that is lower by a third at 484 mm and by a hundredth to
a tenth at 171 mm. The hinge of a bent link it knows to be where it is.
"""

import numpy as np

from module_agent.estimate.circle_point_analysis import rest_reading
from module_agent.estimate.joint_prior import AS_DELIVERED, CALIBRATED, ImuKnowledge
from module_agent.estimate.joint_regression import distance_bound_m
from module_agent.estimate.seen_motion import seen_motions
from module_agent.estimate.windows import imu_window
from sim.experiments.one_joint_rig import TrialRows, windows
from sim.noise_profile import NoiseProfile
from sim.physics.imu_sensor import WHITE_RATE_HZ

# Passes 2 Hz with 0.998, and leaves so little of the encoder's counts that they feign no information.
_LIGHTLY_S = 0.010


def imu_knowledge(profile: NoiseProfile) -> ImuKnowledge:
    """Return what is known beforehand of an IMU under this profile: whether it is calibrated."""
    errs = profile.accel_scale or profile.gyro_scale or profile.imu_misalignment_rad
    return AS_DELIVERED if errs else CALIBRATED


def white_noise(profile: NoiseProfile, rate_hz: float = WHITE_RATE_HZ) -> tuple[float, float]:
    """Return the white noise of one sample of gyro [rad/s] and accelerometer [m/s^2], with its steps.

    That is an IMU whose own motor stands: vibration is what its own gears make.
    """
    gain = np.sqrt(rate_hz / WHITE_RATE_HZ)
    pairs = (
        (profile.gyro_white_rad_s, profile.gyro_step_rad_s),
        (profile.accel_white_m_s2, profile.accel_step_m_s2),
    )
    gyro, accel = (float(np.hypot(gain * white, step / np.sqrt(12.0))) for white, step in pairs)
    return gyro, accel


def bound_m(trial: TrialRows, profile: NoiseProfile) -> float:
    """Return the bound of the distance [m] for one trial.

    Raises:
        ValueError: too little motion, with what would be enough.
    """
    rest = rest_reading(imu_window(trial.rest))
    motions = seen_motions(windows(trial), _LIGHTLY_S)
    return distance_bound_m(motions, rest, imu_knowledge(profile), white_noise(profile))

"""What is known of an IMU and of a bending link before any motion: the one prior of all estimators.

Every number is one standard deviation, or a mean and a standard deviation, with its source. The simulator
draws its modules from its own figures (docs/effects.md); these are meant to cover them.
"""

from math import hypot, radians
from typing import NamedTuple

import numpy as np

from module_agent.model.catalogue import ImuKind
from module_agent.model.chain import Array

# A real X5-1's log reads 9, 31 and 42 mrad/s at rest, 31 rms: 50 cover the largest of three axes.
GYRO_BIAS_SIGMA_RAD_S = 0.05
# Bias instability within the minute between rest and motion. Data sheets of the class: 10 deg/h, which
# is 0.05 mrad/s.
GYRO_BIAS_DRIFT_RAD_S = 1e-4
# 20 mg, data sheets of the class; 2 mg after calibration, as in a real X5-1's log. It tilts gravity where an
# IMU never turns, and with it all that hangs on that module.
ACCEL_BIAS_SIGMA_M_S2 = 0.2
CALIBRATED_ACCEL_BIAS_SIGMA_M_S2 = 0.02
# From session to session: 0.15 mg/K in data sheets of the class, over 3 K.
ACCEL_BIAS_CHANGE_M_S2 = 0.005
# Data sheets of the class: 0.1 deg/s per g. Calibrating scale and axes leaves it as it is.
G_SENSITIVITY_SIGMA_S_M = 1.8e-4
# A second-order Butterworth low-pass delays by 0.225 over its corner: 2.4 ms at 92 Hz, the setting below
# half of 250 Hz; 5.6 ms at 40 Hz, 1.1 ms at 200 Hz, none without it. IMUs of one make have the same
# setting and differ by less.
DELAY_S, DELAY_SIGMA_S = 2.4e-3, 1.5e-3
DELAY_SPREAD_S = 1e-4
# The same prior for an estimator that expects a delay of zero: its root mean square.
DELAY_RMS_S = hypot(DELAY_S, DELAY_SIGMA_S)

# The place of an IMU in its housing. The manufacturer gives it as a hint only: tolerances of the board in its
# housing, and of the sensor on the board.
PLACE_SIGMA_M = 1e-3
# How far gyro and accelerometer are turned together against the joint's axis: the faces by which a module
# is clamped on the rate table that calibrates it, 0.1 deg, and the axis in its housing, 0.05 deg.
MOUNTING_SIGMA_RAD = radians(0.12)

# Where the hinge of a bending link is, as a share of its length: 0 for a clamp that gives, 0.15 for a
# clamped beam (Howell, Compliant Mechanisms, 2001, section 5), up to a third where the end's slope counts
# more than its place.
HINGE_SHARE, HINGE_SHARE_SIGMA = 0.15, 0.1


class ImuPrior(NamedTuple):
    """How well an IMU is known beforehand, one standard deviation each; zero means exactly."""

    scale: float
    misalignment_rad: float
    gyro_bias_rad_s: float = GYRO_BIAS_SIGMA_RAD_S
    accel_bias_m_s2: float = ACCEL_BIAS_SIGMA_M_S2
    delay_s: float = DELAY_RMS_S
    g_sensitivity_s_m: float = G_SENSITIVITY_SIGMA_S_M
    place_m: float = PLACE_SIGMA_M
    mounting_rad: float = MOUNTING_SIGMA_RAD

    @property
    def sigmas(self) -> Array:
        """The standard deviations of an IMU's errors, (34,).

        Scale and misalignment matrix of the gyro (9) and of the accelerometer (9), row by row, biases of gyro
        (3) and accelerometer (3), delay, and the gyro's sensitivity to specific force (9), row by row.
        """
        matrix = np.full((3, 3), self.misalignment_rad)
        np.fill_diagonal(matrix, self.scale)
        biases = np.repeat([self.gyro_bias_rad_s, self.accel_bias_m_s2], 3)
        return np.concatenate(
            [matrix.ravel(), matrix.ravel(), biases, [self.delay_s], np.full(9, self.g_sensitivity_s_m)]
        )

    @property
    def placement_sigmas(self) -> Array:
        """The standard deviations of an IMU's turn (3) [rad] and place (3) [m] in its housing, (6,)."""
        return np.repeat([self.mounting_rad, self.place_m], 3)


# As delivered. Data sheets of the class: scale within 0.5-3 % (steps in a real X5-1's log were off by -0.7 to
# -2.2 %), cross-axis sensitivity below 2 % = 1.1 deg.
UNCALIBRATED = ImuPrior(scale=0.01, misalignment_rad=radians(1.0))
# Calibrated on a rate table and by gravity: what is left of scale and axes is below what motions can measure.
CALIBRATED = ImuPrior(scale=1e-4, misalignment_rad=1e-4, accel_bias_m_s2=CALIBRATED_ACCEL_BIAS_SIGMA_M_S2)
# For motions that tell neither scale nor axes.
BIASES_ONLY = ImuPrior(
    scale=0.0, misalignment_rad=0.0, delay_s=0.0, g_sensitivity_s_m=0.0, place_m=0.0, mounting_rad=0.0
)

IMU_PRIORS: dict[ImuKind, ImuPrior] = {"calibrated": CALIBRATED, "uncalibrated": UNCALIBRATED}

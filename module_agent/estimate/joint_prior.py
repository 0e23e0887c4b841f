"""What is known of an IMU, a link and a housing before any motion: the beliefs of the joint regression."""

from math import radians
from typing import NamedTuple

import numpy as np

from module_agent.estimate.joint_model import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    BEARING,
    COMPLIANCE,
    DELAY,
    FELT,
    GYRO_BIAS,
    HEIGHT,
    HINGE,
    KAPPA,
    LATE,
    PIVOT,
)
from module_agent.estimate.windows import Array
from module_agent.gravity import GRAVITY_M_S2

# A link bends so that it rings at 12 Hz or above: c = 1 / (2 pi f)^2.
_COMPLIANCE_SIGMA_S2 = 2e-4
# A bent link's hinge as a share of the distance: at the axis where its clamp gives, at 0.15 by beam theory.
_HINGE_SHARE, _HINGE_SHARE_SIGMA = 0.0, 0.05
_GYRO_BIAS_RAD_S = 0.1
_GYRO_FEELS_S_M = 2e-4  # rad/s per m/s^2: 0.1 deg/s/g in data sheets
_DELAY_S = 0.02
# IMUs of one make are late by the same low-pass; the corner may be set to between 40 and 200 Hz.
_LATE_S, _LATE_SIGMA_S = 2.4e-3, 1.5e-3
# Housings are some 60 mm wide, and a link leads the child's IMU off along the axis by about as much.
_PIVOT_SIGMA_M, _HEIGHT_M, _HEIGHT_SIGMA_M = 0.03, 0.05, 0.1


class ImuKnowledge(NamedTuple):
    """How well an IMU is known beforehand, one standard deviation each."""

    scale: float
    misalignment_rad: float
    accel_bias_m_s2: float


# Calibrated on a rate table and by gravity, and what data sheets of this class of IMU allow.
CALIBRATED = ImuKnowledge(1e-4, 1e-4, 0.2)
AS_DELIVERED = ImuKnowledge(0.01, radians(1.0), 0.2)


class Beliefs(NamedTuple):
    """Means of all parameters and their weights 1 / sigma^2, zero where nothing is believed."""

    mean: Array
    weight: Array


def beliefs(knowledge: ImuKnowledge, motions: int) -> Beliefs:
    """Return the beliefs about the parameters of `joint_model` with that many delays."""
    sigma = np.full(DELAY + motions, np.inf)
    scale, turn = knowledge.scale, knowledge.misalignment_rad
    # What the scale makes of gravity along the axis cannot be told from a bias.
    sigma[ACCEL_BIAS] = np.hypot(knowledge.accel_bias_m_s2, GRAVITY_M_S2 * max(scale, turn))
    sigma[KAPPA] = turn, turn, scale
    sigma[ACCEL_MATRIX] = scale, turn, turn, scale, turn, turn
    sigma[FELT] = _GYRO_FEELS_S_M
    sigma[COMPLIANCE], sigma[HINGE] = _COMPLIANCE_SIGMA_S2, _HINGE_SHARE_SIGMA
    sigma[GYRO_BIAS] = _GYRO_BIAS_RAD_S
    sigma[LATE], sigma[PIVOT], sigma[HEIGHT] = _LATE_SIGMA_S, _PIVOT_SIGMA_M, _HEIGHT_SIGMA_M
    # Any direction will do where no shake asks for it.
    sigma[BEARING] = np.pi
    sigma[DELAY:] = _DELAY_S
    mean = np.zeros_like(sigma)
    mean[HINGE], mean[LATE], mean[HEIGHT] = _HINGE_SHARE, _LATE_S, _HEIGHT_M
    return Beliefs(mean, 1.0 / sigma**2)

"""The axis of a joint with an encoder and the radial vector of the IMU that it carries."""

import numpy as np
from numpy.typing import ArrayLike

from module_agent.estimate.joint_regression import JointRegression, regress_joint
from module_agent.estimate.observed_motion import MotionWindows, ObservedMotion, observed_motions
from module_agent.estimate.smoothing import SmoothMotion, smooth_imu
from module_agent.estimate.windows import ImuWindow, JointWindow
from module_agent.model.imu_prior import CALIBRATED, ImuPrior


def link_from_joint(
    t_s: ArrayLike,
    position_rad: ArrayLike,
    gyro_rad_s: ArrayLike,
    accel_m_s2: ArrayLike,
    carrier_gyro_rad_s: ArrayLike | None = None,
    carrier_accel_m_s2: ArrayLike | None = None,
    prior: ImuPrior = CALIBRATED,
) -> JointRegression:
    """Estimate axis and radial vector of a joint with an encoder from an IMU that it carries.

    The circle point analysis of one joint as least squares (`module_agent.estimate.joint_regression`):
    gravity, biases, delay and a bending link are estimated along. The place along the axis is not observable;
    the covariance is zero along it.

    Args:
        t_s: (m,) uniform times [s] of encoder and IMUs alike.
        position_rad: (m,) the joint's angle.
        gyro_rad_s, accel_m_s2: (m, 3) of the IMU that the joint carries, in its frame.
        carrier_gyro_rad_s, carrier_accel_m_s2: (m, 3) of an IMU on the other side of the joint: what it
            measures of a shaking base is subtracted. None for a base at rest.
        prior: how well the IMUs are known.

    Raises:
        DataError: too few samples, uneven times, or an IMU that did not move with the joint.
        ValueError: one of the carrier's two signals without the other.
    """
    if (carrier_gyro_rad_s is None) != (carrier_accel_m_s2 is None):
        raise ValueError("of the carrier's IMU both gyro and accelerometer are needed, or neither")
    t_ns = np.round(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    q = np.asarray(position_rad, dtype=float)
    joint = JointWindow(t_ns, q, np.gradient(q, 1e-9 * t_ns))
    imu = ImuWindow(t_ns, np.asarray(gyro_rad_s, dtype=float), np.asarray(accel_m_s2, dtype=float))
    if carrier_gyro_rad_s is None or carrier_accel_m_s2 is None:
        return regress_joint([ObservedMotion(smooth_imu(imu), SmoothMotion(joint), 0)], None, prior)
    gyro, accel = (np.asarray(a, dtype=float) for a in (carrier_gyro_rad_s, carrier_accel_m_s2))
    windows = MotionWindows(imu, joint, ImuWindow(t_ns, gyro, accel), 0)
    return regress_joint(observed_motions([windows]), None, prior)

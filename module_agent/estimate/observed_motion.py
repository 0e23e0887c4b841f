"""One joint motion as one IMU measured it: as sampled, and low-passed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from module_agent.estimate.base_shake import BaseMotion
from module_agent.estimate.smoothing import SMOOTH_S, SmoothImu, SmoothMotion, smooth_imu
from module_agent.estimate.windows import ImuWindow, JointWindow


class ObservedMotion(NamedTuple):
    """A joint's motion and an IMU's readings of it: t_imu = t_joint + `offset_ns` + a delay to be estimated.

    base: the shake of the joint's base, None if it was not measured.
    instrument: the motion without the encoder's noise, for the method of instrumental variables; None for
        ordinary least squares.
    """

    imu: SmoothImu
    joint: SmoothMotion
    offset_ns: int
    base: BaseMotion | None = None
    instrument: SmoothMotion | None = None


class MotionWindows(NamedTuple):
    """One motion as it was sampled: the observer's IMU, the joint, and the IMU of the joint's own module.

    t_imu = t_joint + `offset_ns` + a delay to be estimated; `joint` and `carrier` share a clock.
    """

    imu: ImuWindow
    joint: JointWindow
    carrier: ImuWindow
    offset_ns: int


def observed_motions(windows: Sequence[MotionWindows], smooth_s: float = SMOOTH_S) -> list[ObservedMotion]:
    """Low-pass the motions of one joint.

    Raises:
        ValueError: too few samples for the low-pass, or unevenly spaced ones.
    """
    if not windows:
        return []
    # One mean reading for all motions, as the joint swings about rest: that of the longest motion.
    longest = max((window.carrier for window in windows), key=lambda imu: imu.t_ns.size)
    still = np.hstack([longest.gyro_rad_s, longest.accel_m_s2]).mean(axis=0)
    return [
        ObservedMotion(
            smooth_imu(window.imu, smooth_s),
            SmoothMotion(window.joint, smooth_s),
            window.offset_ns,
            BaseMotion(window.joint, window.carrier, still, smooth_s),
        )
        for window in windows
    ]

"""A motion of a joint as one observer saw it: as it was sampled, and behind the low-pass."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from module_agent.estimate.base_shake import BaseMotion
from module_agent.estimate.smoothing import SMOOTH_S, SmoothImu, SmoothMotion, smooth_imu
from module_agent.estimate.windows import ImuWindow, JointWindow


class ObservedMotion(NamedTuple):
    """A joint's motion and what an IMU saw of it: t_imu = t_joint + `offset_ns` and a delay to be found.

    base: how what carries the joint shook meanwhile, None where nobody saw it.
    instrument: the same motion without the encoder's noise, if the equations are to be weighed with it (the
        method of instrumental variables); None weighs them with the encoder's own.
    """

    imu: SmoothImu
    joint: SmoothMotion
    offset_ns: int
    base: BaseMotion | None = None
    instrument: SmoothMotion | None = None


class MotionWindows(NamedTuple):
    """One motion as it was sampled: the observer's IMU, the joint, and the IMU of the joint's own module.

    t_imu = t_joint + `offset_ns` and a delay to be found; the two last share a clock.
    """

    imu: ImuWindow
    joint: JointWindow
    carrier: ImuWindow
    offset_ns: int


def observed_motions(windows: Sequence[MotionWindows], smooth_s: float = SMOOTH_S) -> list[ObservedMotion]:
    """Put the motions of one joint behind the low-pass.

    Raises:
        ValueError: too few samples for the low-pass, or unevenly spaced ones.
    """
    if not windows:
        return []
    # One rest for all, as the joint swings about it; of the longest, where the mean is best.
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

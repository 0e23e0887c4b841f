"""One joint motion as one IMU measured it: as sampled, and low-passed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from module_agent.estimate.base_shake import BaseMotion
from module_agent.estimate.smoothing import SMOOTH_S, SmoothImu, SmoothMotion, smooth_imu
from module_agent.estimate.windows import ImuWindow, JointWindow, Samples, even
from module_agent.signals.filtering import MAX_GAP_NS

# A shorter part of a motion, between two holes, is not used: the low-pass settles for half as long.
SHORTEST_NS = 1_000_000_000


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
    """Low-pass the motions of one joint, split at holes.

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
            smooth_imu(part.imu, smooth_s),
            SmoothMotion(part.joint, smooth_s),
            part.offset_ns,
            BaseMotion(part.joint, part.carrier, still, smooth_s),
        )
        for window in windows
        for part in _parts(window)
    ]


def _parts(window: MotionWindows) -> list[MotionWindows]:
    """Return the parts between holes that are long enough, with evenly spaced samples."""
    imu, joint, carrier, offset_ns = window
    times = joint.t_ns, carrier.t_ns, imu.t_ns - offset_ns
    holes = [(t[k], t[k + 1]) for t in times for k in np.flatnonzero(np.diff(t) > MAX_GAP_NS)]
    starts = np.maximum.accumulate([min(t[0] for t in times), *(end for _, end in sorted(holes))])
    ends = [*(start for start, _ in sorted(holes)), max(t[-1] for t in times)]
    return [
        MotionWindows(
            _between(imu, start + offset_ns, end + offset_ns),
            _between(joint, start, end),
            _between(carrier, start, end),
            offset_ns,
        )
        for start, end in zip(starts, ends, strict=True)
        if not holes or end - start > SHORTEST_NS
    ]


def _between(window: Samples, start_ns: int, end_ns: int) -> Samples:
    t_ns, *signals = window
    inside = (t_ns >= start_ns) & (t_ns <= end_ns)
    part = type(window)(t_ns[inside], *(signal[inside] for signal in signals))
    return even(part, float(np.median(np.diff(part.t_ns))))

"""Decide whether an IMU moves with a joint, by the regression of its gyro on the joint's rate.

An IMU that is rigidly carried reads gyro = j v, with |j| = 1; one that is not reads noise, the shaking of the
structure, and the compliance of held joints (20-30 % of the rate), little of which follows the joint's rate.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from module_agent.estimate.windows import AlignedMotion, Array
from module_agent.model.errors import DataError
from module_agent.model.read_only import read_only

MOVED_ABOVE = 0.5


class MotionDetection(NamedTuple):
    """Whether an IMU is carried by a joint.

    rate_ratio: |coefficient|, 1 if rigidly carried, 0 if not.
    coefficient: (3,) regression coefficient of the gyro on the joint's rate, in frame u; close to the joint's
        axis if carried.
    sigma: one standard deviation of each component, from the scatter about the regression.
    """

    moved: bool
    rate_ratio: float
    coefficient: Array
    sigma: float


def detect_motion(motions: Sequence[AlignedMotion], gyro_offset_rad_s: ArrayLike) -> MotionDetection:
    """Regress the gyro, less its offset, on the joint's rate over all motions of one joint.

    The offset comes from rest, not from the motions: over a constant motion the two are indistinguishable.

    Args:
        motions: constant motion and windowed sine of one joint, with one IMU's readings on one time axis.
        gyro_offset_rad_s: (3,) gyro offset at rest (thesis eq. 30).

    Raises:
        DataError: no motion, or the joint did not turn in any.
    """
    if not motions:
        raise DataError("no motion to judge by: at least one window of the moving joint is needed")
    rate = np.concatenate([m.velocity_rad_s for m in motions])
    gyro = np.concatenate([m.gyro_rad_s for m in motions]) - np.asarray(gyro_offset_rad_s, dtype=float)
    power = float(rate @ rate)
    if power <= 1e-6 * rate.size:
        raise DataError(
            f"the joint turned at only {np.sqrt(power / max(rate.size, 1)):.2g} rad/s rms; 1e-3 is needed"
        )
    coefficient = rate @ gyro / power
    scatter = float(((gyro - np.outer(rate, coefficient)) ** 2).mean())
    ratio = float(np.linalg.norm(coefficient))
    sigma = float(np.sqrt(scatter / power))
    return MotionDetection(ratio > MOVED_ABOVE, ratio, read_only(coefficient), sigma)

"""Did this IMU move with the joint? The size of the gyro's answer to the joint's rate says so.

An IMU that is rigidly carried reads gyro = j v, with |j| = 1; one that is not reads its own noise, the
shaking of the structure, and the give of held joints (20-30 % of the rate). The energy of the gyro would
count all shaking; the regression coefficient on the joint's rate counts only what follows the joint.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from module_agent.estimate.windows import AlignedMotion, Array
from module_agent.model.errors import DataError

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

    The offset comes from rest and not from the motions: over a constant motion it could not be told from the
    motion itself.

    Args:
        motions: the CM and WSM of one joint as one IMU saw them, on one time axis.
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
    coefficient.flags.writeable = False
    return MotionDetection(ratio > MOVED_ABOVE, ratio, coefficient, float(np.sqrt(scatter / power)))

"""Rate ratios between a joint and every IMU, with uncertainties: which IMUs does the joint carry?

An IMU that a joint carries reads gyro = j v, with the joint's rate v and |j| = 1; the gyro of any other is
uncorrelated with v. Two disturbances move an IMU in time with the joint and make the ratio uncertain: shaking
and noise, which differ from one block of the motion to the next, and compliant held joints, whose encoders
measure by how much they give. Where those joints' own motions have shown which IMUs they carry, and about
which axis, their contribution is subtracted.
"""

from typing import NamedTuple

import numpy as np

from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.read_only import frozen

BLOCKS = 6
# Share of outliers: of a thousand observations one is wrong in a way that no model describes.
OUTLIER_SHARE = 1e-3
# The IMU's own scale and axes, links that bend, a base that shakes: seen by no encoder, and repeating with
# the motion. Clean ratios of uncalibrated modules are within 0.03 of 0 and 1.
RATIO_FLOOR = 0.05
# Less than this over a motion is no motion: encoders and springs of a joint that is stuck still jitter.
MIN_RATE_RAD_S = 0.02
# Six blocks of four samples are the fewest that show their scatter.
MIN_SAMPLES = 4 * BLOCKS
# Share of a held joint's motion that remains after subtraction: its axis in the IMU's frame turns with the
# joints between, by some tenths of a radian.
RESIDUAL_GIVE = 0.3


class NotMoved(DataError):
    """The joint was commanded to move and is not known to have done so; the message says why."""


class MotionEvidence(NamedTuple):
    """The response of n IMUs to one joint's motion; arrays read-only.

    coefficient: (n, 3) regression of each gyro on the joint's rate, in the frame of that IMU.
    sigma: (n,) one standard deviation of its size, from the scatter between blocks of the motion.
    give: (n,) by how much the other joints moved along, relative to this one, less what was subtracted: an
        upper bound of the error of the rate ratio by them, which depends on where the IMU sits.
    """

    coefficient: Array
    sigma: Array
    give: Array

    @property
    def rate_ratio(self) -> Array:
        """(n,) sizes of the coefficients: 1 if carried, 0 if not."""
        return np.asarray(np.linalg.norm(self.coefficient, axis=1))

    @property
    def ratio_sigma(self) -> Array:
        """(n,) one standard deviation of the ratios, systematic errors included.

        The other joints' motion adds anything between -`give` and `give`: a uniform distribution.
        """
        return np.asarray(np.sqrt(self.sigma**2 + self.give**2 / 3.0 + RATIO_FLOOR**2))


def carried_log_odds(rate_ratio: float, sigma: float) -> float:
    """Return the log-odds that an IMU with this rate ratio is carried.

    Normal errors about 1 if carried and 0 if not, and outliers from 0 to 2 in a share
    `OUTLIER_SHARE`: a ratio that fits neither is nearly uninformative, and no log-odds exceed 9, 1 to 8000.
    """
    scale = sigma * np.sqrt(2.0 * np.pi)
    fits = [np.exp(-0.5 * ((rate_ratio - at) / sigma) ** 2) / scale for at in (1.0, 0.0)]
    return float(np.log((fits[0] + 0.5 * OUTLIER_SHARE) / (fits[1] + 0.5 * OUTLIER_SHARE)))


def motion_evidence(
    joint: int, qd_rad_s: Array, gyro_rad_s: Array, offset_rad_s: Array, axes: Array | None = None
) -> MotionEvidence:
    """Regress all gyros, less their offsets and the motion of held joints, on one joint's rate.

    The standard deviation is that of the jackknife over blocks of the motion (Efron, The Jackknife, 1982,
    eq. 3.13), which needs no model of the autocorrelation of shaking and noise.

    Args:
        joint: column of the joint that was moved.
        qd_rad_s: (m, n) rates of all joints.
        gyro_rad_s: (m, n, 3) of all IMUs at the same instants, each in its own frame, filtered alike.
        offset_rad_s: (n, 3) gyro offsets, from rest.
        axes: (n joints, n IMUs, 3) of every joint in every IMU's frame, zero where it does not carry it, NaN
            where that is not known; None if nothing is.

    Raises:
        NotMoved: the joint's rate is below `MIN_RATE_RAD_S` rms, or there are fewer than `MIN_SAMPLES`
            samples.
    """
    rate = qd_rad_s[:, joint]
    if rate.size < MIN_SAMPLES:
        raise NotMoved(f"only {rate.size} samples of its motion are there; {MIN_SAMPLES} are needed")
    size = float(np.sqrt(np.mean(rate**2)))
    if size < MIN_RATE_RAD_S:
        raise NotMoved(f"it turned at only {size:.2g} rad/s rms; {MIN_RATE_RAD_S} is needed")
    others = np.arange(qd_rad_s.shape[1]) != joint
    held = np.full((others.sum(), gyro_rad_s.shape[1], 3), np.nan) if axes is None else axes[others]
    # The remaining shares (joints, n) of what held joints add to the rates of every IMU.
    left = np.where(np.isnan(held).any(axis=2), 1.0, RESIDUAL_GIVE)
    gyro = gyro_rad_s - offset_rad_s - np.tensordot(qd_rad_s[:, others], np.nan_to_num(held, nan=0.0), axes=1)
    blocks = np.array_split(np.arange(rate.size), BLOCKS)
    power = np.array([rate[b] @ rate[b] for b in blocks])
    moment = np.array([np.tensordot(rate[b], gyro[b], axes=1) for b in blocks])
    coefficient = moment.sum(axis=0) / power.sum()
    without = (moment.sum(axis=0) - moment) / (power.sum() - power)[:, None, None]
    scatter = ((without - without.mean(axis=0)) ** 2).sum(axis=(0, 2))
    give = (np.abs(rate @ qd_rad_s[:, others]) / power.sum()) @ left
    spread = np.sqrt((BLOCKS - 1) / BLOCKS * scatter)
    return MotionEvidence(frozen(coefficient), frozen(spread), frozen(give))

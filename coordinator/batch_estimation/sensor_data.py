"""The data of the batch estimator: joints and IMUs on one time base, and the motion of the base.

The base may move with the joints: a compliant bench, a rocking post, a vehicle. The IMU of a module that is
bolted to the base by its housing rides on the base. Its readings beyond their mean are the base's own motion,
which carries everything on the base along: rates, angular accelerations and specific forces of a moving frame
(Craig, Introduction to Robotics, eqs 6.45-6.48 with a base that is not at rest). Its noise would be carried
along as well, so only frequencies that exceed the noise are used.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.model.chain import Array
from module_agent.signals.filtering import differentiate

# A mean of three bins of nothing but noise exceeds its expectation by this factor once in 2000 times.
STANDS_OUT = 4.0
SMOOTHED_BINS = 3


class BaseMotion(NamedTuple):
    """Motion of the base about rest, measured by an IMU on it and in that IMU's frame, (m, 3) each.

    omega [rad/s], alpha [rad/s^2], acceleration [m/s^2], the latter of the IMU's place, including the
    change of gravity by tilting.
    """

    omega: Array
    alpha: Array
    acceleration: Array


class NoiseFloor(NamedTuple):
    """Variances (3,) of a resting IMU's low-passed gyro [rad^2/s^2] and accelerometer [m^2/s^4]."""

    gyro: Array
    accel: Array
    cutoff_hz: float


def outstanding(signal: Array, variance: Array, cutoff_hz: float, rate_hz: float) -> Array:
    """Return signals (m, k) about their means without their noise, by a Wiener filter.

    The noise is white up to the cut-off with the given variances (k,). The weights are Wiener's, 1 - N / S
    with S the smoothed periodogram; a frequency whose power could be that of noise is left out.
    """
    samples = len(signal)
    spectrum = np.fft.rfft(signal - signal.mean(axis=0), axis=0)
    power = np.apply_along_axis(np.convolve, 0, np.abs(spectrum) ** 2, np.ones(SMOOTHED_BINS), "same")
    power /= SMOOTHED_BINS
    noise = samples * variance * 0.5 * rate_hz / cutoff_hz
    weight = np.where(power > STANDS_OUT * noise, 1.0 - noise / np.maximum(power, 1e-300), 0.0)
    return np.asarray(np.fft.irfft(spectrum * weight, samples, axis=0))


def measured_base_motion(gyro: Array, accel: Array, floor: NoiseFloor, rate_hz: float) -> BaseMotion:
    """Return the base's motion by the readings (m, 3) of an IMU on it, filtered alike, beyond its noise."""
    omega = outstanding(gyro, floor.gyro, floor.cutoff_hz, rate_hz)
    force = outstanding(accel, floor.accel, floor.cutoff_hz, rate_hz)
    return BaseMotion(omega, differentiate(omega, rate_hz), force)


class SensorData(NamedTuple):
    """Samples of all joints and IMUs on one time base and through one low-pass, m samples of n modules.

    q_rad, qd_rad_s, qdd_rad_s2: (m, n). gyro_rad_s, accel_m_s2: (m, n, 3) in the IMU frames. imu_rates:
    (m, n, 6) how fast these two change [rad/s^2, m/s^3]; None if no IMU is late. base_motion: (m, 9) the
    base's rate, angular acceleration and acceleration beyond rest, as `BaseMotion` has them; None at rest.
    motion: (m,) the number of the motion that a sample belongs to, from 0 on; None if all belong to one. The
    samples of a motion are equally far apart, far enough for their errors to be independent.
    instrument: (m, 3 n) positions, velocities and accelerations without the encoders' noise, and without what
    is no larger; None if they are as measured.
    """

    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    imu_rates: Array | None = None
    base_motion: Array | None = None
    motion: NDArray[np.int64] | None = None
    instrument: Array | None = None

    @property
    def joints(self) -> tuple[Array, Array, Array]:
        """Positions, velocities and accelerations, (m, n) each."""
        return self.q_rad, self.qd_rad_s, self.qdd_rad_s2

    @property
    def smooth(self) -> tuple[Array, Array, Array]:
        """The signals for derivatives: encoder noise in there would act as motion and bias the fit."""
        if self.instrument is None:
            return self.joints
        q, qd, qdd = np.split(self.instrument, 3, axis=1)
        return q, qd, qdd

    @property
    def base(self) -> BaseMotion | None:
        """How the base moved; None at rest."""
        if self.base_motion is None:
            return None
        omega, alpha, acceleration = np.split(self.base_motion, 3, axis=1)
        return BaseMotion(omega, alpha, acceleration)

    @property
    def motions(self) -> list[slice]:
        """The samples of every motion."""
        if self.motion is None:
            return [slice(0, len(self.q_rad))]
        ends = np.flatnonzero(np.diff(self.motion)) + 1
        return [slice(int(a), int(b)) for a, b in pairwise([0, *ends, len(self.motion)])]

"""How the base moves while joints do: a bench that gives, a post that rocks, a vehicle.

The IMU of a module that is bolted to the base by its housing rides on the base, whichever joint turns. What
it reads beyond its mean is the base's own motion, and everything on the base is carried along: rates, angular
accelerations and specific forces of a moving frame (Craig, Introduction to Robotics, eqs 6.45-6.48 with a
base that is not at rest). Its noise is carried along as well, so only what stands out of the noise is taken.
"""

from typing import NamedTuple

import numpy as np

from module_agent.dynamics.chain import Array

# A mean of three bins of nothing but noise exceeds its expectation by this factor once in 2000 times.
STANDS_OUT = 4.0
SMOOTHED_BINS = 3


class BaseMotion(NamedTuple):
    """Motion of the base about rest, seen by an IMU on it and in that IMU's frame, (m, 3) each.

    omega [rad/s], alpha [rad/s^2], acceleration [m/s^2], the latter of the IMU's place, with what tilting
    makes of gravity.
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
    """Return what of signals (m, k) about their means is not noise, frequency by frequency.

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

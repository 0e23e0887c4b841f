"""Readings of IMU chips, from the true angular rate and specific force.

The chain of a chip, in order:

    1. its own axes, scales and the gyro's response to specific force (`SensorErrors`);
    2. a second-order Butterworth low-pass, the same for all axes, at the rate of the world;
    3. sampling at the chip's own rate, a little off the stamp (`sampling_jitter_s`);
    4. bias, its first-order Gauss-Markov drift, white noise, noise of the gears;
    5. saturation, then quantisation.

A chip saturates before its low-pass; here an impact is clipped less, as the filter spreads it out first.
1 is constant and linear and 2 treats all axes alike, so they commute: the filter runs every tick on the true
values, the rest once per reading. The stamp is the sampling instant. The low-pass delays slow motion by
sqrt(2) / (2 pi f), 2.4 ms at 92 Hz. As on the real module the stamp does not include this delay: against the
encoder the IMU appears late by as much.
"""

from collections.abc import Sequence
from math import exp, pi, sqrt, tan
from typing import NamedTuple

import numpy as np

from module_agent.model.catalogue import ModuleType
from module_agent.model.compiled import compiled
from sim.geometry.pose import Array
from sim.imperfections.module_errors import SensorErrors, per_axis
from sim.imperfections.noise_profile import NoiseProfile
from sim.imperfections.random_streams import Draws, StandardNormals

# White noise is given as seen at this output rate.
WHITE_RATE_HZ = 250.0


def butterworth(bandwidth_hz: float, tick_s: float) -> tuple[float, float, float, float, float]:
    """Return (b0, b1, b2, a1, a2) of a second-order low-pass: bilinear, with its corner where it was wanted.

        H(z) = (b0 + b1 / z + b2 / z^2) / (1 + a1 / z + a2 / z^2)

    A bandwidth of 0 stands for no filter at all.
    """
    if bandwidth_hz == 0.0:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    corner = tan(pi * bandwidth_hz * tick_s)
    scale = 1.0 / (1.0 + sqrt(2.0) * corner + corner**2)
    b = corner**2 * scale
    return b, 2.0 * b, b, 2.0 * (corner**2 - 1.0) * scale, (1.0 - sqrt(2.0) * corner + corner**2) * scale


class ImuArrays(NamedTuple):
    """What the kernels know of n IMUs.

    axes (n, 2, 3, 3), scale (n, 6), g_sensitivity (n, 3, 3), bias (n, 6): as in `SensorErrors`. per_speed
    (n, 6): vibration per motor speed. sizes (4, 6): white noise, drift, range and step of each axis. drift
    (n, 6): in its own standard deviations; from one reading to the next it keeps `keep` of itself and gets
    `renew` of a new draw. filtered (4, n, 6): output, last output and the two memories of the low-pass; NaN
    before the first tick.
    """

    taps: tuple[float, float, float, float, float]
    jitter_ticks: float
    axes: Array
    scale: Array
    g_sensitivity: Array
    bias: Array
    per_speed: Array
    sizes: Array
    keep: float
    renew: float
    drift: Array
    filtered: Array
    white: Draws
    vibration: Draws
    drifting: Draws
    jitter: Draws


class Imus:
    """The IMUs of n modules: `follow_imus` goes on every tick if `every_tick`, else before each reading."""

    def __init__(
        self,
        seed: int,
        serials: Sequence[str],
        types: Sequence[ModuleType],
        profile: NoiseProfile,
        errors: SensorErrors,
        tick_s: float,
        period_s: float,
    ):
        self.every_tick = profile.imu_bandwidth_hz > 0.0 or profile.sampling_jitter_s > 0.0
        vibration = np.array([t.vibration for t in types])[:, None] * per_axis(
            profile.vibration_rad_s, profile.vibration_m_s2
        )
        sizes = np.array(
            [
                sqrt(1.0 / (period_s * WHITE_RATE_HZ))
                * per_axis(profile.gyro_white_rad_s, profile.accel_white_m_s2),
                per_axis(profile.gyro_drift_rad_s, profile.accel_drift_m_s2),
                per_axis(profile.gyro_range_rad_s, profile.accel_range_m_s2),
                per_axis(profile.gyro_step_rad_s, profile.accel_step_m_s2),
            ]
        )
        keep = exp(-period_s / profile.drift_time_s) if profile.drift_time_s else 0.0
        self.streams = tuple(
            StandardNormals(seed, serials, purpose, columns)
            for purpose, columns in (("imu", 6), ("vibration", 6), ("imu drift", 6), ("imu jitter", 1))
        )
        white, vibrating, drifting, jitter = (stream.draws for stream in self.streams)
        # Copies, all writable: a kernel is compiled once for every kind of array it meets.
        self.arrays = ImuArrays(
            taps=butterworth(profile.imu_bandwidth_hz, tick_s),
            jitter_ticks=profile.sampling_jitter_s / tick_s,
            axes=np.array(errors.misalignment, order="C"),
            scale=np.array(errors.imu_scale, order="C"),
            g_sensitivity=np.array(errors.g_sensitivity, order="C"),
            bias=np.array(errors.imu_bias, order="C"),
            per_speed=vibration / np.array([t.max_speed_rad_s for t in types])[:, None],
            sizes=sizes,
            keep=keep,
            renew=sqrt(1.0 - keep**2),
            # It has its own deviation from the beginning.
            drift=self.streams[2].draw(),
            filtered=np.full((4, len(types), 6), np.nan),
            white=white,
            vibration=vibrating,
            drifting=drifting,
            jitter=jitter,
        )


@compiled
def follow_imus(own: ImuArrays, gyro: Array, force: Array) -> None:
    """Advance the low-pass, transposed direct form II, by one tick; both (n, 3) in IMU axes."""
    b0, b1, b2, a1, a2 = own.taps
    filtered = own.filtered
    begins = filtered[0, 0, 0] != filtered[0, 0, 0]
    for i in range(gyro.shape[0]):
        for axis in range(6):
            x = gyro[i, axis] if axis < 3 else force[i, axis - 3]
            if begins:
                # The steady state under this input.
                filtered[0, i, axis], filtered[1, i, axis] = x, x
                filtered[2, i, axis], filtered[3, i, axis] = (1.0 - b0) * x, (b2 - a2) * x
            y = b0 * x + filtered[2, i, axis]
            filtered[2, i, axis] = b1 * x - a1 * y + filtered[3, i, axis]
            filtered[3, i, axis] = b2 * x - a2 * y
            filtered[1, i, axis] = filtered[0, i, axis]
            filtered[0, i, axis] = y


@compiled
def read_imus(own: ImuArrays, motor_rad_s: Array, values: Array) -> None:
    """Fill in a reading of all IMUs (n, 6): gyro [rad/s], accelerometer [m/s^2].

    motor_rad_s: (n,) the speeds of the modules' own motors, seen at the output.
    """
    filtered, axes, sizes, drift = own.filtered, own.axes, own.sizes, own.drift
    at, vibration_at = own.white.next[0], own.vibration.next[0]
    drift_at, jitter_at = own.drifting.next[0], own.jitter.next[0]
    own.white.next[0], own.vibration.next[0] = at + 1, vibration_at + 1
    own.drifting.next[0], own.jitter.next[0] = drift_at + 1, jitter_at + 1
    for i in range(len(motor_rad_s)):
        off = own.jitter_ticks * own.jitter.block[jitter_at, i, 0]
        for k in range(6):
            sensor, row = k // 3, k % 3
            value = 0.0
            for column in range(3):
                c = 3 * sensor + column
                now = filtered[0, i, c] + off * (filtered[0, i, c] - filtered[1, i, c])
                value += axes[i, sensor, row, column] * now
            value *= 1.0 + own.scale[i, k]
            if sensor == 0:
                for column in range(3):
                    c = 3 + column
                    now = filtered[0, i, c] + off * (filtered[0, i, c] - filtered[1, i, c])
                    value += own.g_sensitivity[i, row, column] * now
            white, vibration = own.white.block[at, i, k], own.vibration.block[vibration_at, i, k]
            value += own.bias[i, k] + sizes[1, k] * drift[i, k] + sizes[0, k] * white
            value += own.per_speed[i, k] * abs(motor_rad_s[i]) * vibration
            values[i, k] = _converted(value, sizes[2, k], sizes[3, k])
            drift[i, k] = own.keep * drift[i, k] + own.renew * own.drifting.block[drift_at, i, k]


@compiled
def _converted(value: float, limit: float, step: float) -> float:
    """Saturate a value at the limit and round it to whole steps; 0 switches either off."""
    if limit > 0.0:
        value = min(max(value, -limit), limit)
    if step > 0.0:
        value = np.rint(value / step) * step
    return value

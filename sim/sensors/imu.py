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

import numpy as np

from module_agent.model.catalogue import ModuleType
from module_agent.model.compiled import compiled
from sim.geometry.pose import Array
from sim.imperfections.module_errors import SensorErrors, per_axis
from sim.imperfections.noise_profile import NoiseProfile
from sim.imperfections.random_streams import StandardNormals

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


class Imus:
    """The IMUs of n modules. `advance` is called every tick if `every_tick`, else before each reading."""

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
        self._filter = butterworth(profile.imu_bandwidth_hz, tick_s)
        self._jitter_ticks = profile.sampling_jitter_s / tick_s
        self._errors = errors
        vibration = np.array([t.vibration for t in types])[:, None] * per_axis(
            profile.vibration_rad_s, profile.vibration_m_s2
        )
        self._vibration_per_speed = vibration / np.array([t.max_speed_rad_s for t in types])[:, None]
        # Per axis: white noise, drift, range, step.
        self._sizes = np.array(
            [
                sqrt(1.0 / (period_s * WHITE_RATE_HZ))
                * per_axis(profile.gyro_white_rad_s, profile.accel_white_m_s2),
                per_axis(profile.gyro_drift_rad_s, profile.accel_drift_m_s2),
                per_axis(profile.gyro_range_rad_s, profile.accel_range_m_s2),
                per_axis(profile.gyro_step_rad_s, profile.accel_step_m_s2),
            ]
        )
        self._keep = exp(-period_s / profile.drift_time_s) if profile.drift_time_s else 0.0
        self._white, self._vibration, self._drifting, self._jitter = (
            StandardNormals(seed, serials, purpose, columns)
            for purpose, columns in (("imu", 6), ("vibration", 6), ("imu drift", 6), ("imu jitter", 1))
        )
        # In units of its own deviation, which it has from the beginning.
        self._drift = self._drifting.draw().copy()
        # The filter's output of this tick and the last one, and its two memories.
        self._filtered = np.zeros((0, len(types), 6))

    def advance(self, gyro_rad_s: Array, specific_force_m_s2: Array) -> None:
        """Advance the low-pass by one tick; both (n, 3) in IMU axes."""
        if not len(self._filtered):
            # The steady state under this input.
            b0, _, b2, _, a2 = self._filter
            steady = np.hstack((gyro_rad_s, specific_force_m_s2))
            self._filtered = np.array((steady, steady, (1.0 - b0) * steady, (b2 - a2) * steady))
        _low_pass(self._filter, gyro_rad_s, specific_force_m_s2, self._filtered)

    def read(self, motor_rad_s: Array) -> Array:
        """Return a reading of all IMUs (n, 6): gyro [rad/s], accelerometer [m/s^2].

        motor_rad_s: (n,) the speeds of the modules' own motors, seen at the output.
        """
        errors = self._errors
        values: Array = _read(
            self._filtered,
            self._jitter_ticks * self._jitter.draw()[:, 0],
            errors.misalignment,
            errors.imu_scale,
            errors.g_sensitivity,
            errors.imu_bias,
            self._drift,
            self._white.draw(),
            self._vibration.draw(),
            self._vibration_per_speed,
            motor_rad_s,
            self._sizes,
        )
        self._drift = self._keep * self._drift + sqrt(1.0 - self._keep**2) * self._drifting.draw()
        return values


@compiled
def _low_pass(
    taps: tuple[float, float, float, float, float], gyro: Array, force: Array, filtered: Array
) -> None:
    """Transposed direct form II; `filtered` holds output, last output and the two memories, (4, n, 6)."""
    b0, b1, b2, a1, a2 = taps
    for i in range(gyro.shape[0]):
        for axis in range(6):
            x = gyro[i, axis] if axis < 3 else force[i, axis - 3]
            y = b0 * x + filtered[2, i, axis]
            filtered[2, i, axis] = b1 * x - a1 * y + filtered[3, i, axis]
            filtered[3, i, axis] = b2 * x - a2 * y
            filtered[1, i, axis] = filtered[0, i, axis]
            filtered[0, i, axis] = y


@compiled
def _read(
    filtered: Array,
    jitter: Array,
    axes: Array,
    scale: Array,
    g_sensitivity: Array,
    bias: Array,
    drift: Array,
    white: Array,
    vibration: Array,
    per_speed: Array,
    speed: Array,
    sizes: Array,
) -> Array:
    """Return `Imus.read`; jitter (n,) is in ticks, white, vibration and drift in standard deviations."""
    values = np.empty(scale.shape)
    now = np.empty(6)
    for i in range(scale.shape[0]):
        for k in range(6):
            now[k] = filtered[0, i, k] + jitter[i] * (filtered[0, i, k] - filtered[1, i, k])
        for k in range(6):
            sensor, row = k // 3, k % 3
            value = 0.0
            for column in range(3):
                value += axes[i, sensor, row, column] * now[3 * sensor + column]
            value *= 1.0 + scale[i, k]
            if sensor == 0:
                for column in range(3):
                    value += g_sensitivity[i, row, column] * now[3 + column]
            value += bias[i, k] + sizes[1, k] * drift[i, k] + sizes[0, k] * white[i, k]
            value += per_speed[i, k] * abs(speed[i]) * vibration[i, k]
            values[i, k] = _converted(value, sizes[2, k], sizes[3, k])
    return values


@compiled
def _converted(value: float, limit: float, step: float) -> float:
    """Saturate a value at the limit and round it to whole steps; 0 switches either off."""
    if limit > 0.0:
        value = min(max(value, -limit), limit)
    if step > 0.0:
        value = np.rint(value / step) * step
    return value

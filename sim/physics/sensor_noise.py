"""The random errors of all modules' sensors; every module and purpose has its own generator.

A generator is seeded by the world's seed and by serial and purpose, so adding a module, or drawing more of
one kind, changes no other draw.
"""

import zlib
from collections.abc import Sequence

import numpy as np

from sim.noise_profile import NoiseProfile
from sim.pose import Array, read_only

_IMU_SIGMA_RATE_HZ = 250.0
_BLOCK = 512


def generator(seed: int, serial: str, purpose: str) -> np.random.Generator:
    """Return the generator of one module's one purpose."""
    words = (seed, zlib.crc32(serial.encode()), zlib.crc32(purpose.encode()))
    return np.random.default_rng(np.random.SeedSequence(words))


class SensorNoise:
    """White noise and constant biases of n modules under one profile."""

    def __init__(self, seed: int, serials: Sequence[str], noise: NoiseProfile, imu_rate_hz: float):
        growth = np.sqrt(imu_rate_hz / _IMU_SIGMA_RATE_HZ)
        gyro, accel = noise.gyro_white_rad_s * growth, noise.accel_white_m_s2 * growth
        self._imu = _WhiteNoise(seed, serials, "imu", np.array([gyro] * 3 + [accel] * 3))
        self._joint = _WhiteNoise(
            seed, serials, "joint", np.array([noise.velocity_white_rad_s, noise.effort_white_fraction])
        )
        sigma = np.array([noise.gyro_bias_rad_s] * 3 + [noise.accel_bias_m_s2] * 3)
        self.imu_bias = read_only(
            np.array([sigma * generator(seed, serial, "imu bias").standard_normal(6) for serial in serials])
        )

    def imu(self) -> Array:
        """Return the next error of every IMU: bias and white noise, gyro then accelerometer, (n, 6)."""
        return self._imu.draw() + self.imu_bias

    def joint(self) -> Array:
        """Return the next error of every velocity [rad/s] and effort [fraction of the largest], (n, 2)."""
        return self._joint.draw()


class _WhiteNoise:
    """Independent normal draws per module, made in blocks: a call per module and tick costs 1 us each."""

    def __init__(self, seed: int, serials: Sequence[str], purpose: str, sigma: Array):
        self._sources = [generator(seed, serial, purpose) for serial in serials]
        self._sigma = sigma
        self._next = _BLOCK
        self._block = np.zeros((_BLOCK, len(serials), len(sigma)))

    def draw(self) -> Array:
        if self._next == _BLOCK:
            draws = [source.standard_normal((_BLOCK, len(self._sigma))) for source in self._sources]
            self._block = np.stack(draws, axis=1) * self._sigma
            self._next = 0
        self._next += 1
        row: Array = self._block[self._next - 1]
        return row

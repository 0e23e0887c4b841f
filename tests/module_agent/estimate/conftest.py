"""A hinge with an IMU on its body, sampled by two modules with clocks of their own."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from module_agent.estimate.windows import ImuWindow, JointWindow

RATE_HZ = 250.0
GYRO_NOISE = 1.2e-3
ACCEL_NOISE = 0.0294


class Hinge(NamedTuple):
    """An IMU at `radial` from the axis `axis`, with specific force `gravity` at phi = 0, all in frame u."""

    axis: np.ndarray
    radial: np.ndarray
    gravity: np.ndarray
    gyro_offset: np.ndarray
    noise: float = 1.0
    imu_ahead_s: float = 0.0  # what the IMU's clock shows more than the joint's
    drift: float = 0.0  # relative rate error of the IMU's clock
    carried: float = 1.0  # the part of the joint's motion that the IMU follows
    rate_hz: float = RATE_HZ

    def rest(self, rng: np.random.Generator, duration_s: float = 2.0) -> ImuWindow:
        return self.imu(np.arange(0.0, duration_s, 1 / self.rate_hz), np.zeros(4), np.arange(4.0), rng)

    def imu(self, t_s: np.ndarray, phi: np.ndarray, knots: np.ndarray, rng: np.random.Generator) -> ImuWindow:
        path = CubicSpline(knots, self.carried * phi)
        angle, rate, acceleration = path(t_s), path(t_s, 1), path(t_s, 2)
        force = Rotation.from_rotvec(-angle[:, None] * self.axis).apply(self.gravity)
        force = force + acceleration[:, None] * np.cross(self.axis, self.radial)
        force = force - rate[:, None] ** 2 * self.radial
        return ImuWindow(
            10**12 + np.round(1e9 * (t_s * (1 + self.drift) + self.imu_ahead_s)).astype(np.int64),
            rate[:, None] * self.axis
            + self.gyro_offset
            + self.noise * rng.normal(0, GYRO_NOISE, (t_s.size, 3)),
            force + self.noise * rng.normal(0, ACCEL_NOISE, (t_s.size, 3)),
        )

    def joint(
        self, t_s: np.ndarray, phi: np.ndarray, knots: np.ndarray, rng: np.random.Generator
    ) -> JointWindow:
        path = CubicSpline(knots, phi)
        return JointWindow(
            10**12 + np.round(1e9 * t_s).astype(np.int64),
            path(t_s) + self.noise * rng.normal(0, 1e-4, t_s.size),
            path(t_s, 1) + self.noise * rng.normal(0, 5e-3, t_s.size),
        )

    def move(
        self, phi: Callable[[np.ndarray], np.ndarray], end_s: float, seed: int
    ) -> tuple[ImuWindow, JointWindow]:
        """Both windows hold 0.3 s of rest before the motion and after it; their samples interleave."""
        rng = np.random.default_rng(seed)
        knots = np.arange(-0.3, end_s + 0.3, 5e-4)
        t_s = np.arange(-0.29, end_s + 0.28, 1 / self.rate_hz)
        path = phi(knots)
        return self.imu(t_s + 1.3e-3, path, knots, rng), self.joint(t_s, path, knots, rng)

    def constant(self, velocity: float, seed: int) -> tuple[ImuWindow, JointWindow]:
        """0.75 s at `velocity`, with smooth ramps of 0.15 s before and after."""

        def phi(t: np.ndarray) -> np.ndarray:
            up, down = np.clip(t / 0.15, 0, 1), np.clip((1.05 - t) / 0.15, 0, 1)
            rate = velocity * np.minimum(up, down) ** 2 * (3 - 2 * np.minimum(up, down))
            return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t))])

        return self.move(phi, 1.05, seed)

    def sine(self, amplitude: float, seed: int) -> tuple[ImuWindow, JointWindow]:
        """The windowed sine of position (thesis eq. 14), tapered to zero over 0.3 s at both ends."""

        def phi(t: np.ndarray) -> np.ndarray:
            edge = np.clip(np.minimum(t, 5.6 - t) / 0.3, 0, 1)
            taper = edge**3 * (10 - 15 * edge + 6 * edge**2)
            return taper * amplitude * np.exp(-0.5 * (t - 2.8) ** 2) * np.sin(2 * np.pi * 2 * t)

        return self.move(phi, 5.6, seed)


@pytest.fixture
def hinge() -> type[Hinge]:
    return Hinge


@pytest.fixture
def horizontal_link() -> Hinge:
    """A link of 245 mm turning about a horizontal, slightly skew axis; 0.05 rad/s of gyro offset."""
    axis = np.array([0.1, 0.05, 1.0]) / np.linalg.norm([0.1, 0.05, 1.0])
    radial = np.cross([0.2, 1.0, 0.0], axis)
    return Hinge(
        axis=axis,
        radial=0.245 * radial / np.linalg.norm(radial),
        gravity=np.array([3.0, 9.2, 1.0]),
        gyro_offset=np.array([0.05, -0.02, 0.03]),
    )

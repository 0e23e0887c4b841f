"""Constant differences between modules of one type, drawn once per module from a seed.

Factors multiply the catalogue's figures of the actuators; errors of the sensors are offsets, scales and axes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from module_agent.model.catalogue import ModuleType
from module_agent.model.perturbation import skew
from module_agent.model.read_only import make_read_only, read_only
from sim.geometry.pose import Array
from sim.imperfections.noise_profile import NoiseProfile
from sim.imperfections.random_streams import generator


class Variation(NamedTuple):
    """Factors near 1, (n,) each, read-only: friction, motor constant, winding resistance, spring stiffness.

    The motor constant is torque per ampere and volts per speed alike.
    """

    friction: Array
    motor: Array
    resistance: Array
    spring: Array


def alike(n: int) -> Variation:
    """Return the factors of modules as catalogued: 1."""
    return Variation(*(read_only(np.ones(n)) for _ in Variation._fields))


def draw_variation(seed: int, serials: Sequence[str], profile: NoiseProfile) -> Variation:
    """Draw the modules' factors: log-normal, so none is negative, with the profile's relative spreads."""
    spread = np.array(
        [profile.friction_spread, profile.motor_spread, profile.motor_spread, profile.spring_spread]
    )
    normal = np.array([generator(seed, s, "variation").standard_normal(len(spread)) for s in serials])
    return Variation(*(read_only(column) for column in np.exp(normal * spread).T))


class SensorErrors(NamedTuple):
    """The constant errors of n modules' sensors; read only. Without noise, drift and band limit they read

        gyro  = (1 + imu_scale[:3]) * (misalignment[0] w) + g_sensitivity f + imu_bias[:3]
        accel = (1 + imu_scale[3:]) * (misalignment[1] f) + imu_bias[3:]
        effort = (1 + effort_scale) * torque + effort_offset_nm

    of the angular rate w and specific force f in IMU axes and the torque of the spring.

    imu_bias: (n, 6) gyro [rad/s], accelerometer [m/s^2]. imu_scale: (n, 6) in the same order, relative.
    misalignment: (n, 2, 3, 3) of gyro and accelerometer; the rows are the sensors' axes in the IMU frame,
    unit vectors, orthogonal where the profile has no skew. g_sensitivity: (n, 3, 3) [rad/s per m/s^2].
    effort_offset_nm, effort_scale: (n,).
    """

    imu_bias: Array
    imu_scale: Array
    misalignment: Array
    g_sensitivity: Array
    effort_offset_nm: Array
    effort_scale: Array


def draw_sensor_errors(
    seed: int, serials: Sequence[str], types: Sequence[ModuleType], profile: NoiseProfile
) -> SensorErrors:
    """Draw the errors of modules of the given types: normal, with the standard deviations of the profile."""

    def normals(purpose: str, *shape: int) -> Array:
        return np.array([generator(seed, serial, purpose).standard_normal(shape) for serial in serials])

    effort = normals("torque calibration", 2)
    limit = np.array([t.max_effort_nm for t in types])
    turn = profile.imu_misalignment_rad * normals("imu misalignment", 2, 3)
    oblique = profile.imu_skew_rad * normals("imu skew", 2, 3)
    axes = [_axes(t, s) for t, s in zip(turn.reshape(-1, 3), oblique.reshape(-1, 3), strict=True)]
    errors = SensorErrors(
        imu_bias=per_axis(profile.gyro_bias_rad_s, profile.accel_bias_m_s2) * normals("imu bias", 6),
        imu_scale=per_axis(profile.gyro_scale, profile.accel_scale) * normals("imu scale", 6),
        misalignment=np.reshape(axes, (-1, 2, 3, 3)),
        g_sensitivity=profile.gyro_g_sensitivity_s_m * normals("g sensitivity", 3, 3),
        effort_offset_nm=profile.effort_offset_fraction * limit * effort[:, 0],
        effort_scale=profile.effort_scale * effort[:, 1],
    )
    make_read_only(errors)
    return errors


def per_axis(gyro: float, accel: float) -> Array:
    """Return a value per axis of an IMU, (6,): gyro, accelerometer."""
    return np.array([gyro] * 3 + [accel] * 3)


def _axes(turn_rad: Array, skew_rad: Array) -> Array:
    """Return a sensor's axes (rows) in the IMU frame: the IMU's, turned by a vector and then made oblique."""
    angle = float(np.linalg.norm(turn_rad))
    cross = skew(turn_rad)
    # Rodrigues with (1 - cos a) / a^2 = sinc(a/2)^2 / 2, which is defined at no turn.
    rotation = (
        np.eye(3) + np.sinc(angle / np.pi) * cross + np.sinc(angle / 2.0 / np.pi) ** 2 / 2.0 * cross @ cross
    )
    oblique = np.array([[1.0, 0.0, 0.0], [skew_rad[0], 1.0, 0.0], [skew_rad[1], skew_rad[2], 1.0]])
    axes = oblique @ rotation.T
    unit: Array = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return unit

"""The Fisher information of a joint's motion about the circle of one IMU, predicted before the motion.

An IMU that a joint carries, with the joint's axis j and the radial vector r in its frame, reads

    w = (I + E_w) j dq/dt + b_w
    f = (I + E_f) (R(j, -q) g + j x r d2q/dt2 - r (dq/dt)^2) + b_f,    both late by a delay,

g the specific force of rest at q = 0 in its frame (thesis eqs 12 to 24, with the sensors' own errors).
Unknown are r across the axis, the axis, g but for its size, and the errors of the IMU, which a prior knows in
part. The covariance is the inverse of the information, sum of slopes^T slopes / sigma^2 and the prior: the
Cramer-Rao bound. Joint angles count as exact: encoders are far more precise than IMUs.
"""

from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.imu_intrinsics import slopes
from coordinator.batch_estimation.imu_prediction import turned
from module_agent.model.catalogue import GRAVITY_SIGMA_M_S2
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import ImuPrior
from module_agent.model.perturbation import cross, skew

# Unknowns besides the IMU's own errors: radius (2), axis (2), gravity (3).
GEOMETRY = 7


class CircleSetting(NamedTuple):
    """The expected place of an IMU on its circle: vectors (3,) in its frame at q = 0.

    axis: unit vector. radial_m: across it, from the axis to the IMU. gravity_m_s2: specific force of rest.
    """

    axis: Array
    radial_m: Array
    gravity_m_s2: Array


class SensorNoise(NamedTuple):
    """White noise of one sample, one standard deviation an axis; by default that of a real X5's log."""

    gyro_rad_s: float = 2e-3
    accel_m_s2: float = 0.03


class JointPath(NamedTuple):
    """Samples of a joint's motion, (m,) each, uniform at `rate_hz`."""

    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    rate_hz: float


def circle_readings(setting: CircleSetting, path: JointPath) -> Array:
    """Return the readings of an ideal IMU, gyro and specific force, (6, m)."""
    axis = setting.axis[:, None]
    radial = np.broadcast_to(setting.radial_m[:, None], (3, len(path.q_rad)))
    gravity = turned(setting.axis, -path.q_rad, np.repeat(setting.gravity_m_s2[:, None], len(path.q_rad), 1))
    force = gravity + cross(axis * path.qdd_rad_s2, radial) - radial * path.qd_rad_s**2
    return np.concatenate([axis * path.qd_rad_s, force])


def circle_slopes(setting: CircleSetting, path: JointPath) -> Array:
    """Return the slopes of `circle_readings` by radius, axis and gravity, (7, 6, m).

    Radius: along `radial_m`, then along axis x radial. Axis: turned about the one, then about the other.
    """
    across = radial_directions(setting)
    samples = len(path.q_rad)
    derivatives = np.zeros((GEOMETRY, 6, samples))
    axis = setting.axis[:, None]
    for k, direction in enumerate(across):
        at = np.broadcast_to(direction[:, None], (3, samples))
        derivatives[k, 3:] = cross(axis * path.qdd_rad_s2, at) - at * path.qd_rad_s**2
        tilt = np.cross(direction, setting.axis)
        derivatives[2 + k, :3] = tilt[:, None] * path.qd_rad_s
        derivatives[2 + k, 3:] = _gravity_by_axis(setting, tilt, path.q_rad)
        derivatives[2 + k, 3:] += np.cross(tilt, setting.radial_m)[:, None] * path.qdd_rad_s2
        derivatives[2 + k, 3:] += np.outer(setting.axis, tilt @ setting.radial_m * path.qd_rad_s**2)
    for k, unit in enumerate(np.eye(3)):
        derivatives[4 + k, 3:] = turned(setting.axis, -path.q_rad, np.repeat(unit[:, None], samples, 1))
    return derivatives


def radial_directions(setting: CircleSetting) -> Array:
    """Return unit vectors (2, 3) along the radius and ahead of it; any across the axis if there is none."""
    length = float(np.linalg.norm(setting.radial_m))
    spare = np.cross(setting.axis, np.eye(3)[int(np.argmin(np.abs(setting.axis)))])
    first = setting.radial_m / length if length > 0.0 else spare / np.linalg.norm(spare)
    return np.array([first, np.cross(setting.axis, first)])


def circle_covariance(
    setting: CircleSetting, paths: list[JointPath], noise: SensorNoise, prior: ImuPrior
) -> Array:
    """Return the covariance (7, 7) of radius, axis and gravity after all these motions of the joint.

    Raises:
        DataError: no motion.
    """
    if not paths:
        raise DataError("no motion: at least one is needed for information about the circle")
    free = prior.sigmas > 0.0
    information = np.diag(np.concatenate([np.full(GEOMETRY, 1e-9), prior.sigmas[free] ** -2.0]))
    up = setting.gravity_m_s2 / np.linalg.norm(setting.gravity_m_s2)
    information[4:GEOMETRY, 4:GEOMETRY] += np.outer(up, up) / GRAVITY_SIGMA_M_S2**2
    weight = 1.0 / np.repeat([noise.gyro_rad_s, noise.accel_m_s2], 3)[:, None]
    for path in paths:
        ideal = circle_readings(setting, path)
        rates = np.gradient(ideal, 1.0 / path.rate_hz, axis=1).T
        own = slopes(ideal[:3].T, ideal[3:].T, rates, free)
        rows = (np.concatenate([circle_slopes(setting, path), own]) * weight).reshape(len(information), -1)
        information += rows @ rows.T
    return np.asarray(np.linalg.inv(information)[:GEOMETRY, :GEOMETRY])


def _gravity_by_axis(setting: CircleSetting, tilt: Array, q_rad: Array) -> Array:
    """Return the slope (3, m) of R(j, -q) g by j along `tilt` (Rodrigues' formula, thesis 2.2)."""
    axis, gravity = setting.axis, setting.gravity_m_s2
    bent = tilt * (axis @ gravity) + axis * (tilt @ gravity)
    return np.outer(bent, 1.0 - np.cos(q_rad)) - np.outer(skew(tilt) @ gravity, np.sin(q_rad))

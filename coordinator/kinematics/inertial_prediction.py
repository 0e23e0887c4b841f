"""What every IMU of a chain reads during a motion: the forward model of the batch refinement."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.chain import Array, Chain
from coordinator.kinematics.forward import BASE, carrier


class ImuReadings(NamedTuple):
    """Rates [rad/s] and specific forces [m/s^2] of n IMUs, each in its own frame, (m, n, 3)."""

    gyro_rad_s: Array
    accel_m_s2: Array


class _Twist(NamedTuple):
    """Motion of one body in its own frame (which is the root frame at q = 0), (m, 3) each.

    `acceleration` is that of the frame's origin against free fall: at rest it is the specific force of rest.
    """

    omega: Array
    alpha: Array
    acceleration: Array


def imu_readings(chain: Chain, q_rad: ArrayLike, qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike) -> ImuReadings:
    """Predict ideal IMUs: f = R^T (a + alpha x p + omega x (omega x p)), with a against free fall.

    Args:
        chain: n joints; `chain.gravity` is the specific force of rest.
        q_rad, qd_rad_s, qdd_rad_s2: (m, n) joint positions, velocities, accelerations.

    Returns:
        Readings in the IMU frames, (m, n, 3).
    """
    q, qd, qdd = (np.asarray(signal, dtype=float) for signal in (q_rad, qd_rad_s, qdd_rad_s2))
    samples, joints = q.shape
    rest = np.zeros((samples, 3))
    base = _Twist(rest, rest, np.broadcast_to(chain.gravity, (samples, 3)))
    bodies: list[_Twist] = []
    for i, parent in enumerate(chain.parent):
        below = base if parent == BASE else bodies[parent]
        bodies.append(_carry(below, chain.axis[i], chain.point[i], q[:, i], qd[:, i], qdd[:, i]))
    gyro, accel = np.empty((samples, joints, 3)), np.empty((samples, joints, 3))
    for k in range(joints):
        body = carrier(chain, k)
        motion = base if body == BASE else bodies[body]
        turn, place = chain.imu_home[k, :3, :3], chain.imu_home[k, :3, 3]
        force = (
            motion.acceleration
            + np.cross(motion.alpha, place)
            + np.cross(motion.omega, np.cross(motion.omega, place))
        )
        gyro[:, k] = motion.omega @ turn
        accel[:, k] = force @ turn
    return ImuReadings(gyro, accel)


def _carry(below: _Twist, axis: Array, point: Array, q: Array, qd: Array, qdd: Array) -> _Twist:
    """Return the motion beyond a joint, in the frame that turns with it, from the motion below it.

    At a point of the axis both bodies accelerate alike (Craig, Introduction to Robotics, eqs 6.45-6.48).
    """
    at_axis = (
        below.acceleration
        + np.cross(below.alpha, point)
        + np.cross(below.omega, np.cross(below.omega, point))
    )
    spin = axis * qd[:, None]
    turned_omega = _unturn(axis, q, below.omega)
    omega = turned_omega + spin
    alpha = _unturn(axis, q, below.alpha) + np.cross(turned_omega, spin) + axis * qdd[:, None]
    origin = _unturn(axis, q, at_axis) - np.cross(alpha, point) - np.cross(omega, np.cross(omega, point))
    return _Twist(omega, alpha, origin)


def _unturn(axis: Array, q: Array, vectors: Array) -> Array:
    """Return R(axis, -q) v for every sample, Rodrigues' formula (thesis 2.2)."""
    cosine, sine = np.cos(q)[:, None], np.sin(q)[:, None]
    along = (vectors @ axis)[:, None] * axis
    return np.asarray(cosine * vectors - sine * np.cross(axis, vectors) + (1.0 - cosine) * along)

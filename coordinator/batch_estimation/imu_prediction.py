"""The readings of every IMU of a chain during a motion: the forward model of the batch estimator."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.batch_estimation.imu_kernel import fill_bodies
from coordinator.batch_estimation.sensor_data import BaseMotion
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.perturbation import cross, skew


class ImuReadings(NamedTuple):
    """Rates [rad/s] and specific forces [m/s^2] of n IMUs, each in its own frame, (m, n, 3)."""

    gyro_rad_s: Array
    accel_m_s2: Array


class BodyMotion(NamedTuple):
    """Motion of one body in its own frame (which is the root frame at q = 0), (3, m) each.

    `acceleration` is that of the frame's origin against free fall: at rest it is the specific force of rest.
    """

    omega: Array
    alpha: Array
    acceleration: Array


class LinkTurn(NamedTuple):
    """A small turn of a link about a place (3,) of the body that it starts from, in that body's frame.

    theta_rad: (3, 3, m) rotation vector, its first and its second time derivative.
    """

    hinge: Array
    theta_rad: Array


LinkTurns = Mapping[int, Sequence[LinkTurn]]


def imu_readings(chain: Chain, q_rad: ArrayLike, qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike) -> ImuReadings:
    """Predict ideal IMUs: f = R^T (a + alpha x p + omega x (omega x p)), with a against free fall.

    Args:
        chain: n joints; `chain.gravity` is the specific force of rest.
        q_rad, qd_rad_s, qdd_rad_s2: (m, n) joint positions, velocities, accelerations.
    """
    return readings_on(chain, body_motions(chain, q_rad, qd_rad_s, qdd_rad_s2))


def readings_on(chain: Chain, bodies: list[BodyMotion], turns: LinkTurns | None = None) -> ImuReadings:
    """Predict ideal IMUs from the motion of the bodies, as `body_motions` returns it for the same `turns`."""
    joints = len(chain.serials)
    samples = bodies[BASE].omega.shape[1]
    gyro, accel = np.empty((samples, joints, 3)), np.empty((samples, joints, 3))
    for k in range(joints):
        motion = bodies[chain.carrier(k)]
        if turns and not chain.reversed[k]:
            motion = given(motion, turns.get(k, ()))
        turn, place = chain.imu_home[k, :3, :3], chain.imu_home[k, :3, 3, None]
        gyro[:, k] = motion.omega.T @ turn
        accel[:, k] = acceleration_at(motion, place).T @ turn
    return ImuReadings(gyro, accel)


def body_motions(
    chain: Chain,
    q_rad: ArrayLike,
    qd_rad_s: ArrayLike,
    qdd_rad_s2: ArrayLike,
    base_motion: BaseMotion | None = None,
    turns: LinkTurns | None = None,
) -> list[BodyMotion]:
    """Return the motion of every body, the base in the last place, where the index -1 finds it.

    Args as in `imu_readings`. `base_motion` is the base's motion measured by the first module's IMU; None
    means rest. `turns` are those of compliant links, by the module that each link carries.
    """
    q, qd, qdd = (np.asarray(signal, dtype=float).T for signal in (q_rad, qd_rad_s, qdd_rad_s2))
    base = _base(chain, q.shape[1], base_motion)
    bodies: list[BodyMotion] = []
    if turns is None:
        motion = np.empty((len(chain.parent) + 1, 9, q.shape[1]))
        motion[-1] = np.concatenate(base)
        fill_bodies(
            np.array(chain.parent, dtype=np.int64),
            np.array(chain.axis),
            np.array(chain.point),
            np.stack([q.T, qd.T, qdd.T]),
            motion,
        )
        return [BodyMotion(body[:3], body[3:6], body[6:]) for body in motion]
    for i, parent in enumerate(chain.parent):
        below = base if parent == BASE else bodies[parent]
        below = given(below, turns.get(i, ()))
        bodies.append(_carry(below, chain.axis[i], chain.point[i][:, None], q[i], qd[i], qdd[i]))
    return [*bodies, base]


def given(body: BodyMotion, turns: Sequence[LinkTurn]) -> BodyMotion:
    """Return the motion beyond hinges that turn a little, to first order, in the frame that turns along."""
    for turn in turns:
        angle, rate, acceleration = turn.theta_rad
        at_hinge = acceleration_at(body, turn.hinge[:, None])
        omega = body.omega + rate - cross(angle, body.omega)
        alpha = body.alpha + acceleration + cross(body.omega, rate) - cross(angle, body.alpha)
        moved = BodyMotion(omega, alpha, at_hinge - cross(angle, at_hinge))
        body = moved._replace(acceleration=acceleration_at(moved, -turn.hinge[:, None]))
    return body


def _base(chain: Chain, samples: int, seen: BaseMotion | None) -> BodyMotion:
    gravity = np.broadcast_to(chain.gravity[:, None], (3, samples))
    if seen is None:
        rest = np.zeros((3, samples))
        return BodyMotion(rest, rest, gravity)
    turn, place = chain.imu_home[0, :3, :3], chain.imu_home[0, :3, 3, None]
    omega, alpha, acceleration = (turn @ signal.T for signal in seen)
    at_imu = BodyMotion(omega, alpha, gravity + acceleration)
    return BodyMotion(omega, alpha, acceleration_at(at_imu, -place))


def acceleration_at(body: BodyMotion, place: Array) -> Array:
    """Return the acceleration (3, m) against free fall of points (3, m) that are fixed to a body."""
    return np.asarray(
        body.acceleration + cross(body.alpha, place) + cross(body.omega, cross(body.omega, place))
    )


def turned(axis: Array, angle_rad: Array, vectors: Array) -> Array:
    """Return R(axis, angle) v of vectors (3, ..., m) for angles (m,), Rodrigues' formula (thesis 2.2)."""
    flat = vectors.reshape(3, -1)
    across = (skew(axis) @ flat).reshape(vectors.shape)
    along = (np.outer(axis, axis) @ flat).reshape(vectors.shape)
    return np.asarray(along + np.cos(angle_rad) * (vectors - along) + np.sin(angle_rad) * across)


def _carry(below: BodyMotion, axis: Array, point: Array, q: Array, qd: Array, qdd: Array) -> BodyMotion:
    """Return the motion beyond a joint, in the frame that turns with it, from the motion below it.

    At a point of the axis both bodies accelerate alike (Craig, Introduction to Robotics, eqs 6.45-6.48).
    """
    moved = np.stack([below.omega, below.alpha, acceleration_at(below, point)], axis=1)
    turned_omega, turned_alpha, at_axis = np.swapaxes(turned(axis, -q, moved), 0, 1)
    spin = axis[:, None] * qd
    omega = turned_omega + spin
    alpha = turned_alpha + cross(turned_omega, spin) + axis[:, None] * qdd
    return BodyMotion(omega, alpha, acceleration_at(BodyMotion(omega, alpha, at_axis), -point))

"""The readings of every IMU of a chain during a motion: the forward model of the batch estimator."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coordinator.batch_estimation.imu_kernel import Turns, fill_bodies, fill_readings
from coordinator.batch_estimation.sensor_data import BaseMotion
from module_agent.model.chain import Array, Chain
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
    joints, motion = len(chain.serials), stacked(bodies)
    gyro, accel = (np.empty((motion.shape[2], joints, 3)) for _ in range(2))
    carrier = np.array([chain.carrier(k) for k in range(joints)], dtype=np.int64)
    between = {k: own for k, own in (turns or {}).items() if not chain.reversed[k]}
    fill_readings(carrier, np.array(chain.imu_home), kernel_turns(between, motion), motion, gyro, accel)
    return ImuReadings(gyro, accel)


def stacked(bodies: Sequence[BodyMotion]) -> Array:
    """Return bodies, from `body_motions`, as kernels take them, (n + 1, 9, m)."""
    return np.array([np.concatenate(body) for body in bodies])


def kernel_turns(turns: LinkTurns | None, bodies: Array) -> Turns:
    """Return the turns of links between bodies (n + 1, 9, m) as kernels take them."""
    each = [(turns or {}).get(i, ()) for i in range(len(bodies) - 1)]
    first = np.cumsum([0, *map(len, each)], dtype=np.int64)
    hinge, theta = np.zeros((first[-1], 3)), np.zeros((first[-1], 9, bodies.shape[2]))
    for k, turn in enumerate(turn for own in each for turn in own):
        hinge[k], theta[k] = turn.hinge, turn.theta_rad.reshape(theta.shape[1:])
    return Turns(first, hinge, theta)


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
    joints = np.array([q_rad, qd_rad_s, qdd_rad_s2], dtype=float)
    motion = np.empty((len(chain.parent) + 1, 9, joints.shape[1]))
    motion[-1] = np.concatenate(_base(chain, joints.shape[1], base_motion))
    fill_bodies(*kernel_joints(chain), joints, kernel_turns(turns, motion), motion)
    return [BodyMotion(body[:3], body[3:6], body[6:]) for body in motion]


def kernel_joints(chain: Chain) -> tuple[NDArray[np.int64], Array, Array]:
    """Return parents (n,), axes and points (n, 3) of a chain's joints as kernels take them."""
    return np.array(chain.parent, dtype=np.int64), np.array(chain.axis), np.array(chain.point)


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

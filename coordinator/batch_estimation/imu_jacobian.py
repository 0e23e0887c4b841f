"""How the readings of an IMU change with the chain: the derivatives of `imu_prediction`.

A perturbation xi of module a makes the turn exp(S q) of its joint into exp(xi) exp(S q) exp(-xi). So all that
lies beyond the joint is displaced by xi in the frame of the body below, and by -xi in that of the body
beyond; the module's own IMU is displaced by xi in the frame of its carrier. All that is needed is the change
of one IMU's readings when it is displaced, together with everything between, by a constant twist in the
frame of some body that carries it.
"""

from typing import NamedTuple

import numpy as np

from coordinator.batch_estimation.imu_prediction import BodyMotion, acceleration_at, turned
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import cross, skew


class ImuJacobian(NamedTuple):
    """Slopes of one IMU's readings [gyro (3), specific force (3)] in its own frame.

    modules: k modules on whose perturbations it depends, in the order of the chain. poses: (6 k, 6, m) slopes
    by the perturbations (`apply_perturbation`) of those modules. gravity: (3, 6, m) slopes by
    `chain.gravity`. placement: (6, 6, m) slopes by the IMU's own turn and displacement in its own frame.
    """

    modules: tuple[int, ...]
    poses: Array
    gravity: Array
    placement: Array


class _Seen(NamedTuple):
    """An IMU relative to a body, in the body's frame: frame (3, 3, m), place and velocity (3, m)."""

    frame: Array
    place: Array
    velocity: Array


def imu_jacobian(
    chain: Chain, bodies: list[BodyMotion], q_rad: Array, qd_rad_s: Array, module: int
) -> ImuJacobian:
    """Differentiate the readings of one module's IMU.

    Args:
        chain: n joints.
        bodies: their motion, from `body_motions`.
        q_rad, qd_rad_s: (m, n) joint positions and velocities.
        module: the module that the IMU belongs to.
    """
    body = chain.carrier(module)
    joints = chain.ancestors(body)
    samples, home = q_rad.shape[0], chain.imu_home[module]
    frame = np.broadcast_to(home[:3, :3, None], (3, 3, samples))
    seen = _Seen(frame, np.broadcast_to(home[:3, 3, None], (3, samples)), np.zeros((3, samples)))
    moved = {body: _displaced(bodies[body], seen)}
    for joint in reversed(joints):
        seen = _from_below(chain, joint, q_rad[:, joint], qd_rad_s[:, joint], seen)
        moved[chain.parent[joint]] = _displaced(bodies[chain.parent[joint]], seen)
    poses = {joint: moved[chain.parent[joint]] - moved[joint] for joint in joints}
    poses[module] = poses.get(module, 0.0) + moved[body]
    modules = tuple(sorted(poses))
    gravity = np.zeros((3, 6, samples))
    gravity[:, 3:] = seen.frame
    turn, place = chain.imu_home[module, :3, :3], chain.imu_home[module, :3, 3]
    # A turn about the IMU itself is one about the frame's origin, and a displacement back.
    about_itself = np.block([[turn.T, -turn.T @ skew(place)], [np.zeros((3, 3)), turn.T]])
    placement = np.einsum("ij,jcm->icm", about_itself, moved[body])
    return ImuJacobian(modules, np.concatenate([poses[joint] for joint in modules]), gravity, placement)


def _from_below(chain: Chain, joint: int, q: Array, qd: Array, seen: _Seen) -> _Seen:
    """Return the IMU relative to the body below a joint, from that relative to the body beyond."""
    axis, point = chain.axis[joint], chain.point[joint][:, None]
    stacked = np.concatenate([seen.frame, (seen.place - point)[:, None], seen.velocity[:, None]], axis=1)
    moved = turned(axis, q, stacked)
    off = moved[:, 3]
    return _Seen(moved[:, :3], point + off, moved[:, 4] + cross(axis[:, None] * qd, off))


def _displaced(body: BodyMotion, seen: _Seen) -> Array:
    """Return the slopes (6, 6, m) of the IMU's readings by a twist [theta, tau] in a body's frame.

    With the IMU at x, moving at x' and accelerating at x'' in that frame, its readings are
    R^T (omega + relative rate) and R^T (a + x'' + 2 omega x x' + M x), M = [alpha x] + [omega x]^2. The twist
    turns R, x, x' and x'' by theta and moves x by tau; what is turned with R cancels.
    """
    spin, place, velocity = (_matrix(v) for v in (body.omega, seen.place, seen.velocity))
    carried = _matrix(body.alpha) + _product(spin, spin)
    force = acceleration_at(body, seen.place) + 2.0 * cross(body.omega, seen.velocity)
    turning = _matrix(force) - 2.0 * _product(spin, velocity) - _product(carried, place)
    changes = np.concatenate([spin, turning, carried], axis=1)
    rate, by_turning, by_moving = np.split(np.einsum("jim,jcm->cim", seen.frame, changes), 3)
    slopes = np.zeros((6, 6, seen.place.shape[1]))
    slopes[:3, :3], slopes[:3, 3:], slopes[3:, 3:] = rate, by_turning, by_moving
    return slopes


def _matrix(vectors: Array) -> Array:
    """Return the matrices (3, 3, m) of the cross products with vectors (3, m)."""
    x, y, z = vectors
    matrices = np.zeros((3, *vectors.shape))
    matrices[0, 1], matrices[0, 2], matrices[1, 2] = -z, y, -x
    matrices[1, 0], matrices[2, 0], matrices[2, 1] = z, -y, x
    return matrices


def _product(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ijm,jcm->icm", a, b))

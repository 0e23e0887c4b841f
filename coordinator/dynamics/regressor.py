"""Newton-Euler regressor of a `Chain`: joint torques as a linear function of the bodies' inertial parameters.

The torque about joint i is the sum, over the bodies j that it carries, of joint i's screw times the wrench on
body j, and that wrench is linear in the ten parameters of the body (thesis eqs 25-28). The bodies' frames
coincide with the root frame at q = 0, so a body's parameters are constants in the root frame at q = 0.

The screws of all the joints below a body are carried up into the body's frame, which gives every entry of the
regressor directly; neither 6 x 6 transforms nor 6 x 10 wrench matrices are built.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.chain import Array, Chain
from coordinator.cross_product import cross
from coordinator.kinematics.forward import BASE, ancestors

BODY_PARAMETERS = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
PER_BODY = len(BODY_PARAMETERS)

# As of 2026-11-21 with 7 joints and one thread: 3.5 us a sample in blocks of 1024, 7.8 in blocks of 256
# (calls dominate), 4.1 in one block of 5000 (the work arrays leave the cache).
_BLOCK = 1024


class _BodyMotion(NamedTuple):
    """Motion of one body in its own frame, sample axis last: everything (3, m) but `screws` (2, k, 3, m).

    `acceleration` is that of the frame's origin against free fall (p'' - g of thesis eq. 25); `screws` holds
    the direction and the moment of the k joints that carry the body, root joint first, its own last.
    """

    omega: Array
    velocity: Array
    alpha: Array
    acceleration: Array
    screws: Array


def torque_regressor(chain: Chain, q_rad: ArrayLike, qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike) -> Array:
    """Return the matrix Y with joint torques tau = Y @ phi.

    Args:
        chain: n joints; `chain.gravity` is the specific force of rest.
        q_rad, qd_rad_s, qdd_rad_s2: (m, n) joint positions, velocities and accelerations.

    Returns:
        (m, n, 10 n), read-only. `phi` stacks [m, mcx, mcy, mcz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz] body by body
        (thesis eq. 25; kg, kg m, kg m^2) in the root frame at q = 0, the inertia about that frame's origin.
        tau_i [Nm] is the torque of module i on its distal side about its axis, positive with +q. The block
        Y[:, i, 10 j:10 j + 10] is zero unless joint i carries body j.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """
    q, qd, qdd = _check_motion(chain, q_rad, qd_rad_s, qdd_rad_s2)
    samples, joints = q.shape
    found = np.zeros((samples, joints, PER_BODY * joints))
    for begin in range(0, samples, _BLOCK):
        part = slice(begin, min(begin + _BLOCK, samples))
        _fill(chain, q[part], qd[part], qdd[part], found[part])
    found.flags.writeable = False
    return found


def inverse_dynamics(
    chain: Chain, phi: ArrayLike, q_rad: ArrayLike, qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike
) -> Array:
    """Return the joint torques (m, n) [Nm] of a motion, `torque_regressor(...) @ phi`, read-only.

    The regressor is built in blocks of samples and dropped, so that a long motion of many joints fits memory.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """
    q, qd, qdd = _check_motion(chain, q_rad, qd_rad_s, qdd_rad_s2)
    parameters = check_phi(chain, phi)
    torque = np.empty(q.shape)
    for begin in range(0, q.shape[0], _BLOCK):
        part = slice(begin, begin + _BLOCK)
        torque[part] = torque_regressor(chain, q[part], qd[part], qdd[part]) @ parameters
    torque.flags.writeable = False
    return torque


def check_phi(chain: Chain, phi: ArrayLike) -> Array:
    """Return `phi` flat, (10 n,); it may come as (n, 10).

    Raises:
        ValueError: another number of parameters, or one that is not finite.
    """
    flat = np.asarray(phi, dtype=float).reshape(-1)
    joints = len(chain.serials)
    if flat.size != PER_BODY * joints:
        raise ValueError(f"phi has {flat.size} values; a chain of {joints} joints needs {PER_BODY * joints}")
    if not np.isfinite(flat).all():
        raise ValueError("phi holds a value that is not finite")
    return flat


def _check_motion(chain: Chain, *signals: ArrayLike) -> tuple[Array, ...]:
    joints = len(chain.serials)
    arrays = tuple(np.asarray(signal, dtype=float) for signal in signals)
    for name, array in zip(("q_rad", "qd_rad_s", "qdd_rad_s2"), arrays, strict=True):
        if array.ndim != 2 or array.shape[1] != joints or array.shape != arrays[0].shape:
            raise ValueError(
                f"{name} has shape {array.shape}; a chain of {joints} joints needs (samples, {joints}), "
                f"the same for positions, velocities and accelerations"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"{name} holds a value that is not finite")
    return arrays


def _fill(chain: Chain, q: Array, qd: Array, qdd: Array, found: Array) -> None:
    for body, motion in enumerate(_body_motions(chain, q.T, qd.T, qdd.T)):
        block = slice(PER_BODY * body, PER_BODY * (body + 1))
        rows = _torque_rows(motion)
        for joint, row in zip(ancestors(chain, body), rows, strict=True):
            found[:, joint, block] = row.T


def _body_motions(chain: Chain, q: Array, qd: Array, qdd: Array) -> Iterator[_BodyMotion]:
    """Carry motion and screws up the tree; `q`, `qd`, `qdd` are (n, m)."""
    samples = q.shape[1]
    rest = np.zeros((3, samples))
    upward = np.broadcast_to(chain.gravity[:, None], (3, samples))
    base = _BodyMotion(rest, rest, rest, upward, np.empty((2, 0, 3, samples)))
    motions: list[_BodyMotion] = []
    for i, parent in enumerate(chain.parent):
        below = base if parent == BASE else motions[parent]
        motions.append(_carry(below, chain.axis[i], chain.point[i], q[i], qd[i], qdd[i]))
        yield motions[i]


def _carry(below: _BodyMotion, axis: Array, point: Array, q: Array, qd: Array, qdd: Array) -> _BodyMotion:
    """Return the motion beyond a joint from the motion below it.

    Twists and spatial accelerations transform as Ad(exp(-S q)), and V' = Ad V + S qd,
    A' = Ad A + ad(V') S qd + S qdd (Featherstone, Rigid Body Dynamics Algorithms, table 5.1). The
    acceleration kept is the classical one, A_linear + omega x v.
    """
    turn, offset = _inverse_displacement(axis, point, q)
    moment = -cross(axis[:, None], point[:, None])
    stacked = np.stack([below.omega, below.alpha])
    linear = np.stack([below.velocity, below.acceleration - cross(below.omega, below.velocity)])
    (omega, alpha), (velocity, spatial) = _transform(turn, offset, stacked, linear)
    omega = omega + axis[:, None] * qd
    velocity = velocity + moment * qd
    alpha = alpha + cross(omega, axis[:, None] * qd) + axis[:, None] * qdd
    spatial = spatial + cross(velocity, axis[:, None] * qd) + cross(omega, moment * qd) + moment * qdd
    carried = np.stack(_transform(turn, offset, below.screws[0], below.screws[1]))
    own = np.broadcast_to(np.stack([axis, moment[:, 0]])[:, None, :, None], (2, 1, 3, q.size))
    screws = np.concatenate([carried, own], axis=1)
    return _BodyMotion(omega, velocity, alpha, spatial + cross(omega, velocity), screws)


def _inverse_displacement(axis: Array, point: Array, q: Array) -> tuple[Array, Array]:
    """Return R^T (3, 3, m) and p (3, m) of the turn (R, p) about the joint's axis by q (m,)."""
    back = np.cross(axis, np.eye(3))  # its rows are axis x e_i: the transpose of [axis x]
    # Rodrigues' formula for -q.
    turn = (
        np.eye(3)[:, :, None] + back[:, :, None] * np.sin(q) + (back @ back)[:, :, None] * (1.0 - np.cos(q))
    )
    return turn, point[:, None] - np.einsum("jim,j->im", turn, point)


def _transform(turn: Array, offset: Array, angular: Array, linear: Array) -> tuple[Array, Array]:
    """Bring twists (k, 3, m) into the displaced frame: w' = R^T w, v' = R^T (v + w x p)."""
    moved = linear + cross(angular, offset)
    return np.einsum("ijm,kjm->kim", turn, angular), np.einsum("ijm,kjm->kim", turn, moved)


def _torque_rows(motion: _BodyMotion) -> Array:
    """Return the regressor rows (k, 10, m) of one body for the k joints that carry it.

    With the wrench (f, n) of thesis eq. 25 on the body and a joint's screw (w, v): tau = w . n + v . f.
    Grouped by parameter that is a x w + B^T v for `mc`, with B = [alpha x] + [omega x]^2, and
    w . (I alpha) + (w x omega) . (I omega) for the inertia.
    """
    w, v = motion.screws
    omega, alpha, a = motion.omega, motion.alpha, motion.acceleration
    rows = np.empty((w.shape[0], PER_BODY, w.shape[2]))
    rows[:, 0] = np.einsum("kim,im->km", v, a)
    rows[:, 1:4] = cross(a, w) + cross(v, alpha) + cross(omega, cross(omega, v))
    u = cross(w, omega)
    for column, (r, c) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)), start=4):
        rows[:, column] = w[:, r] * alpha[c] + u[:, r] * omega[c]
        if r != c:
            rows[:, column] += w[:, c] * alpha[r] + u[:, c] * omega[r]
    return rows

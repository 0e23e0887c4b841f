"""Newton-Euler regressor of a `Chain`: joint torques as a linear function of the bodies' inertial parameters.

The torque about joint i is the sum, over the bodies j that it carries, of joint i's screw times the wrench on
body j, and that wrench is linear in the ten parameters of the body (thesis eqs 25-28). The bodies' frames
coincide with the root frame at q = 0, so a body's parameters are constants in the root frame at q = 0.

The screws of all the joints below a body are carried up into the body's frame, which gives every entry of the
regressor directly. Twists and spatial accelerations transform as Ad(exp(-S q)), and V' = Ad V + S qd,
A' = Ad A + ad(V') S qd + S qdd (Featherstone, Rigid Body Dynamics Algorithms, table 5.1).
"""

import numpy as np
from numpy.typing import ArrayLike

from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.read_only import read_only
from module_agent.model.regressor_kernel import Index, fill_regressor

BODY_PARAMETERS = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
PER_BODY = len(BODY_PARAMETERS)

# Bounds the memory of what needs no whole regressor: 9 MB with 7 joints.
_BLOCK = 2048


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
    regressor = np.zeros((samples, joints, PER_BODY * joints))
    carriers, depth = _carriers(chain)
    axis, point, gravity = (_plain(a) for a in (chain.axis, chain.point, chain.gravity))
    fill_regressor(carriers, depth, axis, point, gravity, _plain(q), _plain(qd), _plain(qdd), regressor)
    return read_only(regressor)


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
    return read_only(torque)


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
        raise DataError("phi holds a value that is not finite")
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
            raise DataError(f"{name} holds a value that is not finite")
    return arrays


def _plain(array: Array) -> Array:
    """Return a writable copy in C order: of one kind of array only, the kernel is compiled once."""
    return np.array(array, dtype=float, order="C")


def _carriers(chain: Chain) -> tuple[Index, Index]:
    """Return the joints that carry every body (n, n), the root's first, and how many they are (n,)."""
    joints = len(chain.serials)
    carriers, depth = np.zeros((joints, joints), dtype=np.int64), np.zeros(joints, dtype=np.int64)
    for body in range(joints):
        above = chain.ancestors(body)
        carriers[body, : len(above)], depth[body] = above, len(above)
    return carriers, depth

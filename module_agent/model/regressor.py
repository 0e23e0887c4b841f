"""Newton-Euler regressor of a `Chain`: joint torques as a linear function of the bodies' inertial parameters.

The torque about joint i is the sum, over the bodies j that it carries, of joint i's screw times the wrench on
body j, and that wrench is linear in the ten parameters of the body (thesis eqs 25-28). The bodies' frames
coincide with the root frame at q = 0, so a body's parameters are constants in the root frame at q = 0.

The screws of all the joints below a body are carried up into the body's frame, which gives every entry of the
regressor directly. Twists and spatial accelerations transform as Ad(exp(-S q)), and V' = Ad V + S qd,
A' = Ad A + ad(V') S qd + S qdd (Featherstone, Rigid Body Dynamics Algorithms, table 5.1).
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.read_only import read_only
from module_agent.model.regressor_kernel import LANES, Index, fill_regressor, fill_torques

BODY_PARAMETERS = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
PER_BODY = len(BODY_PARAMETERS)

SIGNALS = ("q_rad", "qd_rad_s", "qdd_rad_s2")

# Values in a chunk: 1 MB, which stays in the second cache.
_CHUNK_VALUES = 2**17


def torque_regressor(
    chain: Chain,
    q_rad: ArrayLike,
    qd_rad_s: ArrayLike,
    qdd_rad_s2: ArrayLike,
    *,
    out: Array | None = None,
    threads: int = 1,
) -> Array:
    """Return the matrix Y with joint torques tau = Y @ phi.

    Args:
        chain: n joints; `chain.gravity` is the specific force of rest.
        q_rad, qd_rad_s, qdd_rad_s2: (m, n) joint positions, velocities and accelerations.
        out: (m, n, 10 n) where the result is written: zeros, or what was written for a chain with the same
            parents. New memory costs three times the calculation.
        threads: in how many the samples are divided; the result is the same. Of a run no part has more than
            one: of the information of 20,000 samples of 7 joints (`information.gather`) the regressor takes
            9 ms, and the QR decompositions take 0.2 s. It is for who needs the matrix itself.

    Returns:
        (m, n, 10 n), read-only. `phi` stacks [m, mcx, mcy, mcz, Ixx, Ixy, Ixz, Iyy, Iyz, Izz] body by body
        (thesis eq. 25; kg, kg m, kg m^2) in the root frame at q = 0, the inertia about that frame's origin.
        tau_i [Nm] is the torque of module i on its distal side about its axis, positive with +q. The block
        Y[:, i, 10 j:10 j + 10] is zero unless joint i carries body j, as all before column 10 i.

    Raises:
        ValueError: shapes that do not fit, values that are not finite, or an `out` of another layout or tree.
    """
    motion = _check_motion(chain, q_rad, qd_rad_s, qdd_rad_s2)
    samples, _, joints = motion.shape
    shape = (samples, joints, PER_BODY * joints)
    regressor = np.zeros(shape) if out is None else _check_out(chain, out, shape)
    arguments = (_carriers(chain.parent), *_geometry(chain))
    if threads <= 1:
        fill_regressor(*arguments, motion, regressor)
    else:
        ends = [samples * k // threads for k in range(threads + 1)]
        parts = [slice(*pair) for pair in pairwise(ends)]
        with ThreadPoolExecutor(threads) as pool:
            for done in [pool.submit(fill_regressor, *arguments, motion[p], regressor[p]) for p in parts]:
                done.result()
    return read_only(regressor.view())


class RegressorStream:
    """The regressor of one chain, one sample after the other, into the same array; motions are not checked.

    A call gives the same bits as `torque_regressor`, without its checks. It is for parameters that change
    from sample to sample. Torque control has constant ones: `inverse_dynamics` gives the torques of a whole
    motion without a regressor, and gravity compensation, which has one sample at a time, would save 7 us of
    the 5 ms between its set-points (7 joints).
    """

    def __init__(self, chain: Chain):
        joints = len(chain.serials)
        self._chain = (_carriers(chain.parent), *_geometry(chain))
        self._motion = np.zeros((1, 3, joints))
        self._q, self._qd, self._qdd = self._motion[0]
        self._regressor = np.zeros((1, joints, PER_BODY * joints))
        self._rows = read_only(self._regressor[0])

    def rows(self, q_rad: Array, qd_rad_s: Array, qdd_rad_s2: Array) -> Array:
        """Return the regressor (n, 10 n) of a sample, (n,) each: read-only, overwritten by the next call."""
        self._q[:], self._qd[:], self._qdd[:] = q_rad, qd_rad_s, qdd_rad_s2
        fill_regressor(*self._chain, self._motion, self._regressor)
        return self._rows


def regressor_chunks(
    chain: Chain, q_rad: ArrayLike, qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike
) -> Iterator[tuple[slice, Array]]:
    """Yield `torque_regressor` of a long motion chunk by chunk: samples, and (samples, n, 10 n) of them.

    All chunks are in the same memory, which fits the second cache: the next one overwrites the last.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """
    motion = _check_motion(chain, q_rad, qd_rad_s, qdd_rad_s2)
    samples, _, joints = motion.shape
    arguments = (_carriers(chain.parent), *_geometry(chain))
    step = max(2, _CHUNK_VALUES // (PER_BODY * joints * joints * LANES)) * LANES
    regressor = np.zeros((min(step, samples), joints, PER_BODY * joints))
    rows = read_only(regressor.view())
    for begin in range(0, samples, step):
        part = slice(begin, min(begin + step, samples))
        count = part.stop - begin
        fill_regressor(*arguments, motion[part], regressor[:count])
        yield part, rows[:count]


def inverse_dynamics(
    chain: Chain, phi: ArrayLike, q_rad: ArrayLike, qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike
) -> Array:
    """Return the joint torques (m, n) [Nm] of a motion, those of `torque_regressor(...) @ phi`, read-only.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """
    motion = _check_motion(chain, q_rad, qd_rad_s, qdd_rad_s2)
    torque = np.empty((len(motion), len(chain.serials)))
    parent = np.array(chain.parent, dtype=np.int64)
    fill_torques(parent, *_geometry(chain), _plain(check_phi(chain, phi)), motion, torque)
    return read_only(torque)


def gram_matrix(
    chain: Chain, q_rad: ArrayLike, qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike, weights: ArrayLike
) -> Array:
    """Return the sum of w_i Y_i^T Y_i over samples and joints, (10 n, 10 n), with `weights` (n,) of joints.

    Only what may be other than zero is multiplied, and no regressor of the whole motion is held.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """
    joints = len(chain.serials)
    gram = np.zeros((PER_BODY * joints, PER_BODY * joints))
    for _, rows in regressor_chunks(chain, q_rad, qd_rad_s, qdd_rad_s2):
        for i, weight in enumerate(np.asarray(weights, dtype=float)):
            # Nothing before a joint is carried by it.
            own = rows[:, i, PER_BODY * i :]
            gram[PER_BODY * i :, PER_BODY * i :] += weight * (own.T @ own)
    return read_only(gram)


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


def _check_motion(chain: Chain, *signals: ArrayLike) -> Array:
    """Return positions, velocities and accelerations as one array (m, 3, n)."""
    joints = len(chain.serials)
    arrays = tuple(np.asarray(signal, dtype=float) for signal in signals)
    for name, array in zip(SIGNALS, arrays, strict=True):
        if array.ndim != 2 or array.shape[1] != joints or array.shape != arrays[0].shape:
            raise ValueError(
                f"{name} has shape {array.shape}; a chain of {joints} joints needs (samples, {joints}), "
                f"the same for positions, velocities and accelerations"
            )
    motion = np.concatenate(arrays, axis=1).reshape(-1, 3, joints)
    if not np.isfinite(motion).all():
        name = SIGNALS[int(np.flatnonzero(~np.isfinite(motion).all(axis=(0, 2)))[0])]
        raise DataError(f"{name} holds a value that is not finite")
    return motion


def _check_out(chain: Chain, out: Array, shape: tuple[int, int, int]) -> Array:
    """Return a result array that the kernel can write to; of its zeros the first sample's are checked."""
    if out.shape != shape or out.dtype != np.float64:
        raise ValueError(f"out is {out.dtype} {out.shape}; this motion needs float64 {shape}")
    if not (out.flags.c_contiguous and out.flags.writeable):
        raise ValueError("out is not contiguous or cannot be written to; take np.zeros, or its first samples")
    if len(out) and out[0].reshape(-1)[_not_carried(chain.parent)].any():
        raise ValueError(
            "out is not zero where a joint does not carry a body; take np.zeros, or what was written for "
            "a chain with the same parents"
        )
    return out


def _geometry(chain: Chain) -> tuple[Array, Array, Array]:
    return _plain(chain.axis), _plain(chain.point), _plain(chain.gravity)


def _plain(array: Array) -> Array:
    """Return a writable copy in C order: of one kind of array only, the kernel is compiled once."""
    return np.array(array, dtype=float, order="C")


@lru_cache(maxsize=64)
def _carriers(parent: tuple[int, ...]) -> Index:
    """Return the joints that carry every body (n, n), the root's first and its own last, then -1.

    It is writable like all that the kernel takes; nothing else may have it.
    """
    carriers = np.full((len(parent), len(parent)), -1, dtype=np.int64)
    for body, below in enumerate(parent):
        depth = 0 if below < 0 else 1 + int(np.flatnonzero(carriers[below] == below)[0])
        carriers[body, :depth] = carriers[below, :depth]
        carriers[body, depth] = body
    return carriers


@lru_cache(maxsize=64)
def _not_carried(parent: tuple[int, ...]) -> Index:
    """Return the places of zeros in a sample's regressor."""
    carries = np.zeros((len(parent), len(parent)), dtype=bool)
    for body, carriers in enumerate(_carriers(parent)):
        carries[carriers[carriers >= 0], body] = True
    return np.flatnonzero(~np.repeat(carries, PER_BODY, axis=1))

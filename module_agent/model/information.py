"""Square-root information: the samples of a joint reduced to a few rows about the inertial parameters.

A QR of [Y | tau] keeps everything that least squares needs of any number of samples (Golub and Van Loan,
Matrix Computations, section 5.3). Two such pieces merge by a QR of their stacked rows: exactly, in any order,
and joint by joint, because a joint's torque depends on the bodies that it carries alone.
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY, regressor_chunks, torque_regressor

# Bounds the memory: a block of 64 joints is 0.7 GB at most, one of 7 joints 8 MB.
_BLOCK = 2048


class JointInformation(NamedTuple):
    """Rows equivalent to all samples of one joint, read-only: |Y phi - tau|^2 = |r phi - z|^2 + rest.

    r: (k, p), upper triangular in the columns that are not zero; the first 10 n are those of the bodies, zero
    where the joint does not carry one. z: (k,) [Nm].
    rest: the part of |tau|^2 that no parameters explain [Nm^2]. samples: how many went in.
    """

    r: Array
    z: Array
    rest: float
    samples: int


def compress(regressor: ArrayLike, tau_nm: ArrayLike) -> tuple[JointInformation, ...]:
    """Return the information of every joint from a regressor (m, n, p) and torques (m, n) [Nm].

    The columns are the 10 n of `torque_regressor`, and any further ones behind them.

    Raises:
        ValueError: shapes that do not fit.
        DataError: no samples, or values that are not finite.
    """
    y = np.asarray(regressor, dtype=float)
    tau = np.asarray(tau_nm, dtype=float)
    if y.ndim != 3 or tau.shape != y.shape[:2] or y.shape[2] < PER_BODY * y.shape[1] or not y.shape[0]:
        raise ValueError(
            f"regressor {y.shape} and torques {tau.shape} do not fit: "
            "(m, n, 10 n or more) and (m, n) with m > 0 are needed"
        )
    if not (np.isfinite(y).all() and np.isfinite(tau).all()):
        raise DataError("the regressor or a torque holds a value that is not finite")
    return tuple(_triangular(y[:, i], tau[:, i], 0.0, y.shape[0]) for i in range(y.shape[1]))


def gather(
    chain: Chain,
    q_rad: ArrayLike,
    qd_rad_s: ArrayLike,
    qdd_rad_s2: ArrayLike,
    tau_nm: ArrayLike,
    with_offset: bool = False,
) -> tuple[JointInformation, ...]:
    """Return the information of every joint from a motion, all (m, n), without holding its whole regressor.

    with_offset: one more column, behind those of the bodies, is of the joint's own constant torque.

    Raises:
        ValueError: shapes that do not fit.
        DataError: no samples, or values that are not finite.
    """
    signals = [np.asarray(signal, dtype=float) for signal in (q_rad, qd_rad_s, qdd_rad_s2)]
    tau = np.asarray(tau_nm, dtype=float)
    parts = [slice(begin, begin + _BLOCK) for begin in range(0, max(tau.shape[0], 1), _BLOCK)]
    joints = len(chain.serials)
    buffer = np.zeros((min(_BLOCK, len(signals[0])), joints, PER_BODY * joints))

    def block(part: slice) -> tuple[JointInformation, ...]:
        motion = [signal[part] for signal in signals]
        rows = torque_regressor(chain, *motion, out=buffer[: len(motion[0])])
        if with_offset:
            rows = np.concatenate([rows, np.ones((*rows.shape[:2], 1))], axis=2)
        return compress(rows, tau[part])

    return reduce(merge, map(block, parts))


def gather_joint(
    chain: Chain,
    joint: int,
    q_rad: ArrayLike,
    qd_rad_s: ArrayLike,
    qdd_rad_s2: ArrayLike,
    tau_nm: ArrayLike,
    further: ArrayLike | None = None,
) -> JointInformation:
    """Return the information of one joint: what `gather` returns for it, from its torques (m,) alone.

    The motion is (m, n). That of joints which neither carry it nor are carried by it has no effect. `further`
    are columns (m, k) of this joint in addition to the bodies'.

    Raises:
        ValueError: shapes that do not fit.
        DataError: no samples, or values that are not finite.
    """
    signals = [np.asarray(signal, dtype=float) for signal in (q_rad, qd_rad_s, qdd_rad_s2)]
    tau = np.asarray(tau_nm, dtype=float)
    if tau.ndim != 1 or tau.shape != signals[0].shape[:1]:
        raise ValueError(f"torques {tau.shape} do not fit a motion {signals[0].shape}")
    if not tau.size or not np.isfinite(tau).all():
        raise DataError(f"{tau.size} torques: at least one is needed, and all finite")
    extra = np.zeros((tau.size, 0)) if further is None else np.asarray(further, dtype=float)

    def block(part: slice) -> JointInformation:
        own = np.column_stack([_own_rows(chain, joint, [s[part] for s in signals]), extra[part]])
        return _triangular(own, tau[part], 0.0, len(own))

    return reduce(merge_joint, (block(slice(k, k + _BLOCK)) for k in range(0, tau.size, _BLOCK)))


def _own_rows(chain: Chain, joint: int, signals: Sequence[Array]) -> Array:
    rows = np.empty((len(signals[0]), PER_BODY * len(chain.serials)))
    for part, regressor in regressor_chunks(chain, *signals):
        rows[part] = regressor[:, joint]
    return rows


def merge(*pieces: Sequence[JointInformation]) -> tuple[JointInformation, ...]:
    """Return the information of all pieces, joint by joint: as if all samples had been taken together.

    Raises:
        ValueError: no pieces, or pieces of robots with different numbers of joints, or of different columns.
    """
    joints = {len(piece) for piece in pieces}
    if len(joints) != 1:
        raise ValueError(f"pieces of information of {sorted(joints)} joints cannot be merged")
    return tuple(merge_joint(*of_joint) for of_joint in zip(*pieces, strict=True))


def merge_joint(*pieces: JointInformation) -> JointInformation:
    """Return the information of all pieces, of one joint.

    Raises:
        ValueError: no pieces, or pieces in different columns.
    """
    columns = {piece.r.shape[1] for piece in pieces}
    if len(columns) != 1:
        raise ValueError(f"pieces of information in {sorted(columns)} columns cannot be merged")
    rows, target = np.vstack([piece.r for piece in pieces]), np.concatenate([piece.z for piece in pieces])
    return _triangular(
        rows, target, sum(piece.rest for piece in pieces), sum(piece.samples for piece in pieces)
    )


def _triangular(y: Array, tau: NDArray[np.float64], rest: float, samples: int) -> JointInformation:
    nonzero = np.flatnonzero(y.any(axis=0))
    rows = qr(np.column_stack([y[:, nonzero], tau]), mode="r", check_finite=False)[0][: nonzero.size + 1]
    kept = min(nonzero.size, rows.shape[0])
    r = np.zeros((kept, y.shape[1]))
    r[:, nonzero] = rows[:kept, :-1]
    z = rows[:kept, -1].copy()
    make_read_only((r, z))
    return JointInformation(r, z, rest + float(rows[kept:, -1] @ rows[kept:, -1]), samples)

"""Square-root information: what the samples of a joint say of the inertial parameters, in a few rows.

A QR of [Y | tau] keeps everything that least squares needs of any number of samples (Golub and Van Loan,
Matrix Computations, section 5.3). Two such pieces merge by a QR of their stacked rows: exactly, in any order,
and joint by joint, because a joint's torque depends on the bodies that it carries alone.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from module_agent.dynamics.chain import Array, Chain
from module_agent.dynamics.regressor import PER_BODY, torque_regressor

# Bounds the memory: a block of 64 joints is 0.7 GB at most, one of 7 joints 8 MB.
_BLOCK = 2048


class JointInformation(NamedTuple):
    """Rows equivalent to all samples of one joint, read-only: |Y phi - tau|^2 = |r phi - z|^2 + rest.

    r: (k, 10 n), zero at the bodies that the joint does not carry; z: (k,) [Nm].
    rest: the part of |tau|^2 that no parameters explain [Nm^2]. samples: how many went in.
    """

    r: Array
    z: Array
    rest: float
    samples: int


def compress(regressor: ArrayLike, tau_nm: ArrayLike) -> tuple[JointInformation, ...]:
    """Return the information of every joint from a regressor (m, n, 10 n) and torques (m, n) [Nm].

    Raises:
        ValueError: shapes that do not fit, no samples, or values that are not finite.
    """
    y = np.asarray(regressor, dtype=float)
    tau = np.asarray(tau_nm, dtype=float)
    if y.ndim != 3 or tau.shape != y.shape[:2] or y.shape[2] != PER_BODY * y.shape[1] or not y.shape[0]:
        raise ValueError(
            f"regressor {y.shape} and torques {tau.shape} do not fit: "
            "(m, n, 10 n) and (m, n) with m > 0 are needed"
        )
    if not (np.isfinite(y).all() and np.isfinite(tau).all()):
        raise ValueError("the regressor or a torque holds a value that is not finite")
    return tuple(_triangular(y[:, i], tau[:, i], 0.0, y.shape[0]) for i in range(y.shape[1]))


def gather(
    chain: Chain, q_rad: ArrayLike, qd_rad_s: ArrayLike, qdd_rad_s2: ArrayLike, tau_nm: ArrayLike
) -> tuple[JointInformation, ...]:
    """Return the information of every joint from a motion, all (m, n), without holding its whole regressor.

    Raises:
        ValueError: shapes that do not fit, no samples, or values that are not finite.
    """
    signals = [np.asarray(signal, dtype=float) for signal in (q_rad, qd_rad_s, qdd_rad_s2)]
    tau = np.asarray(tau_nm, dtype=float)
    total: tuple[JointInformation, ...] = ()
    for begin in range(0, max(tau.shape[0], 1), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        found = compress(torque_regressor(chain, *(signal[part] for signal in signals)), tau[part])
        total = merge(total, found) if total else found
    return total


def merge(one: Sequence[JointInformation], other: Sequence[JointInformation]) -> tuple[JointInformation, ...]:
    """Return the information of both, joint by joint: as if all their samples had been taken together.

    Raises:
        ValueError: the two are of robots with different numbers of joints.
    """
    if len(one) != len(other):
        raise ValueError(f"information of {len(one)} joints cannot be merged with that of {len(other)}")
    return tuple(
        _triangular(np.vstack([a.r, b.r]), np.concatenate([a.z, b.z]), a.rest + b.rest, a.samples + b.samples)
        for a, b in zip(one, other, strict=True)
    )


def _triangular(y: Array, tau: NDArray[np.float64], rest: float, samples: int) -> JointInformation:
    felt = np.flatnonzero(y.any(axis=0))
    rows = qr(np.column_stack([y[:, felt], tau]), mode="r", check_finite=False)[0][: felt.size + 1]
    kept = min(felt.size, rows.shape[0])
    r = np.zeros((kept, y.shape[1]))
    r[:, felt] = rows[:kept, :-1]
    z = rows[:kept, -1].copy()
    r.flags.writeable = z.flags.writeable = False
    return JointInformation(r, z, rest + float(rows[kept:, -1] @ rows[kept:, -1]), samples)

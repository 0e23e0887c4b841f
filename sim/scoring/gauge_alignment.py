"""Align an estimated chain with the truth along its gauge freedoms, before both are compared.

A result lists the directions in which its chain can be moved without a change of any measurement (its null
basis). Along these the estimate is moved to where the remaining difference is smallest; an error in any other
direction stays.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from module_agent.model.chain import Array, Chain
from module_agent.model.forward_kinematics import imu_poses
from module_agent.model.perturbation import adjoint, apply_perturbation
from module_agent.model.read_only import frozen

# Weight of orientation against position: the displacement at a usual module's reach.
REACH_M = 0.3


class TipError(NamedTuple):
    """Differences of the leaf IMUs' poses over all configurations, root mean square."""

    position_m: float
    orientation_rad: float


def reorder(chain: Chain, serials: tuple[str, ...]) -> Chain:
    """Return the chain with its modules in another order, in which parents still come before children."""
    order = [chain.serials.index(serial) for serial in serials]
    place = {old: new for new, old in enumerate(order)}
    return chain._replace(
        serials=serials,
        parent=tuple(place.get(chain.parent[old], -1) for old in order),
        reversed=tuple(chain.reversed[old] for old in order),
        axis=frozen(chain.axis[order]),
        point=frozen(chain.point[order]),
        imu_home=frozen(chain.imu_home[order]),
    )


def reorder_basis(chain: Chain, null_basis: ArrayLike, serials: tuple[str, ...]) -> Array:
    """Return the rows (6 n, k) of a null basis of `chain` in the order of `reorder`."""
    basis = np.asarray(null_basis, dtype=float)
    order = [chain.serials.index(serial) for serial in serials]
    return frozen(basis.reshape(len(order), 6, -1)[order].reshape(basis.shape))


def move_root(chain: Chain, null_basis: ArrayLike, pose: ArrayLike) -> tuple[Chain, Array]:
    """Express a chain and its null basis in another root frame, where the present one has `pose` (4, 4)."""
    into = np.asarray(pose, dtype=float)
    turn = into[:3, :3]
    moved = chain._replace(
        axis=frozen(chain.axis @ turn.T),
        point=frozen(chain.point @ turn.T + into[:3, 3]),
        imu_home=frozen(into @ chain.imu_home),
        gravity=frozen(turn @ chain.gravity),
    )
    twists = np.asarray(null_basis, dtype=float).reshape(len(chain.serials), 6, -1)
    return moved, frozen((adjoint(into) @ twists).reshape(6 * len(chain.serials), -1))


def align_gauge(estimated: Chain, reference: Chain, null_basis: ArrayLike, q_rad: ArrayLike) -> Chain:
    """Move `estimated` within its null basis to where its leaves come nearest to the reference's.

    Args:
        estimated, reference: chains of the same modules in the same order.
        null_basis: (6 n, k) directions of `apply_perturbation`.
        q_rad: (m, n) the configurations over which nearness is measured, by least squares of position and of
            orientation times `REACH_M`.

    Returns:
        `apply_perturbation(estimated, null_basis @ z)` for the best z.
    """
    basis = np.asarray(null_basis, dtype=float)
    if not basis.shape[1]:
        return estimated
    tips = list(reference.leaves)
    q = np.asarray(q_rad, dtype=float)
    target = imu_poses(reference, q)[:, tips]

    def misfit(z: Array) -> Array:
        return _misfit(imu_poses(apply_perturbation(estimated, basis @ z), q)[:, tips], target)

    fit = least_squares(
        misfit, _start(misfit, basis), jac="3-point", method="trf", xtol=1e-13, ftol=1e-13, gtol=1e-13
    )
    return apply_perturbation(estimated, basis @ fit.x)


def tip_error(estimated: Chain, reference: Chain, q_rad: ArrayLike) -> TipError:
    """Compare the leaf IMUs' poses in the root frame over configurations (m, n)."""
    tips = list(reference.leaves)
    poses, target = imu_poses(estimated, q_rad)[:, tips], imu_poses(reference, q_rad)[:, tips]
    offset = poses[..., :3, 3] - target[..., :3, 3]
    chord = np.linalg.norm(poses[..., :3, :3] - target[..., :3, :3], axis=(-2, -1))
    # |R1 - R2| = 2 sqrt(2) sin(angle / 2): precise for small angles, where the trace is not.
    angle = 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0))
    return TipError(float(np.sqrt(np.mean(np.sum(offset**2, axis=-1)))), float(np.sqrt(np.mean(angle**2))))


def _misfit(poses: Array, target: Array) -> Array:
    position = (poses[..., :3, 3] - target[..., :3, 3]).ravel()
    orientation = (poses[..., :3, :3] - target[..., :3, :3]).ravel() * (REACH_M / np.sqrt(2.0))
    return np.concatenate([position, orientation])


def _start(misfit: Callable[[Array], Array], basis: Array) -> Array:
    """Choose where Gauss-Newton begins: a yaw that is free may be off by half a turn, out of its reach."""
    start = np.zeros(basis.shape[1])
    best = float(np.sum(misfit(start) ** 2))
    for column in range(basis.shape[1]):
        turn = np.linalg.norm(basis[:, column].reshape(-1, 6)[:, :3], axis=1).max()
        if turn < 1e-3:
            continue
        for angle in (2.0 * np.pi / 3.0, -2.0 * np.pi / 3.0):
            trial = start.copy()
            trial[column] = angle / turn
            cost = float(np.sum(misfit(trial) ** 2))
            if cost < best:
                best, start = cost, trial
    return start

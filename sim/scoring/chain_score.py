"""Errors of an identified chain against the true one: topology, links, tips.

Modules are matched by serial number. Before tips are compared the estimate is moved along its unidentifiable
directions, and along no others.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from coordinator.baseline.difference import difference, mountings
from coordinator.topology.topology import Topology
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.forward_kinematics import imu_poses
from module_agent.model.perturbation import apply_perturbation
from sim.scoring.gauge_alignment import REACH_M, align_gauge, move_root, reorder, reorder_basis, tip_error

POSES = 1000
_SEED = 1
# For derivatives by each parameter fewer are enough.
_SPREAD_POSES, _STEP = 100, 1e-5


class LinkErrors(NamedTuple):
    """Errors of a link: of its length, estimate - truth; of its vector and its axis, sizes.

    The length is the perpendicular distance from the parent's joint axis to the child's IMU at q = 0, the
    vector that distance with its direction; vector and axis are compared in the child's IMU frame at q = 0.
    """

    length_m: float
    vector_m: float
    axis_deg: float


class LinkSpread(NamedTuple):
    """Standard deviations of a link's vector and axis in the directions of their errors; see `LinkErrors`."""

    vector_m: float
    axis_deg: float


def topology_differences(estimated: Topology | Chain, truth: Chain) -> list[str]:
    """List where parents or mounting differ, in the order of the truth; empty if all is right."""
    changes, result, actual = difference(estimated, truth), mountings(estimated), mountings(truth)
    lines = [f"module {s} was not found" for s in changes.new]
    lines += [f"module {s} does not exist" for s in changes.removed]
    for serial in changes.moved:
        (is_on, is_so), (result_on, result_so) = (
            (f"on {mount.parent or 'the base'}", "reversed" if mount.reversed else "forward")
            for mount in (actual[serial], result[serial])
        )
        for is_it, says in ((is_on, result_on), (is_so, result_so)):
            if is_it != says:
                lines.append(f"module {serial} is mounted {is_it}, the result says {says}")
    return lines


def link_length_m(chain: Chain, child: int) -> float:
    """Return the perpendicular distance from the axis of a module's parent to its IMU at q = 0."""
    parent = chain.parent[child]
    arm = chain.imu_home[child, :3, 3] - chain.point[parent]
    return float(np.linalg.norm(np.cross(chain.axis[parent], arm)))


def tip_errors(estimated: Chain, truth: Chain, basis: Array) -> tuple[float, float]:
    """Return rms errors of position [mm] and orientation [deg] of the leaves over random configurations.

    Args:
        estimated, truth: chains of the same modules with the same parents, in any order.
        basis: (6 n, k) directions of `estimated` that are unidentifiable.
    """
    root = estimated.parent.index(-1)
    basis = reorder_basis(estimated, basis, truth.serials)
    origin = truth.serials.index(estimated.serials[root])
    estimated = reorder(estimated, truth.serials)
    if origin != truth.parent.index(-1):
        # With several modules on the base the two chains may begin at different ones, and the root frame is
        # the first one's housing, in which the catalogue places the IMU.
        pose = truth.imu_home[origin] @ np.linalg.inv(estimated.imu_home[origin])
        estimated, basis = move_root(estimated, basis, pose)
    q = np.random.default_rng(_SEED).uniform(-np.pi, np.pi, (POSES, len(truth.serials)))
    error = tip_error(align_gauge(estimated, truth, basis, q), truth, q)
    return 1e3 * error.position_m, float(np.degrees(error.orientation_rad))


def tip_spread(chain: Chain, covariance: Array, null_basis: Array, seed: int = 0) -> tuple[float, float]:
    """Return the rms errors of the leaves' position [m] and orientation [deg] that a covariance lets expect.

    They are those over random configurations, as of `tip_errors`: the chain counts as moved within its
    unresolved directions to where the leaves fit best (`align_gauge`).

    Args:
        covariance, null_basis: (6 n, 6 n) and (6 n, k), over perturbations of the chain.
    """
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (_SPREAD_POSES, len(chain.serials)))
    leaves = list(chain.leaves)

    def tips(delta: Array) -> Array:
        return imu_poses(apply_perturbation(chain, delta), q)[:, leaves, :3].reshape(-1, 3, 4)

    slopes = _slopes(tips, len(covariance))
    # The turn's matrix has twice the angle's square.
    turn = slopes[:, :, :3].reshape(-1, len(covariance)) / np.sqrt(2.0)
    both = np.concatenate([slopes[:, :, 3].reshape(-1, len(covariance)), REACH_M * turn])
    free = both @ null_basis
    left = both - free @ np.linalg.lstsq(free, both, rcond=None)[0] if free.size else both
    squares = np.einsum("ij,jk,ik->i", left, covariance, left)
    places = 3 * len(slopes)
    position, angle = squares[:places].sum() / len(slopes), squares[places:].sum() / len(slopes)
    return float(np.sqrt(position)), float(np.degrees(np.sqrt(angle) / REACH_M))


def _slopes(function: Callable[[Array], Array], size: int) -> Array:
    """Return the central differences of a function of a perturbation (size,), along its last axis."""
    units = _STEP * np.eye(size)
    return np.stack([(function(unit) - function(-unit)) / (2.0 * _STEP) for unit in units], axis=-1)


def gravity_error_deg(estimated: Chain, truth: Chain) -> float | None:
    """Return the angle between the directions of gravity as the first module has them; None for another."""
    first = (chain.serials[chain.parent.index(BASE)] for chain in (estimated, truth))
    if len(set(first)) > 1:
        return None
    across = np.linalg.norm(np.cross(estimated.gravity, truth.gravity))
    return float(np.degrees(np.arctan2(across, estimated.gravity @ truth.gravity)))


def link_errors(estimated: Chain, truth: Chain, child: int) -> LinkErrors | None:
    """Return the errors of the link to a child of the truth, by its index; None if there is no such link."""
    serial = truth.serials[child]
    if serial not in estimated.serials:
        return None
    own = estimated.serials.index(serial)
    if mountings(estimated)[serial].parent != mountings(truth)[serial].parent:
        return None
    axis, vector = _link_in_imu_frame(estimated, own)
    true_axis, true_vector = _link_in_imu_frame(truth, child)
    angle = np.arctan2(np.linalg.norm(np.cross(axis, true_axis)), axis @ true_axis)
    return LinkErrors(
        length_m=float(np.linalg.norm(vector) - np.linalg.norm(true_vector)),
        vector_m=float(np.linalg.norm(vector - true_vector)),
        axis_deg=float(np.degrees(angle)),
    )


def link_spread(estimated: Chain, truth: Chain, child: int, covariance: Array) -> LinkSpread | None:
    """Return what a covariance (6 n, 6 n) of the estimate lets expect of a link's errors."""
    if link_errors(estimated, truth, child) is None:
        return None
    own = estimated.serials.index(truth.serials[child])

    def link(delta: Array) -> Array:
        return np.stack(_link_in_imu_frame(apply_perturbation(estimated, delta), own))

    slopes = _slopes(link, len(covariance))
    off = link(np.zeros(len(covariance))) - np.stack(_link_in_imu_frame(truth, child))
    axis, vector = (_along(*each, covariance) for each in zip(off, slopes, strict=True))
    return LinkSpread(vector_m=vector, axis_deg=float(np.degrees(axis)))


def _along(error: Array, slopes: Array, covariance: Array) -> float:
    """Return the standard deviation of a vector (3,) along its error; the largest where it has none."""
    spread = slopes @ covariance @ slopes.T
    size = np.linalg.norm(error)
    variance = error @ spread @ error / size**2 if size > 1e-12 else np.linalg.eigvalsh(spread)[-1]
    return float(np.sqrt(max(variance, 0.0)))


def _link_in_imu_frame(chain: Chain, child: int) -> tuple[Array, Array]:
    """Return the parent's axis, and the vector from it to the child's IMU, in that IMU's frame at q = 0."""
    parent, home = chain.parent[child], chain.imu_home[child]
    arm = home[:3, 3] - chain.point[parent]
    axis = chain.axis[parent]
    turn = home[:3, :3].T
    return turn @ axis, turn @ (arm - axis * (axis @ arm))

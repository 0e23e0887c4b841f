"""Gauge freedoms of a chain as finite motions, and how to fix them near a reference.

The null space of a fit is a set of small, straight perturbations; a branch that is turned about a joint by
half a turn moves on a circle. So every named freedom is applied as a finite motion, one after the other, each
at the pose that the ones before it have led to.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.null_space import Kind, Unresolved
from module_agent.model.chain import BASE, Array, Chain
from module_agent.model.perturbation import adjoint, apply_perturbation
from module_agent.model.read_only import frozen

# What a wrong orientation counts against a wrong place: the displacement at a usual module's reach.
REACH_M = 0.3
# Starting angles for rotations, which may be off by half a turn.
TURNS_RAD = (0.5 * np.pi, np.pi, 1.5 * np.pi)


class GaugeFreedom(NamedTuple):
    """What lies beyond `branch` moves as one: along or about the axis of `joint`, or on the base."""

    kind: Kind
    joint: int
    branch: int


def gauge_fixed(estimate: ChainEstimate, reference: Chain) -> ChainEstimate:
    """Return an estimate moved along its null space as near as possible to `reference`.

    A fit of many steps drifts along unresolved directions, and no residual draws it back.
    """
    chain = estimate.chain
    free = gauge_freedoms(chain, estimate.unresolved)
    if not free:
        return estimate
    fixed = moved(chain, free, nearest(chain, free, range(len(chain.serials)), reference.imu_home))
    hidden = carried(chain, fixed, estimate.null_basis)
    basis, _ = np.linalg.qr(hidden)
    basis[~hidden.any(axis=1)] = 0.0  # exactly, as the root is exactly known
    # What is known is what is across the unknown, also in the new place.
    across = np.eye(len(basis)) - basis @ basis.T
    half = across @ carried(chain, fixed, estimate.covariance)
    covariance = frozen(across @ carried(chain, fixed, half.T))
    return replace(estimate, chain=fixed, covariance=covariance, null_basis=frozen(basis))


def gauge_freedoms(chain: Chain, unresolved: Sequence[Unresolved]) -> tuple[GaugeFreedom, ...]:
    """Return the named unresolved directions as motions of a chain, proximal ones first.

    The chain may be another one of the same modules; directions that are no motion of it, and combinations
    without a name, are left out.
    """
    freedoms: list[GaugeFreedom] = []
    for item in unresolved:
        first = chain.serials.index(item.modules[0])
        path = chain.ancestors(first)
        if item.kind in ("offset_along_axis", "rotation_about_axis"):
            joint = chain.serials.index(item.joint)
            if joint in path[:-1]:
                freedoms.append(GaugeFreedom(item.kind, joint, path[path.index(joint) + 1]))
        elif item.kind in ("position", "rotation_about_gravity") and chain.parent[first] == BASE:
            freedoms.append(GaugeFreedom(item.kind, BASE, first))
    return tuple(sorted(dict.fromkeys(freedoms), key=lambda one: one.branch))


def nearest(chain: Chain, free: Sequence[GaugeFreedom], places: Sequence[int], imu_home: Array) -> Array:
    """Return the amounts (`moved`) that bring the IMUs of modules `places` nearest to poses (m, 4, 4)."""
    if not free:
        return np.zeros(0)

    def misfit(amounts: Array) -> Array:
        off = moved(chain, free, amounts).imu_home[list(places)] - imu_home
        return np.concatenate([off[:, :3, 3].ravel(), REACH_M / np.sqrt(2.0) * off[:, :3, :3].ravel()])

    # A free heading may be off by half a turn, beyond the convergence of least squares.
    sizes = [3 if one.kind == "position" else 1 for one in free]
    start = np.zeros(sum(sizes))
    best = float(np.sum(misfit(start) ** 2))
    turning = [
        k for k, one in zip(np.cumsum([0, *sizes]), free, strict=False) if one.kind.startswith("rotation")
    ]
    for place, angle in product(turning, TURNS_RAD):
        trial = start.copy()
        trial[place] = angle
        cost = float(np.sum(misfit(trial) ** 2))
        if cost < best:
            best, start = cost, trial
    return np.asarray(least_squares(misfit, start, xtol=1e-10, ftol=1e-10).x)


def moved(chain: Chain, free: Sequence[GaugeFreedom], amounts: Array) -> Chain:
    """Return the chain after all free motions: offsets in m, turns in rad; a position has three amounts.

    Gravity turns with what lies beyond the first axis, as all IMUs there read it: it need not be parallel to
    the axis. Only IMUs on the base would tell, by less than their biases.
    """
    used = 0
    for one in free:
        twists = _twists(chain, one)
        branch = chain.descendants(one.branch)
        perturbation = np.zeros((len(chain.serials), 6))
        perturbation[list(branch)] = amounts[used : used + len(twists)] @ twists
        chain = apply_perturbation(chain, perturbation.ravel())
        apart = set(range(len(chain.serials))) - set(branch)
        if one.kind == "rotation_about_axis" and all(chain.carrier(k) == BASE for k in apart):
            turn = Rotation.from_rotvec(amounts[used] * chain.axis[one.joint])
            chain = chain._replace(gravity=frozen(turn.as_matrix() @ chain.gravity))
        used += len(twists)
    return chain


def carried(before: Chain, after: Chain, perturbations: Array) -> Array:
    """Return perturbations (6 n, k) of a chain expressed at the chain after free motions."""
    motions = after.imu_home @ np.linalg.inv(before.imu_home)
    blocks = np.asarray(perturbations).reshape(len(before.serials), 6, -1)
    return frozen((adjoint(np.asarray(motions)) @ blocks).reshape(np.shape(perturbations)))


def _twists(chain: Chain, one: GaugeFreedom) -> Array:
    """Return the twists (k, 6) of a free motion, where the chain stands now."""
    if one.kind == "position":
        return frozen(np.concatenate([np.zeros((3, 3)), np.eye(3)], axis=1))
    if one.kind == "rotation_about_gravity":
        axis, point = chain.gravity / np.linalg.norm(chain.gravity), chain.imu_home[one.branch, :3, 3]
    else:
        axis, point = chain.axis[one.joint], chain.point[one.joint]
    if one.kind == "offset_along_axis":
        return frozen(np.r_[np.zeros(3), axis][None])
    return frozen(np.r_[axis, np.cross(point, axis)][None])

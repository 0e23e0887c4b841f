"""The true robot in the viewer, in grey beside the identified one: the simulation's part of the picture.

Where no sensor can tell how the robot stands, the truth is drawn as the estimate has it, so that what one
sees between the two is error and nothing else.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from coordinator.chain import Array, Chain
from coordinator.kinematics.assembly import link_lengths
from coordinator.kinematics.axis_angles import axis_angles
from coordinator.kinematics.forward import BASE, ancestors, descendants
from coordinator.kinematics.increments import apply_increment, frozen
from coordinator.kinematics.null_space import Kind, Unresolved
from coordinator.viewer.blueprint import AXIS_ANGLE, LINK_LENGTH
from coordinator.viewer.viewer import Viewer
from sim.gauge import REACH_M, move_root


class TruthView:
    """Draws one robot's truth in the viewer of a run; implements `coordinator.beside.Beside`."""

    def __init__(self, truth: Chain, types: Sequence[str]):
        self._truth = truth
        self._types = dict(zip(truth.serials, types, strict=True))

    def met(self, viewer: Viewer, t_ns: int) -> None:
        """Draw the robot as it stands."""
        viewer.true_chain(t_ns, self._truth, self._types)
        self.values(viewer)

    def values(self, viewer: Viewer, t_ns: Sequence[int] = ()) -> None:
        """Make the true values of what is estimated known, and draw them at `t_ns`."""
        nothing = np.zeros((6 * len(self._truth.serials),) * 2)
        lengths, _ = link_lengths(self._truth, nothing)
        angles, _ = axis_angles(self._truth, nothing)
        for k, serial in enumerate(self._truth.serials):
            if self._truth.parent[k] != BASE:
                viewer.true_value(LINK_LENGTH, serial, 1e3 * float(lengths[k]), t_ns)
                viewer.true_value(AXIS_ANGLE, serial, float(np.degrees(angles[k])), t_ns)

    def chain(self, viewer: Viewer, t_ns: int, chain: Chain, unresolved: tuple[Unresolved, ...]) -> None:
        """Draw the robot where the identified one stands."""
        viewer.true_chain(t_ns, beside(self._truth, chain, unresolved), self._types)


class _Free(NamedTuple):
    """A way in which no sensor can tell how the robot stands: what lies beyond `branch` moves as one."""

    kind: Kind
    joint: int
    branch: int


def beside(truth: Chain, estimated: Chain, unresolved: Sequence[Unresolved]) -> Chain:
    """Return the true chain in the root frame of the estimated one, as near to it as the unresolved lets it.

    Args:
        truth: all modules.
        estimated: some modules of it or all, in any order, each on one that moves it.
        unresolved: what the estimate does not know; the truth may be moved along these, and nothing else.
    """
    root = truth.serials.index(estimated.serials[0])
    into = estimated.imu_home[0] @ np.linalg.inv(truth.imu_home[root])
    chain, _ = move_root(truth, np.zeros((6 * len(truth.serials), 0)), into)
    # Both stand upright by the same vertical: an error in that is no error of the robot's shape.
    chain = chain._replace(gravity=estimated.gravity)
    free = _free(chain, unresolved)
    if not free:
        return chain
    seen = _comparable(chain, estimated)
    places = [chain.serials.index(s) for s in seen]
    target = estimated.imu_home[[estimated.serials.index(s) for s in seen]]

    def misfit(z: Array) -> Array:
        off = _moved(chain, free, z).imu_home[places] - target
        return np.concatenate([off[:, :3, 3].ravel(), REACH_M / np.sqrt(2.0) * off[:, :3, :3].ravel()])

    found = least_squares(misfit, _start(misfit, free), xtol=1e-10, ftol=1e-10)
    return _moved(chain, free, found.x)


def _free(truth: Chain, unresolved: Sequence[Unresolved]) -> list[_Free]:
    """Return the unresolved motions that are motions of the true robot too, proximal ones first."""
    found: list[_Free] = []
    for item in unresolved:
        first = truth.serials.index(item.modules[0])
        path = ancestors(truth, first)
        if item.joint and item.kind in ("offset_along_axis", "rotation_about_axis"):
            joint = truth.serials.index(item.joint)
            if joint in path[:-1]:
                found.append(_Free(item.kind, joint, path[path.index(joint) + 1]))
        elif item.kind in ("position", "rotation_about_gravity") and truth.parent[first] == BASE:
            found.append(_Free(item.kind, BASE, first))
    return sorted(dict.fromkeys(found), key=lambda one: one.branch)


def _comparable(truth: Chain, estimated: Chain) -> list[str]:
    """Return the modules that stand in both as parts of the same tree, or of one that is free in both."""
    top: list[int] = []
    for k, parent in enumerate(estimated.parent):
        top.append(k if parent == BASE else top[parent])
    apart = [truth.parent[truth.serials.index(estimated.serials[r])] == BASE for r in top]
    return [s for s, r, free in zip(estimated.serials, top, apart, strict=True) if r == 0 or free]


def _moved(chain: Chain, free: Sequence[_Free], z: Array) -> Chain:
    """Return the chain after all free motions, one after the other: offsets in m, turns in rad."""
    used = 0
    for one in free:
        twists = _twists(chain, one)
        increment = np.zeros((len(chain.serials), 6))
        increment[list(descendants(chain, one.branch))] = z[used : used + len(twists)] @ twists
        chain = apply_increment(chain, increment.ravel())
        used += len(twists)
    return chain


def _twists(chain: Chain, one: _Free) -> Array:
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


def _start(misfit: Callable[[Array], Array], free: Sequence[_Free]) -> Array:
    """Choose where Gauss-Newton begins: a free heading may be off by half a turn, out of its reach."""
    sizes = [3 if one.kind == "position" else 1 for one in free]
    start = np.zeros(sum(sizes))
    best = float(np.sum(misfit(start) ** 2))
    for place, one in zip(np.cumsum([0, *sizes]), free, strict=False):
        if not one.kind.startswith("rotation"):
            continue
        for angle in (0.5 * np.pi, np.pi, 1.5 * np.pi):
            trial = start.copy()
            trial[place] = angle
            cost = float(np.sum(misfit(trial) ** 2))
            if cost < best:
                best, start = cost, trial
    return start

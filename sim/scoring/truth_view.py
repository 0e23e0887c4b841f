"""Draw the true robot in the viewer, in grey, over the identified one.

Along gauge freedoms, which no sensor determines, the truth is moved to the estimate, so that every visible
difference between the two is an error of the estimate.
"""

from collections.abc import Sequence

import numpy as np

from coordinator.kinematics.chain_estimate import link_lengths
from coordinator.kinematics.frames import axis_angles
from coordinator.kinematics.gauge_fixing import gauge_freedoms, moved, nearest
from coordinator.kinematics.null_space import Unresolved
from coordinator.viewer.scene.parameter_plot import AXIS_ANGLE, LINK_LENGTH
from coordinator.viewer.viewer import Viewer
from module_agent.model.chain import BASE, Chain
from sim.scoring.gauge_alignment import move_root


class TruthView:
    """Draws the true robot in the viewer of a run; implements `coordinator.viewer.feed.Overlay`."""

    def __init__(self, truth: Chain, types: Sequence[str]):
        self._truth = truth
        self._types = dict(zip(truth.serials, types, strict=True))

    def connected(self, viewer: Viewer, t_ns: int) -> None:
        """Draw the true robot and the true values."""
        viewer.true_chain(t_ns, self._truth, self._types)
        self.values(viewer)

    def values(self, viewer: Viewer, t_ns: Sequence[int] = ()) -> None:
        """Show the true link lengths and axis angles; also draw them at `t_ns`."""
        nothing = np.zeros((6 * len(self._truth.serials),) * 2)
        lengths, _ = link_lengths(self._truth, nothing)
        angles, _ = axis_angles(self._truth, nothing)
        for k, serial in enumerate(self._truth.serials):
            if self._truth.parent[k] != BASE:
                viewer.true_value(LINK_LENGTH, serial, 1e3 * float(lengths[k]), t_ns)
                viewer.true_value(AXIS_ANGLE, serial, float(np.degrees(angles[k])), t_ns)

    def chain(self, viewer: Viewer, t_ns: int, chain: Chain, unresolved: tuple[Unresolved, ...]) -> None:
        """Draw the true robot aligned with the identified one."""
        viewer.true_chain(t_ns, aligned_truth(self._truth, chain, unresolved), self._types)


def aligned_truth(truth: Chain, estimated: Chain, unresolved: Sequence[Unresolved]) -> Chain:
    """Return the true chain in the estimated chain's root frame, moved along gauge freedoms towards it.

    Args:
        truth: all modules.
        estimated: some or all of these modules, in any order, parents among them.
        unresolved: the estimate's gauge freedoms; the truth is moved along these only.
    """
    root = truth.serials.index(estimated.serials[0])
    into = estimated.imu_home[0] @ np.linalg.inv(truth.imu_home[root])
    chain, _ = move_root(truth, np.zeros((6 * len(truth.serials), 0)), into)
    # Both use the same vertical: an error of gravity's direction is no error of the robot's shape.
    chain = chain._replace(gravity=estimated.gravity)
    free = gauge_freedoms(chain, unresolved)
    shared = _comparable(chain, estimated)
    target = estimated.imu_home[[estimated.serials.index(s) for s in shared]]
    return moved(chain, free, nearest(chain, free, [chain.serials.index(s) for s in shared], target))


def _comparable(truth: Chain, estimated: Chain) -> list[str]:
    """Return the estimated modules whose tree has the root frame, or begins at a base module of the truth."""
    top = [estimated.ancestors(k)[0] for k in range(len(estimated.serials))]
    apart = [truth.parent[truth.serials.index(estimated.serials[r])] == BASE for r in top]
    return [s for s, r, free in zip(estimated.serials, top, apart, strict=True) if r == 0 or free]

"""The true robot in the viewer, in grey beside the identified one: the simulation's part of the picture.

Where no sensor can tell how the robot stands, the truth is drawn as the estimate has it, so that what one
sees between the two is error and nothing else.
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
    """Draws one robot's truth in the viewer of a run; implements `coordinator.viewer.feed.Overlay`."""

    def __init__(self, truth: Chain, types: Sequence[str]):
        self._truth = truth
        self._types = dict(zip(truth.serials, types, strict=True))

    def connected(self, viewer: Viewer, t_ns: int) -> None:
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
    free = gauge_freedoms(chain, unresolved)
    seen = _comparable(chain, estimated)
    target = estimated.imu_home[[estimated.serials.index(s) for s in seen]]
    return moved(chain, free, nearest(chain, free, [chain.serials.index(s) for s in seen], target))


def _comparable(truth: Chain, estimated: Chain) -> list[str]:
    """Return the modules that stand in both as parts of the same tree, or of one that is free in both."""
    top = [estimated.ancestors(k)[0] for k in range(len(estimated.serials))]
    apart = [truth.parent[truth.serials.index(estimated.serials[r])] == BASE for r in top]
    return [s for s, r, free in zip(estimated.serials, top, apart, strict=True) if r == 0 or free]

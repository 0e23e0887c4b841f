"""Trees of a chain set apart, to be looked at: where they stand against each other is not known."""

import numpy as np

from coordinator.kinematics.forward import BASE, descendants
from coordinator.kinematics.increments import apply_increment
from module_agent.dynamics.chain import Array, Chain

GAP_M = 0.25


def side_by_side(chain: Chain) -> Chain:
    """Return the chain with its trees in a row along the horizontal, the first where it is.

    Nothing that sensors on a fixed base tell depends on where a second tree stands.
    """
    roots = [k for k, parent in enumerate(chain.parent) if parent == BASE]
    if len(roots) == 1:
        return chain
    along = _horizontal(chain)
    shift, end = np.zeros((len(chain.serials), 6)), 0.0
    for number, root in enumerate(roots):
        tree = list(descendants(chain, root))
        places = np.concatenate([chain.imu_home[tree, :3, 3], chain.point[tree]]) @ along
        if number > 0:
            shift[tree, 3:] = (end + GAP_M - places.min()) * along
        end = max(end, float((places + shift[root, 3:] @ along).max()))
    return apply_increment(chain, shift.ravel())


def _horizontal(chain: Chain) -> Array:
    """Return the level direction (3,) that is nearest to the root frame's y, or to its x."""
    up = chain.gravity / np.linalg.norm(chain.gravity)
    for candidate in (np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])):
        level = candidate - up * (up @ candidate)
        size = float(np.linalg.norm(level))
        if size > 0.5:
            break
    return np.asarray(level / size)

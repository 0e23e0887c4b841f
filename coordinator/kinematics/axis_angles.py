"""How joints are turned against each other: the angle between a joint's axis and its parent's."""

import numpy as np

from coordinator.kinematics.forward import BASE
from coordinator.kinematics.increments import frozen
from module_agent.dynamics.chain import Array, Chain

# Of the sine: below this two axes are parallel, and any tilt makes the angle grow.
PARALLEL_BELOW = 1e-6


def axis_angles(chain: Chain, covariance: Array) -> tuple[Array, Array]:
    """Return the angles (n,) [rad], 0 to pi, between each joint's axis and its parent's, and their sigmas.

    NaN for roots. `covariance`: (6 n, 6 n) of the chain's increments (`increments.apply_increment`). How a
    module is turned about its parent's axis, or placed along it, does not matter.
    """
    angle, sigma = np.full((2, len(chain.serials)), np.nan)
    for k, parent in enumerate(chain.parent):
        if parent == BASE:
            continue
        cross = np.cross(chain.axis[parent], chain.axis[k])
        sine = float(np.linalg.norm(cross))
        angle[k] = np.arctan2(sine, chain.axis[parent] @ chain.axis[k])
        spread = _turn_covariance(covariance, parent, k)
        if sine > PARALLEL_BELOW:
            about = cross / sine
            sigma[k] = np.sqrt(about @ spread @ about)
        else:
            across = np.eye(3) - np.outer(chain.axis[k], chain.axis[k])
            sigma[k] = np.sqrt(np.trace(across @ spread @ across))
    return frozen(angle), frozen(sigma)


def _turn_covariance(covariance: Array, parent: int, child: int) -> Array:
    """Return the covariance (3, 3) of the child's rotation against the parent's, in the root frame."""
    a, b = slice(6 * parent, 6 * parent + 3), slice(6 * child, 6 * child + 3)
    crossed = covariance[a, b]
    return np.asarray(covariance[a, a] + covariance[b, b] - crossed - crossed.T)

"""Frames of a chain's modules at q = 0, and the angles between successive axes.

A module has two mounting faces, the housing's and the output's. The catalogue ties both, and the axis, to the
IMU. The frames are those of the catalogue: z points out of the module at its output and into it at its
housing, for forward and reversed modules alike.
"""

from collections.abc import Sequence

import numpy as np

from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.read_only import frozen

# Of the sine: below this two axes are parallel, and any tilt makes the angle grow.
PARALLEL_BELOW = 1e-6


def axis_angles(chain: Chain, covariance: Array) -> tuple[Array, Array]:
    """Return the angles (n,) [rad], 0 to pi, between each joint's axis and its parent's, and their sigmas.

    NaN for roots. `covariance`: (6 n, 6 n) of the chain's perturbations (`apply_perturbation`). The angle
    does not depend on how a module is turned about its parent's axis, or placed along it.
    """
    angle, sigma = np.full((2, len(chain.serials)), np.nan)
    for k in chain.linked:
        parent = chain.parent[k]
        cross = np.cross(chain.axis[parent], chain.axis[k])
        sine = float(np.linalg.norm(cross))
        angle[k] = np.arctan2(sine, chain.axis[parent] @ chain.axis[k])
        # Of the module's rotation against its parent's, in the root frame.
        a, b = slice(6 * parent, 6 * parent + 3), slice(6 * k, 6 * k + 3)
        spread = covariance[a, a] + covariance[b, b] - covariance[a, b] - covariance[a, b].T
        if sine > PARALLEL_BELOW:
            about = cross / sine
            sigma[k] = np.sqrt(about @ spread @ about)
        else:
            across = np.eye(3) - np.outer(chain.axis[k], chain.axis[k])
            sigma[k] = np.sqrt(np.trace(across @ spread @ across))
    return frozen(angle), frozen(sigma)


def housing_homes(chain: Chain, types: Sequence[ModuleType]) -> Array:
    """Return the housing frames (n, 4, 4) at q = 0 in the root frame, read-only; `types` as in the chain.

    Raises:
        ValueError: there is not one type per module.
    """
    if len(types) != len(chain.serials):
        raise ValueError(f"{len(types)} module types for a chain of {len(chain.serials)} joints")
    return frozen(chain.imu_home @ np.array([_shift(-np.array(kind.imu_xyz)) for kind in types]))


def output_homes(chain: Chain, types: Sequence[ModuleType]) -> Array:
    """Return the output frames (n, 4, 4) at q = 0 in the root frame, read-only. Errors as `housing_homes`."""
    across = np.array([_shift(np.array(kind.output_xyz)) for kind in types])
    return frozen(housing_homes(chain, types) @ across)


def distal_homes(chain: Chain, types: Sequence[ModuleType]) -> Array:
    """Return the frames (n, 4, 4) that a module's joint moves: its output, or its housing if reversed."""
    turned = np.array(chain.reversed, dtype=bool)[:, None, None]
    return frozen(np.where(turned, housing_homes(chain, types), output_homes(chain, types)))


def proximal_homes(chain: Chain, types: Sequence[ModuleType]) -> Array:
    """Return the frames (n, 4, 4) by which modules are mounted: the housing, or the output if reversed."""
    turned = np.array(chain.reversed, dtype=bool)[:, None, None]
    return frozen(np.where(turned, output_homes(chain, types), housing_homes(chain, types)))


def _shift(by: Array) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = by
    return pose

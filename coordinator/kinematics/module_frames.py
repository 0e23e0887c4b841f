"""Where a chain's modules have their two faces at q = 0: the housing's mounting face and the output's.

The catalogue ties both, and the axis, to the IMU. Frames are the geometric ones of the catalogue: z points
out of the module at its output and into it at its housing, whichever way round the module is mounted.
"""

from collections.abc import Sequence

import numpy as np

from coordinator.kinematics.increments import frozen
from module_agent.catalogue import ModuleType
from module_agent.dynamics.chain import Array, Chain


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

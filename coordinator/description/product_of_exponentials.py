"""The chain as a product of exponentials: screw axes in the space frame and the tips' poses at q = 0.

T_tip(q) = exp([S_1] q_1) ... exp([S_k] q_k) M_tip over the joints from the base to the tip (Lynch and Park,
Modern Robotics, eq. 4.14): for every robot, and as well conditioned for parallel axes as for any other.
Twists are [rotation, translation], the space frame is the root frame.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.kinematics.frames import distal_homes
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import skew
from module_agent.model.read_only import frozen


class Tip(NamedTuple):
    """Where a branch ends: the face of its last module that the last joint moves.

    joints: serials from the base to the tip, its own module last. home: (4, 4) M, its pose at q = 0.
    covariance: (6, 6) of the twist that displaces M from the left; zero along what is unknown.
    """

    serial: str
    frame: Literal["output", "housing"]
    joints: tuple[str, ...]
    home: Array
    covariance: Array


class ScrewModel(NamedTuple):
    """A robot as screws, in the order of `serials`; arrays read-only.

    screws: (n, 6) [w, v] with v = -w x p, for joint positions in rad.
    covariance: (n, 6, 6) of each screw, zero along what is unknown and for the first root's, which is exact
    by the choice of the frame.
    """

    serials: tuple[str, ...]
    screws: Array
    covariance: Array
    tips: tuple[Tip, ...]


def screw_model(chain: Chain, types: Sequence[ModuleType], covariance: ArrayLike) -> ScrewModel:
    """Return the screws and tips of a chain whose modules' types say where the outputs are.

    covariance: (6 n, 6 n) of the chain's perturbations (`apply_perturbation`).

    Raises:
        ValueError: types or covariance do not fit the chain.
    """
    count = len(chain.serials)
    spread = np.asarray(covariance, dtype=float)
    if spread.shape != (6 * count, 6 * count):
        raise ValueError(f"covariance of shape {spread.shape} for the perturbations of {count} modules")
    own = np.array([spread[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)])
    screws = screw_axes(chain)
    # Displaced by the twist d, a screw changes by ad(d) S = -ad(S) d.
    slope = -_ad(screws)
    homes = distal_homes(chain, types)
    return ScrewModel(
        serials=chain.serials,
        screws=screws,
        covariance=frozen(slope @ own @ np.swapaxes(slope, 1, 2)),
        tips=tuple(
            Tip(
                serial=chain.serials[leaf],
                frame="housing" if chain.reversed[leaf] else "output",
                joints=tuple(chain.serials[k] for k in chain.ancestors(leaf)),
                home=frozen(homes[leaf]),
                covariance=frozen(own[leaf]),
            )
            for leaf in chain.leaves
        ),
    )


def screw_axes(chain: Chain) -> Array:
    """Return the (n, 6) screw axes of the joints at q = 0 in the root frame, read-only."""
    return frozen(np.concatenate([chain.axis, np.cross(chain.point, chain.axis)], axis=1))


def _ad(twists: Array) -> Array:
    """Return the (n, 6, 6) matrices of the Lie bracket with twists (n, 6) (Lynch and Park, eq. 8.38)."""
    brackets = np.zeros((len(twists), 6, 6))
    brackets[:, :3, :3] = brackets[:, 3:, 3:] = skew(twists[:, :3])
    brackets[:, 3:, :3] = skew(twists[:, 3:])
    return brackets

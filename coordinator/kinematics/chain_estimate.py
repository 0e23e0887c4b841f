"""A chain with what is known of it: covariance and null space of its perturbations, link lengths."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from coordinator.kinematics.null_space import Unresolved, name_null_space
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import skew
from module_agent.model.read_only import frozen

# A length is unknown if what no observation resolves of a module against its parent changes it by more than
# this share. A free heading about gravity, which is a few degrees off the joint's axis, changes it by less.
HIDDEN_SHARE = 0.05
# Where nothing is free of a module against its parent, the null space says so to 1e-8, and to 3e-4 after a
# refinement with precise priors. Of a direction that a thousand modules share each has a thirtieth.
NULL_SPACE_ERROR = 3e-3


@dataclass(frozen=True, eq=False)
class ChainEstimate:
    """An estimated chain of n modules, arrays read-only; perturbations as in `apply_perturbation`.

    covariance: (6 n, 6 n) of the perturbation; zero for the first module, whose housing is the root frame,
        and along directions that no observation resolves.
    null_basis: (6 n, k) orthonormal perturbations that no observation resolves.
    rank: number of resolved directions. condition: the largest over the smallest of their sigmas.
    """

    chain: Chain
    covariance: Array
    null_basis: Array
    rank: int
    condition: float

    @cached_property
    def unresolved(self) -> tuple[Unresolved, ...]:
        """The null space by name."""
        return name_null_space(self.chain, self.null_basis)

    @cached_property
    def _link_lengths(self) -> tuple[Array, Array]:
        return link_lengths(self.chain, self.covariance, self.null_basis)

    @property
    def link_length_m(self) -> Array:
        """(n,) perpendicular distance from the parent's axis to the module's IMU at q = 0; NaN for roots."""
        return self._link_lengths[0]

    @property
    def link_length_sigma_m(self) -> Array:
        """(n,) one standard deviation of `link_length_m`; infinite where no observation resolves it."""
        return self._link_lengths[1]


def link_lengths(chain: Chain, covariance: Array, null_basis: Array | None = None) -> tuple[Array, Array]:
    """Return the lengths (n,) [m] of `ChainEstimate.link_length_m` and their sigmas; NaN for roots.

    Where the length is zero it has no slope; the sigma is then that of the place across the axis. It is
    infinite where a direction of the null space changes the length, as the covariance leaves these out.
    """
    length, sigma = np.full((2, len(chain.serials)), np.nan)
    for k in chain.linked:
        parent = chain.parent[k]
        axis, place = chain.axis[parent], chain.imu_home[k, :3, 3]
        off = place - chain.point[parent]
        radial = off - axis * (axis @ off)
        length[k] = float(np.linalg.norm(radial))
        # Only the motion of the IMU against the axis counts: that of the line, as a body, is taken off.
        slope = np.zeros((3, covariance.shape[0]))
        own = np.concatenate([-skew(place), np.eye(3)], axis=1)
        slope[:, 6 * k : 6 * k + 6], slope[:, 6 * parent : 6 * parent + 6] = own, -own
        across = np.eye(3) - np.outer(axis, axis)
        outward = radial[None, :] / length[k] if length[k] > 1e-6 else across
        spread = outward @ slope @ covariance @ slope.T @ outward.T
        sigma[k] = float(np.sqrt(np.trace(spread)))
        if null_basis is not None:
            free = null_basis[6 * k : 6 * k + 6] - null_basis[6 * parent : 6 * parent + 6]
            least = max(HIDDEN_SHARE * float(np.linalg.norm(free)), NULL_SPACE_ERROR)
            if np.linalg.norm(outward @ own @ free) > least:
                sigma[k] = np.inf
    return frozen(length), frozen(sigma)

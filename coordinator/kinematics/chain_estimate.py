"""A chain with what is known of it: covariance and null space of its perturbations, link lengths."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from coordinator.kinematics.null_space import Unresolved, name_null_space
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import skew
from module_agent.model.read_only import frozen

# How much an unresolved direction of one metre or radian changes a length that depends on it, at least [m].
# Named ones change no length at all, and the rest changes others by the errors of the fit.
HIDDEN_SLOPE = 0.05


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
        nothing = np.zeros((len(self.covariance), 0))
        # The named motions, not the null vectors of the fit, which its errors turn and mix: the
        # heading of a robot whose joint is vertical is that about gravity, a degree or two off the axis.
        hidden = (item.directions / np.linalg.norm(item.directions, axis=0) for item in self.unresolved)
        return link_lengths(self.chain, self.covariance, np.concatenate([nothing, *hidden], axis=1))

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
        if null_basis is not None and np.linalg.norm(outward @ slope @ null_basis) > HIDDEN_SLOPE:
            sigma[k] = np.inf
    return frozen(length), frozen(sigma)

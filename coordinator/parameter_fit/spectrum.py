"""The singular value decomposition of weighted rows: which directions of the parameters the data determine.

Rows R = U S V^T over parameters of one common size. Directions whose singular values are within rounding (or
within the errors of a chain) of zero are not determined by the data; `pinv(R) = V S^-1 U^T` over the others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from module_agent.model.chain import Array
from module_agent.model.errors import DataError

# Rounding in the regressor is 1e-15 of the largest singular value and grows with the depth of the tree; the
# weakest motion that an encoder of 14 bits resolves is above 1e-8. Nothing real lies between.
RANK_TOLERANCE = 1e-11

# The same where the chain was itself estimated: axes that are wrong by 1e-5 to 1e-4 rad show, by as much of
# the largest singular value, parameters that the true ones do not. An arm's weakest real one is above 1e-3.
ESTIMATED_CHAIN_TOLERANCE = 1e-4

# A direction with a larger standard deviation is not identified: the mass of one module is about 0.3 kg, so
# that the parameter's zero (or the prior) is nearer to the truth than the estimate.
MAX_SIGMA_KG = 0.3


class UndeterminedError(DataError):
    """The data determine no parameters, or leave nothing to estimate their noise from."""


class Spectrum(NamedTuple):
    """rows = left @ diag(values) @ directions: (k, r), (r,) falling, (r, p) with orthonormal rows."""

    left: Array
    values: Array
    directions: Array

    def determined(self, tolerance: float) -> NDArray[np.bool_]:
        """Return which directions (r,) have singular values above this share of the largest."""
        return np.asarray(self.values > tolerance * self.values[0])

    def inverse(self, kept: NDArray[np.bool_]) -> Array:
        """Return V S^-1 (p, rank) of the directions that are kept."""
        return np.asarray(self.directions[kept].T / self.values[kept])

    def condition(self, kept: NDArray[np.bool_]) -> float:
        """Return the largest over the smallest singular value that is kept, infinite if none is."""
        return float(self.values[0] / self.values[kept][-1]) if kept.any() else float("inf")


def spectrum(rows: Array) -> Spectrum:
    """Return the decomposition of rows (k, p).

    Raises:
        UndeterminedError: all rows are zero.
    """
    left, values, directions = np.linalg.svd(rows, full_matrices=False)
    if not values[0] > 0.0:
        raise UndeterminedError("the regressor is zero: without gravity or motion the torques say nothing")
    return Spectrum(left, values, directions)


def without_range(rows: Array, tolerance: float, parts: Sequence[Array]) -> tuple[list[Array], int]:
    """Return parts (k, ...) without what the columns of rows (k, p) explain of them, and the rank of the
    rows.
    """
    left, values, _ = np.linalg.svd(rows, full_matrices=False)
    space = left[:, values > tolerance * values[0]]
    return [part - space @ (space.T @ part) for part in parts], space.shape[1]


def degrees_of_freedom(joint: int, samples: float, hat: Array) -> float:
    """Return the samples of a joint less those that the fit takes: the trace of its part of U U^T.

    Args:
        joint: its index. samples: that were fitted. hat: (k, rank) its rows of U.

    Raises:
        UndeterminedError: fewer than one is left.
    """
    taken = float(np.sum(hat**2))
    if samples - taken < 1.0:
        raise UndeterminedError(
            f"joint {joint + 1} has {samples:.0f} samples for {taken:.1f} parameters; nothing is left to "
            "estimate the noise from: record a longer motion"
        )
    return samples - taken


def spread(blocks: Sequence[Array], variances: ArrayLike) -> Array:
    """Return the sum over the joints of variance * rows^T rows (rank, rank).

    With rows of U it is the covariance of the torques along the left singular vectors.
    """
    total = np.zeros((blocks[0].shape[1],) * 2)
    for rows, variance in zip(blocks, np.asarray(variances, dtype=float), strict=True):
        total += variance * (rows.T @ rows)
    return total

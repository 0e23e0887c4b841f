"""The F-test of a single parameter: how much worse the model without it explains the data.

For one parameter the F statistic of the model without it is (value / sigma)^2, distributed as F(1, degrees of
freedom) if the parameter is zero (Draper and Smith 1998, Applied regression analysis, section 6.1).
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import fdtrc

from module_agent.model.chain import Array

# A term of no use passes a test at this level once in a hundred.
SIGNIFICANT_CHANCE = 0.01
# For torque readings, which have systematic errors besides noise: a term that is zero exceeds it once in two
# million.
SIGNIFICANT_F = 25.0
# Torques without any noise leave no scatter to test against.
_MAX_F = 1e12


def f_statistic(value: ArrayLike, sigma: ArrayLike) -> Array:
    """Return the F of the model without each parameter, at most 1e12.

    Args:
        value, sigma: estimates and their standard deviations, of one shape.
    """
    size = np.maximum(np.asarray(sigma, dtype=float), np.finfo(float).tiny)
    ratio = np.minimum(np.abs(value), np.sqrt(_MAX_F) * size) / size
    return np.asarray(ratio**2)


def chance_of(f: float, freedom: float) -> float:
    """Return the probability of an F at least as large if the parameter is zero.

    Args:
        f: of `f_statistic`.
        freedom: independent samples less fitted parameters; below 1 counts as 1.
    """
    return float(fdtrc(1, max(1.0, freedom), f))

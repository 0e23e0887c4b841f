"""The scale of every joint's torque readings, from motions without and with a known payload.

Readings of joint i are k_i times its torque. Without the payload they are linear in k_i x, with it

    r = Y_i (k_i x) + drives + k_i Y_i S psi,

psi the payload. Its mass and centre are known, its inertia about the centre is free. What the columns of
bodies, drives and inertia explain of the known column c is projected out of c and r (Frisch and Waugh 1933):
k_i = c' r / c' c. Gravity and inertia of any other body scale with k_i and say nothing of it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coordinator.parameter_fit.identifiability import WEAK_ABOVE
from coordinator.parameter_fit.robust_least_squares import correlation_times
from coordinator.parameter_fit.spectrum import RANK_TOLERANCE
from module_agent.model.chain import Array
from module_agent.model.read_only import make_read_only

# Of the payload's torque: less than this left by the other columns is rounding.
_NOTHING_LEFT = 1e-6


class TorqueFactors(NamedTuple):
    """Factors (n,) from readings to torques, standard deviations (n,), and which are determined (n,).

    A factor is determined if its standard deviation is below `WEAK_ABOVE` of it. That of a joint that the
    payload does not load is infinitely uncertain; factors that are not determined are 1. Read-only.
    """

    value: Array
    sigma: Array
    determined: NDArray[np.bool_]


def torque_factors(
    columns: ArrayLike, known: ArrayLike, readings: ArrayLike, used: ArrayLike
) -> TorqueFactors:
    """Return the factors of n joints.

    Args:
        columns: (m, n, p) of everything whose size is not known: bodies, drives, the payload's inertia.
        known: (m, n) torque of the payload's mass at its centre [Nm], zero in samples without it.
        readings: (m, n) torques or currents. used: (m, n) samples that count.

    Raises:
        ValueError: shapes that do not fit.
    """
    y, c, r = (np.asarray(part, dtype=float) for part in (columns, known, readings))
    some = np.asarray(used, dtype=bool)
    if y.ndim != 3 or not y.shape[:2] == c.shape == r.shape == some.shape:
        raise ValueError(f"columns {y.shape}, known {c.shape}, readings {r.shape}, used {some.shape}")
    fits = [_factor(y[some[:, i], i], c[some[:, i], i], r[some[:, i], i]) for i in range(y.shape[1])]
    value, sigma = np.array(fits).reshape(-1, 2).T.copy()
    determined = (value > 0.0) & (sigma < WEAK_ABOVE * value)
    value[~determined] = 1.0
    result = TorqueFactors(value, sigma, determined)
    make_read_only(result)
    return result


def _factor(columns: Array, known: Array, readings: Array) -> tuple[float, float]:
    """Return the factor of one joint and its standard deviation, infinite if nothing determines it."""
    size = np.linalg.norm(columns, axis=0)
    seen = columns[:, size > 0.0] / size[size > 0.0]
    left, values, _ = np.linalg.svd(seen, full_matrices=False)
    space = left[:, values > RANK_TOLERANCE * values[0]] if values.size else left
    alone = known - space @ (space.T @ known)
    power = float(alone @ alone)
    freedom = len(known) - space.shape[1] - 1
    if freedom < 1 or not np.sqrt(power) > _NOTHING_LEFT * np.linalg.norm(known):
        return 1.0, np.inf
    share = float(alone @ readings) / power
    residual = readings - space @ (space.T @ readings) - share * alone
    # Samples behind a low-pass are not independent.
    alike = float(correlation_times(residual[:, None])[0])
    sigma = float(np.sqrt(residual @ residual / freedom * alike / power))
    return (1.0 / share, sigma / share**2) if share > 0.0 else (1.0, np.inf)

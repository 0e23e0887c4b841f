"""Did parameters change? A generalised likelihood ratio in information form.

Linear models with unknown parameters theta that are the same before and later, but for a change C x:

    [ B  0  ] [ theta ]   [ b ]
    [ L  LC ] [   x   ] = [ l ],      rows in standard deviations of their noise.

By how much x makes the misfit smaller is twice the logarithm of the likelihood ratio, chi-square distributed
with as many degrees of freedom as x has if nothing has changed (Kay, Fundamentals of Statistical Signal
Processing II, section 6.5).

Of rows A with targets a only the information matrix A^T A and the information vector A^T a are kept: those of
several stretches add (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
Navigation, section 3.4), so that a window that slides costs sums. That squares the condition number, but
theta has a prior, in whose standard deviations sigma it is scaled here: no eigenvalue of

    M = 1 + B^T B + L^T L

is below one, and those of a run of minutes are below 1e10, which leaves six digits of what is known least.
With h = B^T b + L^T l the change of one hypothesis has, theta eliminated (Schur complement),

    S = 1 + C^T (L^T L - L^T L M^-1 L^T L) C,   r = C^T (L^T l - L^T L M^-1 h),
    x = S^-1 r,   gain = r^T S^-1 r.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve
from scipy.special import chdtri

from module_agent.model.chain import Array
from module_agent.model.read_only import make_read_only


class Evidence(NamedTuple):
    """What a stretch of time says of p parameters, read-only.

    matrix: (p, p) A^T A, vector: (p,) A^T a, of rows A and targets a in standard deviations of their noise.
    """

    matrix: Array
    vector: Array

    @property
    def parameters(self) -> int:
        """How many parameters it is about."""
        return int(self.vector.size)


class Change(NamedTuple):
    """What one kind of change explains.

    gain: by how much it makes the misfit smaller, in variances. size: (d,) its parameters, and their
    covariance (d, d).
    """

    gain: float
    size: Array
    covariance: Array


def evidence_of(rows: ArrayLike, target: ArrayLike) -> Evidence:
    """Return what rows (k, p) and targets (k,) in standard deviations say of the parameters.

    What no parameters explain of the targets is left out: it is noise, whatever has changed.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """
    matrix, vector = np.asarray(rows, dtype=float), np.asarray(target, dtype=float)
    if matrix.ndim != 2 or vector.shape != matrix.shape[:1]:
        raise ValueError(f"rows {matrix.shape} and targets {vector.shape} do not fit: (k, p) and (k,)")
    if not (np.isfinite(matrix).all() and np.isfinite(vector).all()):
        raise ValueError("a row or a target is not finite")
    return _read_only(matrix.T @ matrix, matrix.T @ vector)


def joined(parts: Sequence[Evidence]) -> Evidence:
    """Return the evidence of several stretches of time together.

    Raises:
        ValueError: no part, or parts about different parameters.
    """
    if not parts or len({part.parameters for part in parts}) != 1:
        raise ValueError(f"evidence of {[part.parameters for part in parts]} parameters cannot be joined")
    matrix, vector = parts[0].matrix.copy(), parts[0].vector.copy()
    for part in parts[1:]:
        matrix += part.matrix
        vector += part.vector
    return _read_only(matrix, vector)


def without_own(evidence: Evidence, own_sigma: ArrayLike) -> Evidence:
    """Return what is left when the first parameters are this stretch's own, known before to `own_sigma`."""
    sigma = np.asarray(own_sigma, dtype=float)
    if not sigma.size:
        return evidence
    own, rest = slice(0, sigma.size), slice(sigma.size, None)
    across = sigma[:, None] * evidence.matrix[own, rest]
    columns = np.column_stack([across, sigma * evidence.vector[own]])
    solved = _with_prior(sigma[:, None] * evidence.matrix[own, own] * sigma, columns)
    return _read_only(
        evidence.matrix[rest, rest] - across.T @ solved[:, :-1],
        evidence.vector[rest] - across.T @ solved[:, -1],
    )


def without_first(evidence: Evidence, count: int) -> Evidence:
    """Return what is left when the first so many parameters are known to be where the model has them."""
    return Evidence(evidence.matrix[count:, count:], evidence.vector[count:])


def tempered(evidence: Evidence, inflation: float) -> Evidence:
    """Return evidence whose noise has so many times the variance that it was taken to have."""
    return _read_only(evidence.matrix / inflation, evidence.vector / inflation)


def find_changes(
    before: Evidence,
    later: Evidence,
    prior_sigma: ArrayLike,
    changes: Sequence[Array],
    likely: Sequence[float] | None = None,
) -> tuple[Change, ...]:
    """Return the best change of every hypothesis about what changed between two stretches of time.

    Args:
        before, later: about the same p parameters, as deviations from where a first model has them.
        prior_sigma: (p,) how far a parameter may be from there, before anything was measured.
        changes: per hypothesis the matrix (p, d) from its own parameters to the change of theta, in units in
            which a change of 1 is large: there is a prior of that size on them.
        likely: per hypothesis how large changes are by which it is judged: its gain is that under a prior of
            this size, its size and covariance are those under a prior of 1; None for 1 of all.

    Raises:
        ValueError: evidence about different parameters.
    """
    former, latter, sigma = _scaled(before, later, prior_sigma)
    # A robot without links has no link that could have changed.
    if not changes:
        return ()
    wide = np.column_stack(changes) / sigma[:, None]
    seen = latter.matrix @ wide
    columns = np.column_stack([seen, former.vector + latter.vector])
    solved = _with_prior(former.matrix + latter.matrix, columns)
    vector = wide.T @ latter.vector - seen.T @ solved[:, -1]
    found, first = [], 0
    for change, usual in zip(changes, likely or [1.0] * len(changes), strict=True):
        own = slice(first, first + change.shape[1])
        matrix = wide[:, own].T @ seen[:, own] - seen[:, own].T @ solved[:, own]
        found.append(_best_change(matrix, vector[own], usual))
        first = own.stop
    return tuple(found)


def most_of(changes: Sequence[Change]) -> int:
    """Return which hypothesis explains most."""
    return int(np.argmax([change.gain for change in changes]))


def misfit_of(before: Evidence, later: Evidence, prior_sigma: ArrayLike) -> float:
    """Return what there is to explain: by how much [variances] two robots fit better than one, each with the
    prior.

    Raises:
        ValueError: evidence about different parameters.
    """
    former, latter, _ = _scaled(before, later, prior_sigma)
    both = Evidence(former.matrix + latter.matrix, former.vector + latter.vector)
    apart, together = [
        sum(float(one.vector @ _with_prior(one.matrix, one.vector)) for one in robots)
        for robots in ((former, latter), (both,))
    ]
    return apart - together


def gain_above(freedom: int, tests_per_hour: float, alarms_per_hour: float) -> float:
    """Return the gain that chance exceeds so often: the chi-square's quantile, shared among all tests.

    Tests that overlap in time are counted as if they did not: alarms are rarer than asked for, not more.
    """
    return float(chdtri(freedom, min(alarms_per_hour / tests_per_hour, 1.0)))


def _read_only(matrix: Array, vector: Array) -> Evidence:
    make_read_only((matrix, vector))
    return Evidence(matrix, vector)


def _scaled(before: Evidence, later: Evidence, prior_sigma: ArrayLike) -> tuple[Evidence, Evidence, Array]:
    """Return both about parameters in standard deviations of their prior, and these."""
    sigma = np.asarray(prior_sigma, dtype=float)
    if before.parameters != sigma.size or later.parameters != sigma.size:
        raise ValueError(
            f"evidence about {before.parameters} and {later.parameters} parameters, prior of {sigma.size}"
        )
    former, latter = (
        Evidence(sigma[:, None] * one.matrix * sigma, sigma * one.vector) for one in (before, later)
    )
    return former, latter, sigma


def _with_prior(matrix: Array, columns: Array) -> Array:
    """Return (1 + matrix)^-1 columns."""
    factor = cho_factor(matrix + np.eye(len(matrix)), overwrite_a=True, check_finite=False)
    return np.asarray(cho_solve(factor, columns, check_finite=False))


def _best_change(matrix: Array, vector: Array, likely: float) -> Change:
    unit = np.eye(vector.size)
    covariance = np.asarray(np.linalg.inv(matrix + unit), dtype=np.float64)
    best: Array = covariance @ vector
    gain = float(vector @ best)
    if likely != 1.0:
        gain = float(vector @ np.linalg.solve(matrix + unit / likely**2, vector))
    make_read_only((best, covariance))
    return Change(gain, best, covariance)

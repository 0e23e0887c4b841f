"""Did parameters change? A generalised likelihood ratio on square-root information.

Linear models with unknown parameters theta that are the same before and later, but for a change C x:

    [ B  0  ] [ theta ]   [ b ]
    [ L  LC ] [   x   ] = [ l ],      rows in standard deviations of their noise.

By how much x makes the misfit smaller is twice the logarithm of the likelihood ratio, chi-square distributed
with as many degrees of freedom as x has if nothing has changed (Kay, Fundamentals of Statistical Signal
Processing II, section 6.5). theta is eliminated by a QR with a wide prior of its own, so that what neither
stretch tells says nothing.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import qr
from scipy.special import chdtri

from module_agent.model.chain import Array
from module_agent.model.read_only import make_read_only, read_only


class WhitenedRows(NamedTuple):
    """Rows (k, p) and targets (k,) of a stretch of time, in standard deviations, read-only."""

    rows: Array
    target: Array

    @property
    def parameters(self) -> int:
        """How many parameters it is about."""
        return int(self.rows.shape[1])


class Change(NamedTuple):
    """What one kind of change explains.

    gain: by how much it makes the misfit smaller, in variances. size: (d,) its parameters, and their
    covariance (d, d).
    """

    gain: float
    size: Array
    covariance: Array


class ChangeTest(NamedTuple):
    """The best change of every hypothesis; misfit: what there is to explain, in variances."""

    misfit: float
    changes: tuple[Change, ...]

    @property
    def best(self) -> int:
        """The index of the hypothesis that explains most."""
        return int(np.argmax([change.gain for change in self.changes]))


def compressed(rows: ArrayLike, target: ArrayLike) -> WhitenedRows:
    """Return evidence that says the same of the parameters in at most p rows.

    What no parameters explain of the targets is left out: it is noise, whatever has changed.

    Raises:
        ValueError: shapes that do not fit, or values that are not finite.
    """
    matrix, vector = np.asarray(rows, dtype=float), np.asarray(target, dtype=float)
    if matrix.ndim != 2 or vector.shape != matrix.shape[:1]:
        raise ValueError(f"rows {matrix.shape} and targets {vector.shape} do not fit: (k, p) and (k,)")
    if not (np.isfinite(matrix).all() and np.isfinite(vector).all()):
        raise ValueError("a row or a target is not finite")
    return _triangular(matrix, vector, 0)


def joined(parts: Sequence[WhitenedRows]) -> WhitenedRows:
    """Return the evidence of several stretches of time together.

    Raises:
        ValueError: no part, or parts about different parameters.
    """
    if not parts or len({part.parameters for part in parts}) != 1:
        raise ValueError(f"evidence of {[part.parameters for part in parts]} parameters cannot be joined")
    return compressed(np.vstack([p.rows for p in parts]), np.concatenate([p.target for p in parts]))


def without_own(evidence: WhitenedRows, own_sigma: ArrayLike) -> WhitenedRows:
    """Return what is left when the first parameters are this stretch's own, known before to `own_sigma`."""
    sigma = np.asarray(own_sigma, dtype=float)
    prior = np.zeros((sigma.size, evidence.parameters))
    np.fill_diagonal(prior, 1.0 / sigma)
    target = np.concatenate([np.zeros(sigma.size), evidence.target])
    return _triangular(np.vstack([prior, evidence.rows]), target, sigma.size)


def find_change(
    before: WhitenedRows, later: WhitenedRows, prior_sigma: ArrayLike, changes: Sequence[Array]
) -> ChangeTest:
    """Test what may have changed between two stretches of time.

    Args:
        before, later: about the same p parameters, as deviations from where a first model has them.
        prior_sigma: (p,) how far a parameter may be from there, before anything was measured.
        changes: per hypothesis the matrix (p, d) from its own parameters to the change of theta, in units in
            which a change of 1 is large: there is a prior of that size on them.

    Raises:
        ValueError: evidence about different parameters.
    """
    sigma = np.asarray(prior_sigma, dtype=float)
    count = sigma.size
    if before.parameters != count or later.parameters != count:
        raise ValueError(
            f"evidence about {before.parameters} and {later.parameters} parameters, prior of {count}"
        )
    # A robot without links has no link that could have changed.
    wide = np.column_stack(changes) if changes else np.zeros((count, 0))
    top = np.hstack([np.diag(1.0 / sigma), np.zeros((count, wide.shape[1] + 1))])
    middle = np.column_stack([before.rows, np.zeros((len(before.rows), wide.shape[1])), before.target])
    bottom = np.column_stack([later.rows, later.rows @ wide, later.target])
    triangle = qr(np.vstack([top, middle, bottom]), mode="r", check_finite=False)[0][count:, count:]
    target, ends = triangle[:, -1], np.cumsum([change.shape[1] for change in changes], dtype=np.int64)
    columns = np.split(triangle[:, :-1], ends[:-1], axis=1) if changes else []
    return ChangeTest(float(target @ target), tuple(_explained(own, target) for own in columns))


def gain_above(freedom: int, tests_per_hour: float, alarms_per_hour: float) -> float:
    """Return the gain that chance exceeds so often: the chi-square's quantile, shared among all tests.

    Tests that overlap in time are counted as if they did not: alarms are rarer than asked for, not more.
    """
    return float(chdtri(freedom, min(alarms_per_hour / tests_per_hour, 1.0)))


def _explained(columns: Array, target: Array) -> Change:
    size = columns.shape[1]
    normal = columns.T @ columns + np.eye(size)
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    best: Array = covariance @ (columns.T @ target)
    off = columns @ best - target
    gain = float(target @ target - off @ off - best @ best)
    make_read_only((best, covariance))
    return Change(gain, best, covariance)


def _triangular(matrix: Array, vector: Array, first: int) -> WhitenedRows:
    """Return what rows say of the parameters from the first on, by QR."""
    triangle = qr(np.column_stack([matrix, vector]), mode="r", check_finite=False)[0]
    kept = triangle[first : matrix.shape[1]]
    return WhitenedRows(read_only(kept[:, first:-1].copy()), read_only(kept[:, -1].copy()))

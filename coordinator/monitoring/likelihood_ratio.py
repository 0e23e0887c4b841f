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
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.sparse import csr_array
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
    matrix = np.eye(sigma.size) + sigma[:, None] * evidence.matrix[own, own] * sigma
    solved = cho_solve(cho_factor(matrix, check_finite=False), columns, check_finite=False)
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


class ChangeTest:
    """Tests later stretches of time against one that is known; what all of these tests share is made once."""

    def __init__(
        self,
        before: Evidence,
        prior_sigma: ArrayLike,
        changes: Sequence[Array],
        likely: Sequence[float] | None = None,
    ):
        """Take what is known before.

        Args:
            before: about p parameters, as deviations from where a first model has them.
            prior_sigma: (p,) how far a parameter may be from there, before anything was measured.
            changes: per hypothesis about what changed the matrix (p, d) from its own parameters, d of each
                hypothesis, to the change of theta, in units in which a change of 1 is large: there is a prior
                of that size on them.
            likely: per hypothesis how large changes are by which it is judged: its gain is that under a prior
                of this size, its size and covariance are those under a prior of 1; None for 1 of all.

        Raises:
            ValueError: evidence about other parameters, or shapes that do not fit.
        """
        self._sigma = np.asarray(prior_sigma, dtype=float)
        self._before = self._scaled(before)
        self._known = self._before.matrix + np.eye(len(self._sigma))
        # A robot without links has no link that could have changed.
        each = np.stack(changes) if changes else np.zeros((0, len(self._sigma), 1))
        self._likely = np.ones(len(each)) if likely is None else np.array(likely, dtype=float)
        if self._likely.shape != (len(each),):
            raise ValueError(f"{len(each)} hypotheses are judged by {self._likely.size} likely sizes")
        self._places = np.arange(each.shape[0] * each.shape[2]).reshape(-1, each.shape[2])
        # Sparse: of all parameters each change touches a few.
        self._wide = csr_array((np.swapaxes(each, 1, 2) / self._sigma).reshape(-1, len(self._sigma)))

    def find(self, later: Evidence) -> tuple[Change, ...]:
        """Return the best change of every hypothesis about what changed since.

        Raises:
            ValueError: evidence about other parameters.
        """
        latter, own = self._scaled(later), self._places
        columns = np.empty((len(self._sigma), own.size + 1), order="F")
        columns[:, :-1] = (self._wide @ latter.matrix).T
        columns[:, -1] = self._before.vector + latter.vector
        matrix, vector = self._wide @ columns[:, :-1], self._wide @ latter.vector
        # Of M^-1 only products with it from both sides are wanted: one half of its factors is enough.
        half = _half_solved(self._known + latter.matrix, columns)
        matrix -= half[:, :-1].T @ half[:, :-1]
        vector -= half[:, :-1].T @ half[:, -1]
        return _best_changes(matrix[own[:, :, None], own[:, None]], vector[own], self._likely)

    def misfit(self, later: Evidence) -> float:
        """Return what there is to explain: by how much [variances] two robots fit better than one, each with
        the prior.

        Raises:
            ValueError: evidence about other parameters.
        """
        unit, latter = np.eye(len(self._sigma)), self._scaled(later)
        robots = [
            (self._known, self._before.vector),
            (latter.matrix + unit, latter.vector),
            (self._known + latter.matrix, self._before.vector + latter.vector),
        ]
        first, second, both = (float(np.sum(_half_solved(m, v[:, None]) ** 2)) for m, v in robots)
        return first + second - both

    def _scaled(self, one: Evidence) -> Evidence:
        """Return evidence about parameters in standard deviations of their prior."""
        if one.parameters != self._sigma.size:
            raise ValueError(f"evidence about {one.parameters} parameters, prior of {self._sigma.size}")
        return Evidence(self._sigma[:, None] * one.matrix * self._sigma, self._sigma * one.vector)


def most_of(changes: Sequence[Change]) -> int:
    """Return which hypothesis explains most."""
    return int(np.argmax([change.gain for change in changes]))


def gain_above(freedom: int, tests_per_hour: float, alarms_per_hour: float) -> float:
    """Return the gain that chance exceeds so often: the chi-square's quantile, shared among all tests.

    Tests that overlap in time are counted as if they did not: alarms are rarer than asked for, not more.
    """
    return float(chdtri(freedom, min(alarms_per_hour / tests_per_hour, 1.0)))


def _read_only(matrix: Array, vector: Array) -> Evidence:
    make_read_only((matrix, vector))
    return Evidence(matrix, vector)


def _half_solved(matrix: Array, columns: Array) -> Array:
    """Return L^-1 columns of a matrix L L^T.

    By LAPACK itself: most matrices are small, and `scipy.linalg` takes ten times as long for what is around.
    """
    # It is symmetric, and transposed laid out as LAPACK has its matrices. A copy: it may be shared.
    factor, failed = dpotrf(matrix.T, lower=True, clean=False)
    if failed:
        raise np.linalg.LinAlgError(f"a matrix of {len(matrix)} rows is not positive definite")
    return np.asarray(dtrtrs(factor, columns, lower=True)[0])


def _best_changes(matrices: Array, vectors: Array, likely: Array) -> tuple[Change, ...]:
    """Return the best changes of k hypotheses by their S - 1 (k, d, d) and r (k, d)."""
    unit = np.eye(vectors.shape[1])
    covariances = np.linalg.inv(matrices + unit)
    best = np.matvec(covariances, vectors)
    judged = np.linalg.solve(matrices + unit / likely[:, None, None] ** 2, vectors[..., None])[..., 0]
    gains = np.vecdot(vectors, judged)
    make_read_only((best, covariances))
    return tuple(Change(float(gain), *one) for gain, *one in zip(gains, best, covariances, strict=True))

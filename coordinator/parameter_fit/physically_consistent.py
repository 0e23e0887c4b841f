"""Physically consistent bodies that explain the torques: least squares with a prior on the mass distribution.

A body is physically consistent if its pseudo-inertia J is positive definite (`pseudo_inertia`). Where torques
do not determine it a prior J0 does, by the entropic divergence of two mass distributions (Lee, Wensing and
Park 2020, Geometric robot dynamic identification: a convex programming approach),

    d(J | J0) = -log det(J J0^-1) + tr(J J0^-1) - 4,

which does not depend on frames or units and is unbounded at the boundary of the consistent bodies. So

    minimise |R x - z|^2 / 2 + w sum_i d(J_i(x) | J0_i)

is convex, smooth and self-concordant, and needs no constraint: Newton's method with a line search solves it
(Boyd and Vandenberghe 2004, Convex optimization, section 9.6).

R and z have white noise. Systematic errors E (`systematic_errors`) are small shares of the torques, but many
times the noise of thousands of samples: fitted as if they were signal, they move the directions that hardly
show in torques by whole bodies. So bodies are fitted by generalised least squares, with the covariance
I + E E^T, and the rows with white noise keep only the weight mu that prediction needs:

    minimise |W (R x - z)|^2 / 2 + mu |R x - z|^2 / 2 + w sum_i d(J_i(x) | J0_i)
             + w_m sum_i (m_i / m0_i - 1)^2 / 2,    W (I + E E^T) W = I,

with the smallest mu whose raw torque error is within `MAX_COST` of that of mu = 1 without W.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, qr, solve_triangular
from scipy.optimize import brentq

from coordinator.dynamics.pseudo_inertia import parameter_transform, pseudo_inertia
from coordinator.parameter_fit.base_parameters import whitened
from coordinator.parameter_fit.least_squares import InertialFit
from coordinator.parameter_fit.spectrum import UndeterminedError
from coordinator.parameter_fit.systematic_errors import decorrelation, whitened_effects
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY

# Near the prior w d is w |dJ J0^-1|^2 / 2, so that a weight of 10 is the belief that a body's distribution of
# mass is known to about 30 %: modules better, links worse. Errors of the model, as friction and springs, are
# not white, and a weaker prior fits them by bodies of tons: the weaker ones are for torques that this one
# does not explain.
WEIGHTS = (10.0, 1.0, 0.1, 0.01)
# The prior may increase the relative torque error of least squares by this: half of the bound for motions
# that were not fitted, because those are another sample of the same.
MAX_COST = 5e-4
# The same of a body's mass alone, where systematic errors are considered. They show as first moments, of a
# body on a vertical axis above all, which without it a mass of several kilograms explains best.
MASS_WEIGHT = 100.0
# The claim does not lean on those weights: the prior's distributions of mass are a factor of two off (one
# standard deviation, `inertia_prior`), 1 / log(2)^2.
CLAIMED_WEIGHT = 2.0
# Weights mu of the rows with white noise, falling; by steps of half an order the error hardly jumps.
RAW_WEIGHTS = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4)
# Of the error of a model that lacks most of the torque: by less no two bodies are told apart.
_SAME_ERROR = 0.01
# Smallest noise as a share of the torques' rms: simulated torques without noise are not fitted closer.
_FINEST = 1e-5

_MAX_STEPS = 200
# Of the prior's weight: the objective is then within 1e-7 divergences of its minimum.
_DECREMENT = 1e-7
# Tolerance of all barriers but the last, each of which is a tenth of the one before.
_ROUGHLY = 0.05
_FALL = 10.0
# Under a barrier bodies may grow to this many times the prior where torques do not determine them.
_LARGEST = 1e3
# A body far too small grows at most this many times over in a step.
_MAX_STEP = 1e6
_UNITS = np.stack([pseudo_inertia(unit) for unit in np.eye(PER_BODY)])
_TRACE = np.trace(_UNITS, axis1=1, axis2=2)


class NotSolvedError(DataError):
    """Newton's method did not converge; the message says how far it came."""


class PhysicalFit(NamedTuple):
    """n physically consistent bodies that explain the torques; arrays are read-only.

    phi: (10 n,) as in `torque_regressor`. covariance: (10 n, 10 n) of the posterior: it is small where the
        prior decides; that of the torques alone is `InertialFit.covariance`.
    pseudo: (n, 4, 4) the bodies' pseudo-inertias, in the root frame. divergence: (n,) from the prior.
    weight: of the prior. error: relative torque error |e| / |tau| of the fit. least_squares_error: that of
        least squares, which keeps directions below the noise at zero.
    """

    phi: Array
    covariance: Array
    pseudo: Array
    divergence: Array
    weight: float
    error: float
    least_squares_error: float


class Solution(NamedTuple):
    """The minimum for one weight: x (p,), its covariance (p, p), the divergences (n,)."""

    x: Array
    covariance: Array
    divergence: Array


def fit_physical(
    information: Sequence[JointInformation],
    prior: ArrayLike,
    least_squares: InertialFit,
    independent_fraction: float = 1.0,
    max_cost: float = MAX_COST,
    effects: Sequence[Array] | None = None,
) -> PhysicalFit:
    """Fit physically consistent bodies to the torques of all joints.

    The prior has the largest of `WEIGHTS` whose relative torque error exceeds that of least squares by at
    most `max_cost`, or by no more than the noise that least squares fits or the systematic errors. If there
    is none, because friction is missing in the model for example, it is the largest within `max_cost` of the
    best of them.

    Args:
        information: per joint of n.
        prior: (n, 4, 4) pseudo-inertias in the root frame at q = 0 (`inertia_prior.module_prior`).
        least_squares: the fit without the constraint to the same information. Its noise weighs data against
            prior; all joints count alike, as in unweighted least squares, so that the errors of the two
            compare.
        independent_fraction: independent samples per sample, below 1 after a low-pass.
        max_cost: see above; a share of |tau|.
        effects: (k_i, j) of every joint, of systematic errors (`systematic_errors`). The bodies do not follow
            them where the torques hardly show it, masses are near the prior's there (`MASS_WEIGHT`), and the
            covariance contains them.

    Raises:
        UndeterminedError: torques that are all zero.
        ValueError: shapes that do not fit, or a prior that is no body's.
        NotSolvedError: numerical trouble.
    """
    bodies = np.asarray(prior, dtype=float)
    size = float(np.sqrt(sum(piece.z @ piece.z + piece.rest for piece in information)))
    if not size > 0.0:
        raise UndeterminedError("all torques are zero: no bodies explain them")
    error_of = partial(_relative_error, information, size)
    best = error_of(least_squares.phi)
    # Least squares fits its own noise too: by so much the true bodies themselves would be worse.
    finest = _FINEST * size / np.sqrt(sum(piece.samples for piece in information))
    common = max(float(np.sqrt(np.mean(least_squares.torque_sigma_nm**2))), finest)
    sigma = np.full(len(information), common)
    rows, target = whitened(information, sigma, independent_fraction)
    own = least_squares.rank * common**2 / independent_fraction
    allowed = max(best + max_cost, float(np.hypot(best, np.sqrt(own) / size)))
    if effects is not None:
        # The true bodies themselves would miss the torques by the systematic errors.
        likely = common * np.linalg.norm(whitened_effects(effects, sigma, 1.0))
        allowed = max(allowed, float(np.hypot(best, likely / size)))
    solution, weight, error = _strongest_prior(
        rows=rows, target=target, prior=bodies, error_of=error_of, allowed=allowed, max_cost=max_cost
    )
    if effects is not None:
        own_sigma = np.maximum(least_squares.torque_sigma_nm, finest)
        own_rows = whitened(information, own_sigma, independent_fraction)
        data = _Data(
            *own_rows,
            effects=whitened_effects(effects, own_sigma, independent_fraction),
            alike=np.repeat(own_sigma / common, [len(piece.r) for piece in information]),
        )
        solution, error = _considered(data, bodies, weight, error_of, error + max_cost)
    pseudo = np.stack([pseudo_inertia(phi) for phi in solution.x.reshape(-1, PER_BODY)])
    make_read_only((pseudo, *solution))
    return PhysicalFit(
        phi=solution.x,
        covariance=solution.covariance,
        pseudo=pseudo,
        divergence=solution.divergence,
        weight=weight,
        error=error,
        least_squares_error=best,
    )


class _Data(NamedTuple):
    """Rows (k, p), target (k,) and systematic errors (k, j), whitened by every joint's own noise.

    alike: (k,) factors of the rows with which all joints count alike.
    """

    rows: Array
    target: Array
    effects: Array
    alike: Array


def _considered(
    data: _Data, prior: Array, weight: float, error_of: Callable[[Array], float], allowed: float
) -> tuple[Solution, float]:
    """Return the solution with the smallest of `RAW_WEIGHTS` whose error is allowed, and the error."""
    whitening = decorrelation(data.effects)
    rows, target = whitening @ data.rows, whitening @ data.target
    masses, expected = _mass_rows(prior, data.rows.shape[1])
    tried: list[tuple[Solution, float, float]] = []
    for raw in RAW_WEIGHTS:
        part = np.sqrt(raw) * data.alike
        stacked = np.vstack([rows, part[:, None] * data.rows, masses])
        goal = np.concatenate([target, part * data.target, expected])
        solution = physically_consistent(stacked, goal, prior, weight)
        error = error_of(solution.x)
        if tried and error > allowed:
            break
        tried.append((solution, error, raw))
    solution, error, raw = tried[-1]
    weights = whitening @ whitening + np.diag(raw * data.alike**2)
    covariance = _covariance(data, weights, solution.x, prior, weight)
    return solution._replace(covariance=covariance), error


def _mass_rows(prior: Array, columns: int) -> tuple[Array, Array]:
    """Return rows (n, columns) and target (n,) of masses that are the prior's, weighted."""
    rows, bodies = np.zeros((len(prior), columns)), np.arange(len(prior))
    rows[bodies, PER_BODY * bodies] = np.sqrt(MASS_WEIGHT) / prior[:, 3, 3]
    return rows, np.full(len(prior), np.sqrt(MASS_WEIGHT))


def _covariance(data: _Data, weights: Array, x: Array, prior: Array, weight: float) -> Array:
    """Return the covariance (p, p) of x, which minimises (R x - z)^T G (R x - z) / 2 and the prior's terms.

    z has noise e of covariance I + E E^T, the prior the error e_0 of covariance C_0 (`CLAIMED_WEIGHT`). With
    G = `weights` (k, k) and P the curvature of the prior's terms, x errs by H^-1 (R^T G e + P e_0),
    H = R^T G R + P. Curvatures are taken at the prior or at x, where the body is heavier: those at a body
    that the data made too light would claim too much.
    """
    bodies = x.reshape(-1, PER_BODY)
    at = [pseudo_inertia(one) if one[0] > own[3, 3] else own for one, own in zip(bodies, prior, strict=True)]
    scale = block_diag(*(parameter_transform(np.linalg.cholesky(own)) for own in at))
    masses = _mass_rows(prior, len(x))[0] @ scale
    rows = data.rows @ scale
    # Of the divergence along two units E and F of a body that is the identity: tr(E F).
    unit = _UNITS.reshape(PER_BODY, 16) @ _UNITS.reshape(PER_BODY, 16).T
    slope = weight * np.kron(np.eye(len(bodies)), unit) + masses.T @ masses
    inverse = np.linalg.inv(rows.T @ weights @ rows + slope)
    gain = inverse @ rows.T @ weights
    likely = np.kron(np.eye(len(bodies)), np.linalg.cholesky(np.linalg.inv(CLAIMED_WEIGHT * unit)))
    parts = scale @ np.hstack([gain, gain @ data.effects, inverse @ slope @ likely])
    return np.asarray(parts @ parts.T)


def _strongest_prior(
    rows: Array,
    target: Array,
    prior: Array,
    error_of: Callable[[Array], float],
    allowed: float,
    max_cost: float,
) -> tuple[Solution, float, float]:
    """Return the solution with the largest weight whose error is allowed, the weight, and the error."""
    tried: list[tuple[Solution, float, float]] = []
    for weight in WEIGHTS:
        solution = physically_consistent(rows, target, prior, weight)
        tried.append((solution, weight, error_of(solution.x)))
        if tried[-1][2] <= allowed:
            return tried[-1]
    # No consistent bodies do as well as least squares: the model lacks something. The cost is counted from
    # the best of them instead.
    cheapest = min(error for _, _, error in tried)
    return next(one for one in tried if one[2] - cheapest <= max(max_cost, _SAME_ERROR * cheapest))


def physically_consistent(rows: ArrayLike, target: ArrayLike, prior: ArrayLike, weight: float) -> Solution:
    """Minimise |R x - z|^2 / 2 + weight * divergence from the prior over consistent bodies.

    Args:
        rows: (k, p) in standard deviations; the first 10 n columns are the bodies'. The rest are parameters
            without constraint and without prior (friction), which the rows must determine.
        target: (k,). prior: (n, 4, 4). weight: above 0.

    Raises:
        ValueError: shapes that do not fit, a prior that is no body's, or a weight that is not positive.
        NotSolvedError: numerical trouble.
    """
    problem = _problem(rows, target, prior, weight)
    y = problem.origin()
    # Far from the minimum Newton's method needs many steps. So the logarithm alone begins with a weight that
    # dominates the misfit and decreases to the prior's (the barrier method: Boyd and Vandenberghe, section
    # 11.3). If the whole divergence did, a prior that is far off would cost hundreds of steps.
    high = problem.misfit(y) / (4.0 * problem.bodies)
    times = max(0, int(np.ceil(np.log(high / weight) / np.log(_FALL)))) if high > 0.0 else 0
    for left in range(times, 0, -1):
        barrier = weight * _FALL**left
        far = problem._replace(barrier=barrier, weight=max(weight, barrier / _LARGEST))
        y = _descend(far, y, _ROUGHLY)
    y = _descend(problem, y, _DECREMENT)
    spread = problem.scale @ solve_triangular(problem.slope(y)[1], np.eye(len(y)))
    return Solution(problem.scale @ y, spread @ spread.T, problem.divergence(y))


def _descend(problem: "_Problem", y: Array, decrement: float) -> Array:
    """Return the minimum to within `decrement` times the barrier, from `y`, by Newton's method."""
    fall = np.inf
    for step in range(_MAX_STEPS):
        try:
            gradient, triangle = problem.slope(y)
            down = -solve_triangular(triangle, solve_triangular(triangle, gradient, trans="T"))
        except np.linalg.LinAlgError as error:
            raise NotSolvedError(
                f"no consistent bodies were found after {step} steps: {error}; the rows may not determine "
                "the parameters without a prior"
            ) from error
        fall = float(-gradient @ down)
        if fall < 2.0 * decrement * problem.barrier:
            return y
        length = problem.best_length(y, down)
        if not length > 0.0:
            # The rest is rounding: no lower objective is resolved.
            return y
        y = y + length * down
    raise NotSolvedError(
        f"no consistent bodies were found in {_MAX_STEPS} steps; the last decrement is {fall:.2g}"
    )


class _Problem(NamedTuple):
    """The problem in coordinates in which every prior is the identity: x = scale @ y, J_i = C_i Y_i C_i^T.

    The objective is |triangle y - target|^2 / 2 + sum_i (weight tr Y_i - barrier log det Y_i).
    """

    triangle: Array
    target: Array
    scale: Array
    bodies: int
    weight: float
    barrier: float

    def origin(self) -> Array:
        """Return the prior (p,), and zero for what has none."""
        one = np.array([1.0, 0, 0, 0, 2.0, 0, 0, 2.0, 0, 2.0])
        return np.concatenate([np.tile(one, self.bodies), np.zeros(len(self.scale) - PER_BODY * self.bodies)])

    def matrices(self, y: Array) -> Array:
        """Return the Y_i (n, 4, 4)."""
        own = y[: PER_BODY * self.bodies].reshape(self.bodies, PER_BODY)
        return np.asarray(np.einsum("na,aij->nij", own, _UNITS))

    def divergence(self, y: Array) -> Array:
        """Return the divergences (n,); infinite where a body cannot exist."""
        matrices = self.matrices(y)
        values = np.linalg.eigvalsh(matrices)
        if not (values > 0.0).all():
            return np.full(self.bodies, np.inf)
        return np.asarray(np.sum(values - np.log(values) - 1.0, axis=1))

    def misfit(self, y: Array) -> float:
        """Return |R x - z|^2 / 2 less the part that no parameters explain."""
        error = self.triangle @ y - self.target
        return float(0.5 * error @ error)

    def best_length(self, y: Array, down: Array) -> float:
        """Return the t that minimises the objective along y + t * down, 0 if it does not fall.

        Steps that merely decrease it may end next to the boundary, and the next ones are then short.
        Along a line log det(Y + t D) is the sum of log(1 + t l) over the eigenvalues l of L^-1 D L^-T.
        """
        lower = np.linalg.inv(np.linalg.cholesky(self.matrices(y)))
        along = self.matrices(down)
        rates = np.linalg.eigvalsh(lower @ along @ lower.transpose(0, 2, 1)).ravel()
        change = self.triangle @ down
        curvature = float(change @ change)
        pull = float(change @ (self.triangle @ y - self.target))
        pull += self.weight * float(np.trace(along, axis1=1, axis2=2).sum())

        def grows(t: float) -> float:
            return curvature * t + pull - self.barrier * float(np.sum(rates / (1.0 + t * rates)))

        if not grows(0.0) < 0.0:
            return 0.0
        # The slope grows from below zero to above it before the boundary is reached.
        longest = 1.0 / -float(rates.min()) if rates.min() < 0.0 else np.inf
        reach = min(1.0, 0.5 * longest)
        while grows(reach) < 0.0 and reach < _MAX_STEP:
            reach = min(2.0 * reach, 0.5 * (reach + longest))
        return float(brentq(grows, 0.0, reach, rtol=1e-6)) if grows(reach) > 0.0 else reach

    def slope(self, y: Array) -> tuple[Array, Array]:
        """Return the gradient (p,) and the triangular square root (p, p) of the Hessian.

        Of -log det Y along E: -tr(Y^-1 E); along E and F: tr(Y^-1 E Y^-1 F), the product of L^-1 E L^-T and
        L^-1 F L^-T for Y = L L^T.
        """
        lower = np.linalg.inv(np.linalg.cholesky(self.matrices(y)))
        whitened_units = lower[:, None] @ _UNITS @ lower[:, None].transpose(0, 1, 3, 2)
        gradient = self.triangle.T @ (self.triangle @ y - self.target)
        pull = self.weight * _TRACE - self.barrier * np.trace(whitened_units, axis1=2, axis2=3)
        gradient[: pull.size] += pull.ravel()
        roots = np.sqrt(self.barrier) * block_diag(*(one.reshape(PER_BODY, 16).T for one in whitened_units))
        stacked = np.zeros((len(self.triangle) + len(roots), len(y)))
        stacked[: len(self.triangle)] = self.triangle
        stacked[len(self.triangle) :, : roots.shape[1]] = roots
        return gradient, qr(stacked, mode="r", check_finite=False)[0][: len(y)]


def _problem(rows: ArrayLike, target: ArrayLike, prior: ArrayLike, weight: float) -> _Problem:
    matrix, measured = np.asarray(rows, dtype=float), np.asarray(target, dtype=float)
    bodies = np.asarray(prior, dtype=float)
    if matrix.ndim != 2 or measured.shape != matrix.shape[:1] or bodies.shape != (len(bodies), 4, 4):
        raise ValueError(f"rows {matrix.shape}, target {measured.shape} and prior {bodies.shape} do not fit")
    free = matrix.shape[1] - PER_BODY * len(bodies)
    if free < 0:
        raise ValueError(f"rows of {matrix.shape[1]} columns for {len(bodies)} bodies of ten parameters")
    if not weight > 0.0:
        raise ValueError(f"the prior's weight is {weight}; it must be above 0")
    try:
        roots = np.linalg.cholesky(bodies)
    except np.linalg.LinAlgError as error:
        raise DataError("a body of the prior cannot exist: its pseudo-inertia is not positive") from error
    scale = block_diag(*(parameter_transform(root) for root in roots), np.eye(free))
    square = qr(np.column_stack([matrix @ scale, measured]), mode="r", check_finite=False)[0]
    # The last row is what no parameters explain; without it small decreases are not lost in rounding.
    square = square[: matrix.shape[1]]
    return _Problem(
        triangle=square[:, :-1],
        target=square[:, -1],
        scale=scale,
        bodies=len(bodies),
        weight=weight,
        barrier=weight,
    )


def _relative_error(information: Sequence[JointInformation], size: float, phi: Array) -> float:
    misfit = [piece.r @ phi - piece.z for piece in information]
    total = sum(float(e @ e) + piece.rest for e, piece in zip(misfit, information, strict=True))
    return float(np.sqrt(total)) / size

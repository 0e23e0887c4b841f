"""Inertial parameters from joint torques by the pseudo-inverse (thesis eq. 29), with their identifiability.

A robot on a fixed base with one torque per joint never determines all parameters. The pseudo-inverse leaves
the undetermined combinations at zero or at a prior, and the fit reports them: rank, singular values, the
projector onto the identifiable subspace and the covariance within it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from coordinator.dynamics.pseudo_inertia import parameter_scale
from coordinator.parameter_fit.spectrum import (
    MAX_SIGMA_KG,
    RANK_TOLERANCE,
    Spectrum,
    degrees_of_freedom,
    spectrum,
    spread,
)
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY

# A parameter's share in the identifiable subspace is exact to rounding; a chain that was itself estimated
# tilts the subspace by about its errors, 1e-3, which appear here squared.
SHARE_TOLERANCE = 1e-5


class InertialFit(NamedTuple):
    """Least-squares parameters of n bodies; arrays are read-only, p = 10 n.

    phi: (p,) as in `torque_regressor`. Only its projection is determined.
    rank: number of parameter combinations that were identified.
    singular_values: (p,) of the weighted regressor in kg (see `REACH_M`), falling, the discarded ones too.
    condition: largest over smallest kept singular value.
    covariance: (p, p) of the identified combinations; zero along all others, which is not certainty.
    projector: (p, p) onto the identifiable subspace: `projector @ phi_true` is what `phi` estimates.
    identifiable: (p,) parameters known by themselves: the projector's diagonal is 1 there, and 0 where a
        parameter is in no identified combination.
    residual_rms_nm: (n,) of the torque. torque_sigma_nm: (n,) noise estimated from it (degrees of freedom
        taken off); without weights a noisy joint's errors of the parameters add to a quiet joint's residual,
        whose noise then comes out too large. samples: (n,) per joint.
    """

    phi: Array
    rank: int
    singular_values: Array
    condition: float
    covariance: Array
    projector: Array
    identifiable: NDArray[np.bool_]
    residual_rms_nm: Array
    torque_sigma_nm: Array
    samples: NDArray[np.int64]


class _System(NamedTuple):
    """The weighted least-squares problem of the deviation from the prior, parameters in kg."""

    blocks: list[Array]
    targets: list[Array]
    scale: Array
    prior: Array
    weights: Array


def solve_information(
    information: Sequence[JointInformation],
    weights: ArrayLike | None = None,
    prior_phi: ArrayLike | None = None,
    max_sigma_kg: float = MAX_SIGMA_KG,
    independent_fraction: float = 1.0,
    tolerance: float = RANK_TOLERANCE,
    effects: Sequence[Array] | None = None,
) -> InertialFit:
    """Fit `phi` to torques: prior + pinv(Y) (tau - Y prior), thesis eq. 29 with the pseudo-inverse.

    Args:
        information: per joint of n, as `compress` or `gather` return it.
        weights: (n,) per joint, 1 / sigma of its torque; None weighs all joints alike, as the thesis does.
        prior_phi: (10 n,) the point from which the smallest deviation is sought, None for zero. It acts only
            where the torques determine nothing; it is no regularisation.
        max_sigma_kg: a direction with a larger standard deviation keeps its prior (see `MAX_SIGMA_KG`); inf
            keeps all that rounding allows.
        independent_fraction: independent samples per sample, below 1 after a low-pass (2 cut-off / rate). It
            widens the covariance.
        tolerance: singular values that are smaller shares of the largest count as zero.
        effects: (k_i, j) of every joint: effects of systematic errors, each one standard deviation, on its
            rows (`systematic_errors`). They count towards `max_sigma_kg`; the covariance is that of noise.

    Raises:
        DataError: torques that say nothing, fewer samples than parameters, or noise that is not positive.
        ValueError: shapes that do not fit, or values out of range.
    """
    if not 0.0 < independent_fraction <= 1.0:
        raise ValueError(f"independent_fraction is {independent_fraction}; it must be above 0 and at most 1")
    system = _system(information, weights, prior_phi)
    whole, along = _decomposed(system)
    kept = whole.determined(tolerance)
    # First with all directions that rounding allows: the noise decides which of them are kept.
    inverse = whole.inverse(kept)
    left = [block @ inverse for block in system.blocks]
    sigma = _residual(information, system, inverse @ along[kept], left)[1]
    variance = np.diagonal(spread(left, (sigma * system.weights) ** 2)) / independent_fraction
    if effects is not None:
        systematic = (w * u.T @ one for w, u, one in zip(system.weights, left, effects, strict=True))
        variance = variance + np.sum(sum(systematic, np.zeros(())) ** 2, axis=1)
    kept[kept] = variance < (max_sigma_kg * whole.values[kept]) ** 2
    inverse = whole.inverse(kept)
    deviation = inverse @ along[kept]
    left = [block @ inverse for block in system.blocks]
    rms, sigma = _residual(information, system, deviation, left)
    covariance_kg = inverse @ spread(left, (sigma * system.weights) ** 2) @ inverse.T / independent_fraction
    within = whole.directions[kept].T @ whole.directions[kept]
    fit = InertialFit(
        phi=system.prior + system.scale * deviation,
        rank=int(kept.sum()),
        singular_values=whole.values,
        condition=whole.condition(kept),
        covariance=system.scale[:, None] * covariance_kg * system.scale,
        projector=system.scale[:, None] * within / system.scale,
        identifiable=np.diagonal(within) > 1.0 - SHARE_TOLERANCE,
        residual_rms_nm=rms,
        torque_sigma_nm=sigma,
        samples=np.array([piece.samples for piece in information], dtype=np.int64),
    )
    make_read_only(fit)
    return fit


def solve_weighted(
    information: Sequence[JointInformation],
    independent_fraction: float = 1.0,
    tolerance: float = RANK_TOLERANCE,
) -> InertialFit:
    """Fit `phi` with each joint's torque weighted by its noise, which a first fit without weights estimates.

    Without weights the noise of heavily loaded joints is fitted by parameters that only lightly loaded joints
    determine.

    Raises:
        DataError: torques that say nothing, fewer samples than parameters, or noise that is not positive.
        ValueError: shapes that do not fit, or values out of range.
    """
    first = solve_information(information, independent_fraction=independent_fraction, tolerance=tolerance)
    # Torques without noise weigh no more than a thousand times the others.
    sigma = np.maximum(first.torque_sigma_nm, 1e-3 * first.torque_sigma_nm.max())
    if not sigma.max() > 0.0:
        return first
    return solve_information(
        information, 1.0 / sigma, independent_fraction=independent_fraction, tolerance=tolerance
    )


def _system(
    information: Sequence[JointInformation], weights: ArrayLike | None, prior_phi: ArrayLike | None
) -> _System:
    joints = len(information)
    size = PER_BODY * joints
    weight = np.ones(joints) if weights is None else np.asarray(weights, dtype=float)
    prior = np.zeros(size) if prior_phi is None else np.asarray(prior_phi, dtype=float).reshape(-1)
    if weight.shape != (joints,) or not (np.isfinite(weight).all() and (weight > 0.0).all()):
        raise DataError(f"weights must be {joints} positive numbers, one per joint; got {weight}")
    if prior.shape != (size,) or not np.isfinite(prior).all():
        raise ValueError(f"prior_phi must be {size} finite numbers; got {prior.size}")
    scale = parameter_scale(joints)
    blocks = [w * piece.r * scale for w, piece in zip(weight, information, strict=True)]
    targets = [w * (piece.z - piece.r @ prior) for w, piece in zip(weight, information, strict=True)]
    return _System(blocks, targets, scale, prior, weight)


def _decomposed(system: _System) -> tuple[Spectrum, Array]:
    """Return the spectrum of all rows, with p directions, and the targets along the left singular vectors."""
    size = system.scale.size
    stacked = np.column_stack([np.vstack(system.blocks), np.concatenate(system.targets)])
    triangle = qr(stacked, mode="r", check_finite=False)[0][:size]
    square = np.zeros((size, size + 1))
    square[: triangle.shape[0]] = triangle
    whole = spectrum(square[:, :-1])
    return whole, whole.left.T @ square[:, -1]


def _residual(
    information: Sequence[JointInformation], system: _System, deviation: Array, left: Sequence[Array]
) -> tuple[Array, Array]:
    """Return per joint the residual's rms and the noise estimated from it [Nm]."""
    rms, sigma = np.empty(len(information)), np.empty(len(information))
    for i, (piece, rows) in enumerate(zip(information, left, strict=True)):
        misfit = (system.blocks[i] @ deviation - system.targets[i]) / system.weights[i]
        total = float(misfit @ misfit) + piece.rest
        freedom = degrees_of_freedom(i, piece.samples, rows)
        rms[i], sigma[i] = np.sqrt(total / piece.samples), np.sqrt(total / freedom)
    return rms, sigma

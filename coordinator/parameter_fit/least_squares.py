"""Inertial parameters from joint torques by the pseudo-inverse (thesis eq. 29), with what it cannot know.

A robot on a fixed base with one torque a joint never shows all parameters. The pseudo-inverse leaves what the
torques say nothing of where it was (at zero, or at a prior), and everything about that is reported: rank,
singular values, the projector onto the identifiable subspace and the covariance within it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from coordinator.dynamics.pseudo_inertia import parameter_scale
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.information import JointInformation, compress
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY

# Rounding in the regressor is 1e-15 of the largest singular value and grows with the depth of the tree; the
# weakest motion that an encoder of 14 bits resolves is above 1e-8. Nothing real lies between.
RANK_TOLERANCE = 1e-11

# The same where the chain was itself estimated: axes that are wrong by 1e-5 to 1e-4 rad show, by as much of
# the largest singular value, parameters that the true ones do not. An arm's weakest real one is above 1e-3.
ESTIMATED_CHAIN_TOLERANCE = 1e-4

# A direction with a larger standard deviation is not identified: the mass of one module is about 0.3 kg, so
# that the parameter's zero (or the prior) is nearer to the truth than the estimate.
MAX_SIGMA_KG = 0.3

# A parameter's share in the identifiable subspace is exact to rounding; a chain that was itself estimated
# tilts the subspace by about its errors, 1e-3, which appear here squared.
SHARE_TOLERANCE = 1e-5


class InertialFit(NamedTuple):
    """Parameters of n bodies as least squares gives them; arrays are read-only, p = 10 n.

    phi: (p,) as in `torque_regressor`. Only its projection is known.
    rank: number of parameter combinations that were identified; p - rank are `unidentifiable_count`.
    singular_values: (p,) of the weighted regressor in kg (see `REACH_M`), falling, the discarded ones too.
    condition: largest over smallest kept singular value.
    covariance: (p, p) of the identified combinations; zero along all others, which is not certainty.
    projector: (p, p) onto the identifiable subspace: `projector @ phi_true` is what `phi` estimates.
    identifiable: (p,) parameters known by themselves. without_effect: (p,) those in no identified
        combination. The rest are known only in combination with others.
    residual_rms_nm: (n,) of the torque. torque_sigma_nm: (n,) noise estimated from it (degrees of freedom
        taken off); without weights a quiet joint's comes out too large beside a noisy one, because the noisy
        one's errors in the parameters act on it too. samples: (n,) per joint.
    """

    phi: Array
    rank: int
    unidentifiable_count: int
    singular_values: Array
    condition: float
    covariance: Array
    projector: Array
    identifiable: NDArray[np.bool_]
    without_effect: NDArray[np.bool_]
    residual_rms_nm: Array
    torque_sigma_nm: Array
    samples: NDArray[np.int64]


class _Spectrum(NamedTuple):
    """Singular values (p,), right singular vectors (p, p) as columns, targets along the left ones (p,)."""

    values: Array
    directions: Array
    along: Array


class _System(NamedTuple):
    """The weighted least-squares problem of the deviation from the prior, parameters in kg."""

    blocks: list[Array]
    targets: list[Array]
    scale: Array
    prior: Array
    weights: Array


def solve_pseudo_inverse(
    regressor: ArrayLike,
    tau_nm: ArrayLike,
    weights: ArrayLike | None = None,
    prior_phi: ArrayLike | None = None,
    max_sigma_kg: float = MAX_SIGMA_KG,
    independent_fraction: float = 1.0,
) -> InertialFit:
    """Fit `phi` to torques: prior + pinv(Y) (tau - Y prior), thesis eq. 29 with the pseudo-inverse.

    Args:
        regressor: (m, n, 10 n) from `torque_regressor`.
        tau_nm: (m, n) measured torques.
        weights: (n,) per joint, 1 / sigma of its torque; None weighs all joints alike, as the thesis does.
        prior_phi: (10 n,) the point from which the smallest deviation is sought, None for zero. It acts only
            where the torques say nothing; it is no regularisation.
        max_sigma_kg: a direction known worse than this keeps its prior (see `MAX_SIGMA_KG`); inf keeps all
            that rounding allows.
        independent_fraction: independent samples per sample, below 1 after a low-pass (2 cut-off / rate). It
            widens the covariance.

    Raises:
        ValueError: shapes that do not fit, values out of range, or fewer samples than parameters.
    """
    return solve_information(
        compress(regressor, tau_nm), weights, prior_phi, max_sigma_kg, independent_fraction
    )


def solve_information(
    information: Sequence[JointInformation],
    weights: ArrayLike | None = None,
    prior_phi: ArrayLike | None = None,
    max_sigma_kg: float = MAX_SIGMA_KG,
    independent_fraction: float = 1.0,
    tolerance: float = RANK_TOLERANCE,
) -> InertialFit:
    """Fit `phi` to the collected information of all joints; for the arguments see `solve_pseudo_inverse`.

    tolerance: singular values that are smaller shares of the largest count as zero.

    Raises:
        ValueError: shapes that do not fit, values out of range, or fewer samples than parameters.
    """
    if not 0.0 < independent_fraction <= 1.0:
        raise ValueError(f"independent_fraction is {independent_fraction}; it must be above 0 and at most 1")
    system = _system(information, weights, prior_phi)
    spectrum = _spectrum(system)
    kept = spectrum.values > tolerance * spectrum.values[0]
    # First with all directions that rounding allows: what is lost in the noise can only be said with the
    # noise.
    inverse = _inverse(spectrum, kept)
    left = [block @ inverse for block in system.blocks]
    sigma = _residual(information, system, inverse @ spectrum.along[kept], left)[1]
    variance = np.diagonal(_left_covariance(left, sigma * system.weights)) / independent_fraction
    kept[kept] = variance < (max_sigma_kg * spectrum.values[kept]) ** 2
    return _fit(information, system, spectrum, kept, independent_fraction)


def solve_weighted(
    information: Sequence[JointInformation],
    independent_fraction: float = 1.0,
    tolerance: float = RANK_TOLERANCE,
) -> InertialFit:
    """Fit `phi`, each joint's torque weighed by the noise that a first fit without weights leaves in it.

    Without weights the noise of joints that carry much is taken for torque of those that carry little.

    Raises:
        ValueError: shapes that do not fit, values out of range, or fewer samples than parameters.
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


def _spectrum(system: _System) -> _Spectrum:
    size = system.scale.size
    stacked = np.column_stack([np.vstack(system.blocks), np.concatenate(system.targets)])
    triangle = qr(stacked, mode="r", check_finite=False)[0][:size]
    square = np.zeros((size, size + 1))
    square[: triangle.shape[0]] = triangle
    left, values, rows = np.linalg.svd(square[:, :-1])
    if not values[0] > 0.0:
        raise DataError("the regressor is zero: without gravity or motion the torques say nothing")
    return _Spectrum(values, rows.T, left.T @ square[:, -1])


def _inverse(spectrum: _Spectrum, kept: NDArray[np.bool_]) -> Array:
    """Return V / S (p, rank) of the kept directions."""
    found: Array = spectrum.directions[:, kept] / spectrum.values[kept]
    return found


def _left_covariance(left: Sequence[Array], weighted_sigma: Array) -> Array:
    """Return U^T diag(sigma^2) U, the covariance of the torques along the left singular vectors."""
    found = np.zeros((left[0].shape[1], left[0].shape[1]))
    for rows, sigma in zip(left, weighted_sigma, strict=True):
        found += sigma**2 * (rows.T @ rows)
    return found


def _residual(
    information: Sequence[JointInformation], system: _System, deviation: Array, left: Sequence[Array]
) -> tuple[Array, Array]:
    """Return per joint the residual's rms and the noise estimated from it [Nm].

    The degrees of freedom that the fit takes from a joint are the trace of its part of the hat matrix U U^T.
    """
    rms, sigma = np.empty(len(information)), np.empty(len(information))
    for i, (piece, rows) in enumerate(zip(information, left, strict=True)):
        misfit = (system.blocks[i] @ deviation - system.targets[i]) / system.weights[i]
        total = float(misfit @ misfit) + piece.rest
        freedom = piece.samples - float(np.sum(rows**2))
        if freedom < 1.0:
            raise DataError(
                f"joint {i} has {piece.samples} samples for {piece.samples - freedom:.1f} parameters; "
                "nothing is left to tell the noise from"
            )
        rms[i], sigma[i] = np.sqrt(total / piece.samples), np.sqrt(total / freedom)
    return rms, sigma


def _fit(
    information: Sequence[JointInformation],
    system: _System,
    spectrum: _Spectrum,
    kept: NDArray[np.bool_],
    independent_fraction: float,
) -> InertialFit:
    values, directions = spectrum.values, spectrum.directions
    inverse = _inverse(spectrum, kept)
    deviation = inverse @ spectrum.along[kept]
    left = [block @ inverse for block in system.blocks]
    rms, sigma = _residual(information, system, deviation, left)
    covariance_kg = (
        inverse @ _left_covariance(left, sigma * system.weights) @ inverse.T / independent_fraction
    )
    within = directions[:, kept] @ directions[:, kept].T
    share = np.diagonal(within)
    fit = InertialFit(
        phi=system.prior + system.scale * deviation,
        rank=int(kept.sum()),
        unidentifiable_count=int(values.size - kept.sum()),
        singular_values=values,
        condition=float(values[0] / values[kept][-1]) if kept.any() else float("inf"),
        covariance=system.scale[:, None] * covariance_kg * system.scale,
        projector=system.scale[:, None] * within / system.scale,
        identifiable=share > 1.0 - SHARE_TOLERANCE,
        without_effect=share < SHARE_TOLERANCE,
        residual_rms_nm=rms,
        torque_sigma_nm=sigma,
        samples=np.array([piece.samples for piece in information], dtype=np.int64),
    )
    make_read_only(fit)
    return fit

"""Inertial parameters by instrumental variables: encoders as instruments for motion measured by IMUs.

The rows of a joint have the columns [Z | T | Y - Z]: Z the regressor from encoders alone, on a rigid chain;
T the further terms of its torque reading (`torque_terms`); Y the regressor of the motion with base,
compliance and IMUs (`body_tracks`). The parameters solve

    Z^T (tau - Y phi - T theta) = 0,

instrumental variables with the instruments Z (Young 2011, Recursive estimation and time-series analysis,
section 6.2): the noise of IMUs in Y does not bias the inertias towards zero, and parameters that a rigid
robot does not determine are not fitted to noise. These come from the prior; a shaking base makes a little
torque of them. The solver alternates: with phi known, the torque of Y - Z is subtracted.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from coordinator.dynamics.pseudo_inertia import parameter_scale
from coordinator.parameter_fit.least_squares import InertialFit, solve_information, solve_weighted
from coordinator.parameter_fit.significance import SIGNIFICANT_F, f_statistic
from coordinator.parameter_fit.spectrum import (
    ESTIMATED_CHAIN_TOLERANCE,
    MAX_SIGMA_KG,
    RANK_TOLERANCE,
    without_range,
)
from coordinator.parameter_fit.torque_sensor_scale import TorqueScale, known_scale, refine_scale, scaled
from module_agent.model.chain import Array
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY
from module_agent.signals.torque_terms import READING_TERMS

# The torque of Y - Z is a few percent, and every round reduces the error to as much of it.
_ROUNDS, _SETTLED = 8, 1e-9
# A column with a smaller share outside the range of the bodies' columns is one of theirs.
_ALIKE = 1e-6
_MIN_NM = 1e-9


class TermsFit(NamedTuple):
    """The parameters of `READING_TERMS` of n joints, (n, 4) each; zero where a term is not significant.

    sigma: one standard deviation. gain: the F statistic of a term, whether it is used or not. used: the
    significant terms. spread: the standard deviation of a term by its joint alone, infinite if the joint does
    not determine it; a term that is not used may exist within it.
    """

    value: Array
    sigma: Array
    gain: Array
    used: NDArray[np.bool_]
    spread: Array


class InstrumentalFit(NamedTuple):
    """Inertial parameters, and the further terms of the torque readings.

    information: of every joint without terms and the torque of Y - Z, in the 10 n columns of the bodies, its
    torques corrected by the estimated scale. scale: of the sensors. informed_phi: (10 n,) the parameters with
    the prior where torques do not determine them.
    """

    fit: InertialFit
    terms: TermsFit
    scale: TorqueScale
    informed_phi: Array
    information: tuple[JointInformation, ...]


def solve_instrumental_variables(
    information: Sequence[JointInformation],
    prior_phi: Array,
    independent_fraction: float,
    scale_sigma: float = 0.0,
) -> InstrumentalFit:
    """Fit inertial parameters and terms to the rows of n joints.

    Args:
        information: per joint, in the columns [Z | T], or [Z | T | Y - Z].
        prior_phi: (10 n,) the prior, which counts where Z determines nothing.
        independent_fraction: independent samples per sample, below 1 after a low-pass.
        scale_sigma: standard deviation of the prior of the torque sensors' scales; zero if calibrated.

    Raises:
        ValueError: columns that are neither, or as `solve_information`.
    """
    size = PER_BODY * len(information)
    widths = {piece.r.shape[1] for piece in information}
    with_departure = widths == {2 * size + len(READING_TERMS)}
    if not with_departure and widths != {size + len(READING_TERMS)}:
        raise ValueError(f"rows of {sorted(widths)} columns are no rows of {len(information)} joints")
    phi = np.asarray(prior_phi, dtype=float)
    scale = known_scale(len(information))
    for _ in range(_ROUNDS if with_departure or scale_sigma else 1):
        true = [scaled(piece, one) for piece, one in zip(information, scale.value, strict=True)]
        rigid = [_without_departure(piece, size, phi) for piece in true]
        tests = [_significance(piece, prior_phi, independent_fraction) for piece in rigid]
        left = tuple(without_used(piece, size, one.used) for piece, one in zip(rigid, tests, strict=True))
        fit = solve_weighted(left, independent_fraction, ESTIMATED_CHAIN_TOLERANCE)
        sigma = np.maximum(fit.torque_sigma_nm, 1e-3 * max(float(fit.torque_sigma_nm.max()), _MIN_NM))
        informed = solve_information(
            left,
            1.0 / sigma,
            prior_phi,
            independent_fraction=independent_fraction,
            tolerance=ESTIMATED_CHAIN_TOLERANCE,
        )
        moved = np.abs((informed.phi - phi) / parameter_scale(len(information))).max()
        phi, before = informed.phi, scale
        if scale_sigma:
            scale = refine_scale(left, fit, sigma, scale_sigma, scale, independent_fraction)
        if max(moved, np.abs(scale.value - before.value).max()) < _SETTLED:
            break
    return InstrumentalFit(fit, _terms(rigid, tests, fit, independent_fraction), scale, phi, left)


class _Significance(NamedTuple):
    """Of each term of a joint, (4,) each: see `TermsFit`."""

    gain: Array
    used: NDArray[np.bool_]
    spread: Array


def _without_departure(piece: JointInformation, size: int, phi: Array) -> JointInformation:
    """Return the rows in [Z | T], with the torque of Y - Z taken off."""
    count = size + len(READING_TERMS)
    if piece.r.shape[1] == count:
        return piece
    return piece._replace(r=piece.r[:, :count], z=piece.z - piece.r[:, count:] @ phi)


def _significance(piece: JointInformation, prior_phi: Array, independent_fraction: float) -> _Significance:
    """Remove the weakest term until all are significant, with the bodies fitted as well as is likely.

    An axis that is all but parallel to gravity shows the bodies' moments of mass by the angle between them:
    moments of many kilogrammes would explain any offset, but no fit believes them. So all parameters are
    normally distributed about the prior here, by `MAX_SIGMA_KG`. Which terms are tested, their spread and the
    noise are by the torques alone: a term that these do not determine would be a load that is not known.
    """
    size = len(prior_phi)
    bodies = piece.r[:, :size] * parameter_scale(size // PER_BODY)
    terms, torques = piece.r[:, size:], piece.z - piece.r[:, :size] @ prior_phi
    (columns, target), rank = without_range(bodies, RANK_TOLERANCE, (terms, torques))
    independent = max(piece.samples - rank - len(READING_TERMS), 1) * independent_fraction

    def variance(misfit: Array) -> float:
        return (float(misfit @ misfit) + piece.rest) / independent

    determined = np.linalg.norm(columns, axis=0) > _ALIKE * np.linalg.norm(terms, axis=0)
    _, _, spread = _significant(columns, target, determined, variance)
    noise = max(variance(target - columns @ (np.linalg.pinv(columns) @ target)), _MIN_NM**2)
    (columns, target), _ = without_range(
        np.vstack([bodies, np.sqrt(noise) / MAX_SIGMA_KG * np.eye(size)]),
        RANK_TOLERANCE,
        (np.vstack([terms, np.zeros((size, len(READING_TERMS)))]), np.append(torques, np.zeros(size))),
    )
    gain, used, _ = _significant(columns, target, determined, lambda _: noise)
    return _Significance(gain, used, spread)


def _significant(
    columns: Array, target: Array, tested: NDArray[np.bool_], variance: Callable[[Array], float]
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Remove the weakest of the tested terms until all are significant.

    Args:
        columns, target: (k, 4) of the terms, (k,) the torques, without what the bodies explain of them.
        tested: (4,) the terms that the torques determine.
        variance: of the noise, for what a fit leaves of the target.

    Returns:
        gains, the terms that stay, and the standard deviations, infinite where a term was not tested.
    """
    gain, spread = np.zeros(len(READING_TERMS)), np.full(len(READING_TERMS), np.inf)
    used = tested.copy()
    while used.any():
        inverse = np.linalg.pinv(columns[:, used])
        value = inverse @ target
        variances = np.sum(inverse**2, axis=1) * variance(target - columns[:, used] @ value)
        spread[used] = np.maximum(np.sqrt(variances), _MIN_NM)
        gain[used] = f_statistic(value, spread[used])
        weakest = np.flatnonzero(used)[np.argmin(gain[used])]
        if gain[weakest] > SIGNIFICANT_F:
            break
        used[weakest] = False
    return gain, used, spread


def without_used(piece: JointInformation, size: int, used: NDArray[np.bool_]) -> JointInformation:
    """Return rows in [Z | T | any others] without T: the information that does not depend on the used terms.

    Args:
        size: of Z, 10 n. used: (4,) which of `READING_TERMS` are; the others are left out.
    """
    others = np.delete(piece.r, np.s_[size : size + len(READING_TERMS)], axis=1)
    terms = piece.r[:, size : size + len(READING_TERMS)][:, used]
    count = terms.shape[1]
    if not count:
        return piece._replace(r=others)
    rows = qr(np.column_stack([terms, others, piece.z]), mode="r", check_finite=False)[0]
    return piece._replace(r=rows[count:, count:-1], z=rows[count:, -1], samples=piece.samples - count)


def _terms(
    rigid: Sequence[JointInformation],
    tests: Sequence[_Significance],
    fit: InertialFit,
    independent_fraction: float,
) -> TermsFit:
    """Return the terms of every joint with the fitted bodies subtracted."""
    size = len(fit.phi)
    value, sigma = np.zeros((2, len(rigid), len(READING_TERMS)))
    for i, (piece, one) in enumerate(zip(rigid, tests, strict=True)):
        inverse = np.linalg.pinv(piece.r[:, size:][:, one.used])
        bodies = piece.r[:, :size]
        value[i, one.used] = inverse @ (piece.z - bodies @ fit.phi)
        through = inverse @ bodies
        noise = fit.torque_sigma_nm[i] ** 2 / independent_fraction * (inverse @ inverse.T)
        sigma[i, one.used] = np.sqrt(np.diagonal(noise + through @ fit.covariance @ through.T))
    gain, used, spread = (np.array([one[k] for one in tests]) for k in range(3))
    make_read_only((value, sigma, gain, used, spread))
    return TermsFit(value, sigma, gain, used, spread)

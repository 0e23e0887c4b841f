"""Inertial parameters where bodies were seen to move, and readings hold more than the bodies' torque.

The rows of a joint have the columns [Z | T | Y - Z]: Z the regressor from encoders alone, on a rigid chain;
T what its reading holds beside the bodies' torque (`torque_terms`); Y the regressor of the motion as it was
seen (`body_tracks`). The parameters solve

    Z^T (tau - Y phi - T theta) = 0,

instrumental variables with Z for instruments (Young 2011, Recursive estimation and time-series analysis,
section 6.2): the noise of IMUs in Y does not make inertias come out small, and parameters that a rigid robot
does not show are not taken from noise. They come from what is known of modules beforehand: a base that shakes
makes a little torque of them. It is solved by turns: with phi known, the torque of Y - Z is taken off.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from coordinator.dynamics.pseudo_inertia import parameter_scale
from coordinator.parameter_fit.least_squares import InertialFit, solve_information, solve_weighted
from coordinator.parameter_fit.significance import SIGNIFICANT_F, f_statistic
from coordinator.parameter_fit.spectrum import ESTIMATED_CHAIN_TOLERANCE, RANK_TOLERANCE, without_range
from coordinator.parameter_fit.torque_sensor_scale import TorqueScale, known_scale, refine_scale, scaled
from module_agent.model.chain import Array
from module_agent.model.information import JointInformation
from module_agent.model.read_only import make_read_only
from module_agent.model.regressor import PER_BODY
from module_agent.signals.torque_terms import READING_TERMS

# The torque of Y - Z is a few percent: every round leaves as much of the error.
_ROUNDS, _SETTLED = 8, 1e-9
# A column that keeps less of its length beside the bodies' is one of theirs.
_ALIKE = 1e-6
_MIN_NM = 1e-9


class TermsFit(NamedTuple):
    """The parameters of `READING_TERMS` of n joints, (n, 4) each; zero where a term does not earn its place.

    sigma: one standard deviation. gain: by how many variances of the torque's noise a term makes the misfit
    of its joint smaller, whether it is used or not. spread: the standard deviation to which the joint by
    itself tells a term, infinite if it does not: one that is not used may be there, but not by much more.
    """

    value: Array
    sigma: Array
    gain: Array
    used: NDArray[np.bool_]
    spread: Array


class InstrumentalFit(NamedTuple):
    """Inertial parameters, and what else was in the readings.

    information: what is left of every joint when terms and the torque of Y - Z are taken off, in the 10 n
    columns of the bodies, its torques in their true scale as far as it is known. scale: of the sensors.
    informed_phi: (10 n,) the parameters where torques tell them, and else those that are likely.
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
        prior_phi: (10 n,) bodies as they are likely to be; they count where Z shows nothing.
        independent_fraction: independent samples per sample, below 1 after a low-pass.
        scale_sigma: how well the torque sensors' scales are known beforehand; zero means exactly.

    Raises:
        ValueError: columns that are neither, or as `solve_information`.
    """
    size = PER_BODY * len(information)
    widths = {piece.r.shape[1] for piece in information}
    seen = widths == {2 * size + len(READING_TERMS)}
    if not seen and widths != {size + len(READING_TERMS)}:
        raise ValueError(f"rows of {sorted(widths)} columns are no rows of {len(information)} joints")
    phi = np.asarray(prior_phi, dtype=float)
    scale = known_scale(len(information))
    for _ in range(_ROUNDS if seen or scale_sigma else 1):
        true = [scaled(piece, one) for piece, one in zip(information, scale.value, strict=True)]
        rigid = [_without_departure(piece, size, phi) for piece in true]
        earned = [_earned(piece, size, independent_fraction) for piece in rigid]
        left = tuple(without_used(piece, size, one.used) for piece, one in zip(rigid, earned, strict=True))
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
            scale = refine_scale(
                information=left,
                phi=fit.phi,
                noise_nm=sigma,
                prior_sigma=scale_sigma,
                so_far=scale,
                independent_fraction=independent_fraction,
                tolerance=ESTIMATED_CHAIN_TOLERANCE,
            )
        if max(moved, np.abs(scale.value - before.value).max()) < _SETTLED:
            break
    return InstrumentalFit(fit, _terms(rigid, earned, fit, independent_fraction), scale, phi, left)


class _Earned(NamedTuple):
    """Of each term of a joint, (4,) each: see `TermsFit`."""

    gain: Array
    used: NDArray[np.bool_]
    spread: Array


def _without_departure(piece: JointInformation, size: int, phi: Array) -> JointInformation:
    """Return the rows in [Z | T], with the torque of Y - Z taken off."""
    kept = size + len(READING_TERMS)
    if piece.r.shape[1] == kept:
        return piece
    return piece._replace(r=piece.r[:, :kept], z=piece.z - piece.r[:, kept:] @ phi)


def _earned(piece: JointInformation, size: int, independent_fraction: float) -> _Earned:
    """Drop the weakest term until all that are left earn their place; bodies explain what they can."""
    bodies = piece.r[:, :size] * parameter_scale(size // PER_BODY)
    terms = piece.r[:, size:]
    (columns, target), rank = without_range(bodies, RANK_TOLERANCE, (terms, piece.z))
    gain, spread = np.zeros(len(READING_TERMS)), np.full(len(READING_TERMS), np.inf)
    used = np.linalg.norm(columns, axis=0) > _ALIKE * np.linalg.norm(terms, axis=0)
    freedom = max(piece.samples - rank - len(READING_TERMS), 1)
    while used.any():
        inverse = np.linalg.pinv(columns[:, used])
        value = inverse @ target
        misfit = target - columns[:, used] @ value
        variance = (float(misfit @ misfit) + piece.rest) / freedom / independent_fraction
        spread[used] = np.maximum(np.sqrt(np.sum(inverse**2, axis=1) * variance), _MIN_NM)
        gain[used] = f_statistic(value, spread[used])
        weakest = np.flatnonzero(used)[np.argmin(gain[used])]
        if gain[weakest] > SIGNIFICANT_F:
            break
        used[weakest] = False
    return _Earned(gain, used, spread)


def without_used(piece: JointInformation, size: int, used: NDArray[np.bool_]) -> JointInformation:
    """Return rows in [Z | T | any others] without T: what they say whatever the terms in use are.

    Args:
        size: of Z, 10 n. used: (4,) which of `READING_TERMS` are; the others are left out.
    """
    kept = np.delete(piece.r, np.s_[size : size + len(READING_TERMS)], axis=1)
    terms = piece.r[:, size : size + len(READING_TERMS)][:, used]
    count = terms.shape[1]
    if not count:
        return piece._replace(r=kept)
    rows = qr(np.column_stack([terms, kept, piece.z]), mode="r", check_finite=False)[0]
    return piece._replace(r=rows[count:, count:-1], z=rows[count:, -1], samples=piece.samples - count)


def _terms(
    rigid: Sequence[JointInformation],
    earned: Sequence[_Earned],
    fit: InertialFit,
    independent_fraction: float,
) -> TermsFit:
    """Return the terms that the rows of every joint leave once the bodies are known."""
    size = len(fit.phi)
    value, sigma = np.zeros((len(rigid), len(READING_TERMS))), np.zeros((len(rigid), len(READING_TERMS)))
    for i, (piece, one) in enumerate(zip(rigid, earned, strict=True)):
        inverse = np.linalg.pinv(piece.r[:, size:][:, one.used])
        bodies = piece.r[:, :size]
        value[i, one.used] = inverse @ (piece.z - bodies @ fit.phi)
        through = inverse @ bodies
        noise = fit.torque_sigma_nm[i] ** 2 / independent_fraction * (inverse @ inverse.T)
        sigma[i, one.used] = np.sqrt(np.diagonal(noise + through @ fit.covariance @ through.T))
    gain, used, spread = (np.array([one[k] for one in earned]) for k in range(3))
    make_read_only((value, sigma, gain, used, spread))
    return TermsFit(value, sigma, gain, used, spread)

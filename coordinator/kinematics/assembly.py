"""Assemble the chain from observations of every joint by the modules beyond it, and of gravity.

Unknown are the poses of all housings at q = 0, relative to the first root's, and the direction of gravity; a
module's own axis follows from its housing by the catalogue. The observations of all pairs are fitted
together, so that a distal module that observes a joint far up adds what the modules between do not resolve.
Unresolved directions are named and keep their neutral values: the fit steps only along resolved ones.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.chain_observations import (
    ChainObservations,
    PairObservation,
    RestObservation,
    jacobian,
    pack,
    predict,
    residuals,
)
from coordinator.kinematics.initial_guess import initial_chain
from coordinator.topology.topology import Topology
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.perturbation import apply_perturbation, skew
from module_agent.model.read_only import frozen

# A direction counts as resolved if its one sigma is below this (rad or m). A parallel pair of axes is never
# parallel to the last digit: the noise of the axes would "resolve" the offset along them to half a metre.
RESOLVED_BELOW = 0.25
STEPS = 60
HALVINGS = 12
STILL = 1e-13
# Huber's weights: residuals beyond so many sigmas count less; the rounds of weights, which need not converge,
# as the batch refinement goes on from there.
HUBER, ROBUST_ROUNDS, ROBUST_GAIN = 3.0, 5, 1e-3


class ChainFit(NamedTuple):
    """An assembled chain: the rank counts 6 (n - 1) unknowns of poses and two of the direction of gravity.

    reduced_chi2: weighted squared residuals over degrees of freedom; about 1 if the sigmas are right, NaN
        without a degree of freedom.
    """

    estimate: ChainEstimate
    reduced_chi2: float

    @property
    def chain(self) -> Chain:
        """The estimated chain."""
        return self.estimate.chain


class AssemblyError(DataError):
    """The observations contradict each other beyond any noise; the message names the worst pair."""


def assemble(
    topology: Topology,
    types: Sequence[ModuleType],
    pairs: Sequence[PairObservation],
    rests: Sequence[RestObservation],
    min_gain: float = 0.0,
) -> ChainFit:
    """Fit the chain; `types` are those of the modules in the order of the topology.

    The iteration ends with a step that lowers the weighted squares by less than the share `min_gain`: a
    preview of a robot need not converge to the last digit.

    The steps are those of Gauss and Newton in the resolved directions only (least squares of least norm by a
    truncated SVD), so that unresolved directions stay where the neutral first guess has put them.

    Raises:
        DataError: no rest observation.
        ValueError: unknown serials or wrong shapes.
        AssemblyError: an axis comes out opposite to what was observed.
    """
    if len(types) != len(topology.serials):
        raise ValueError(f"{len(types)} module types for {len(topology.serials)} modules")
    observations = pack(topology.serials, pairs, rests)
    size = float(np.mean([np.linalg.norm(r.specific_force_m_s2, axis=1).mean() for r in rests]))
    begin = initial_chain(topology, types, observations, size)
    chain = _refine(begin, observations, min_gain)
    if _directions(chain, observations).min(initial=1.0) <= 0.0:
        chain = _refine_robustly(begin, observations, min_gain)
    _check_directions(chain, observations)
    return _describe(chain, observations)


class _Solved(NamedTuple):
    """The weighted Jacobian over the unknowns taken apart, J = u s v^T; the first `rank` are resolved."""

    u: Array
    s: Array
    vt: Array
    rank: int


def _solve(chain: Chain, observations: ChainObservations) -> _Solved:
    slopes = jacobian(chain, observations)
    width = 6 * len(chain.serials)
    # The first root is the frame, and turning gravity about itself does nothing: neither is an unknown.
    slopes = np.concatenate([slopes[:, 6:width], slopes[:, width:] @ _level(chain)], axis=1)
    if slopes.shape[0] < slopes.shape[1]:
        slopes = np.concatenate([slopes, np.zeros((slopes.shape[1] - slopes.shape[0], slopes.shape[1]))])
    u, s, vt = np.linalg.svd(slopes, full_matrices=False)
    return _Solved(u[: observations.rows], s, vt, int(np.count_nonzero(s > 1.0 / RESOLVED_BELOW)))


def _level(chain: Chain) -> Array:
    """Return (3, 2) axes across gravity about which it can tilt."""
    _, _, vt = np.linalg.svd(chain.gravity[None, :])
    return np.asarray(vt[1:].T)


def _refine(chain: Chain, observations: ChainObservations, min_gain: float) -> Chain:
    rest = residuals(chain, observations)
    for _ in range(STEPS):
        parts = _solve(chain, observations)
        keep = slice(parts.rank)
        step = -parts.vt[keep].T @ ((parts.u[:, keep].T @ rest) / parts.s[keep])
        before = float(rest @ rest)
        # The longest of the halved steps that lowers the cost.
        moved = (_stepped(chain, 0.5**halving * step) for halving in range(HALVINGS))
        trials = ((trial, residuals(trial, observations)) for trial in moved)
        better = next((one for one in trials if float(one[1] @ one[1]) < before), None)
        if better is None:
            return chain
        chain, rest = better
        gain = 1.0 - float(rest @ rest) / before
        if np.abs(step).max() < STILL or gain < min_gain:
            return chain
    return chain


def _refine_robustly(chain: Chain, observations: ChainObservations, min_gain: float) -> Chain:
    """Refine where observations contradict each other by more than their sigmas, as those through many joints
    with play do: by iteratively reweighted least squares with Huber's weights (Huber 1964, Ann. Math. Stat.
    35, 73), an observation's axis and place each by its own residual.
    """
    pairs = observations.joint.size
    for _ in range(ROBUST_ROUNDS):
        axis, place = residuals(chain, observations)[: 4 * pairs].reshape(2, pairs, 2)
        wider = (np.sqrt(np.maximum(np.linalg.norm(part, axis=1) / HUBER, 1.0)) for part in (axis, place))
        by_axis, by_place = wider
        weighted = observations._replace(
            sigma_axis_rad=observations.sigma_axis_rad * by_axis,
            sigma_radial_m=observations.sigma_radial_m * by_place,
        )
        chain = _refine(chain, weighted, max(min_gain, ROBUST_GAIN))
    return chain


def _stepped(chain: Chain, step: Array) -> Chain:
    tilt = skew(_level(chain) @ step[-2:])
    moved = apply_perturbation(chain, np.concatenate([np.zeros(6), step[:-2]]))
    gravity = chain.gravity + tilt @ chain.gravity
    gravity *= np.linalg.norm(chain.gravity) / np.linalg.norm(gravity)
    return moved._replace(gravity=frozen(gravity))


def _check_directions(chain: Chain, observations: ChainObservations) -> None:
    """Raise an AssemblyError if an axis points the other way; the residuals, being sines, do not show it."""
    along = _directions(chain, observations)
    if along.size and along.min() <= 0.0:
        worst = int(np.argmin(along))
        joint, observer = (chain.serials[of[worst]] for of in (observations.joint, observations.observer))
        raise AssemblyError(
            f"{observer} saw the axis of joint {joint} {np.degrees(np.arccos(along[worst])):.0f} degrees "
            f"away from where the fit puts it: what {observer} saw of the joints further up does not fit one "
            "robot. Check the encoders' signs, the topology, and whether its IMU was exchanged with another's"
        )


def _directions(chain: Chain, observations: ChainObservations) -> Array:
    """Return the cosines between the axes that the chain predicts and those that were observed."""
    return np.asarray(np.sum(predict(chain, observations).axis * observations.axis, axis=1))


def _describe(chain: Chain, observations: ChainObservations) -> ChainFit:
    parts = _solve(chain, observations)
    rest = residuals(chain, observations)
    poses = 6 * (len(chain.serials) - 1)
    resolved = parts.vt[: parts.rank, :poses] / parts.s[: parts.rank, None]
    covariance = np.zeros((poses + 6, poses + 6))
    covariance[6:, 6:] = resolved.T @ resolved
    basis, _ = np.linalg.qr(parts.vt[parts.rank :, :poses].T)
    null_basis = frozen(np.concatenate([np.zeros((6, basis.shape[1])), basis]))
    freedom = observations.rows - parts.rank
    condition = float(parts.s[0] / parts.s[parts.rank - 1]) if parts.rank else float("nan")
    estimate = ChainEstimate(chain, frozen(covariance), null_basis, parts.rank, condition)
    return ChainFit(estimate, float(rest @ rest) / freedom if freedom > 0 else float("nan"))

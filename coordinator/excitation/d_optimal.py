"""D-optimal motions for the inertial parameters, chosen among random ones within the robot's limits.

The regressor gives the information of each candidate about the base parameters. Those are chosen, one after
another and then in exchange for one another, whose information together has the largest determinant (Fedorov
1972; Swevers et al., Optimal robot excitation and identification, 1997, for sines as candidates).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from coordinator.dynamics.pseudo_inertia import parameter_scale
from coordinator.excitation.joint_limits import JointLimits, NoExcitation
from coordinator.excitation.segment import SampledMotion, Segment, draw_segment, sampled, smaller, way
from coordinator.excitation.self_collision import CLEARANCE_M, clearance_m
from coordinator.parameter_fit.spectrum import MAX_SIGMA_KG
from module_agent.model.chain import Array, Chain
from module_agent.model.regressor import gram_matrix, inverse_dynamics

CANDIDATES = 150
# Faster than the sines by ten: each period of the fastest is seen in a dozen samples.
RATE_HZ = 20.0
# Share of the largest eigenvalue: rounding in a sum of squares is 1e-16 of it, the weakest that a motion
# excites 1e-10.
BASE_TOLERANCE = 1e-13
# Passes of exchanging each chosen motion for a better one; it settles in two or three.
MAX_PASSES = 6
# A motion that goes too far is tried again smaller, about a pose nearer to home.
SHRINK = (1.0, 0.7, 0.5, 0.35)
# Share of a joint's maximum torque: the inertia, not identified yet, may be larger than the prior.
TORQUE_SHARE = 0.6
# What refuses a motion.
OWN_LINKS, TORQUES, WORKSPACE = "the robot's own links", "the motors' torques", "the workspace"


class ExcitationTask(NamedTuple):
    """The robot to be excited, and the limits; arrays (n,) in the order of the chain.

    phi: (10 n,) likely bodies; they keep the torques within the motors' limits and are no prior of the
        information. reach_rad: how far from home any joint may go. max_effort_nm: of the motors.
    torque_sigma_nm: noise of a torque reading. travel_speed_rad_s: of the ways from home to the poses.
    allowed: whether the robot may be at positions (m, n); None if it may be anywhere.
    """

    chain: Chain
    phi: Array
    limits: tuple[JointLimits, ...]
    max_effort_nm: Array
    torque_sigma_nm: Array
    home_rad: Array
    reach_rad: float
    segments: int
    segment_s: float
    travel_speed_rad_s: float = 1.0
    allowed: Callable[[Array], bool] | None = None


class Excitation(NamedTuple):
    """The chosen motions in the order in which they were chosen, and their information.

    rank: number of base parameters that any candidate excites. log_det: of the information of those, per
    kg^-2.
    """

    segments: tuple[Segment, ...]
    rank: int
    log_det: float


def design_excitation(
    task: ExcitationTask, rng: np.random.Generator, candidates: int = CANDIDATES
) -> Excitation:
    """Choose motions.

    Raises:
        NoExcitation: fewer candidates than needed stay within the limits, or a joint has no room at all.
    """
    kept: list[Segment] = []
    pieces: list[Array] = []
    reasons = dict.fromkeys((OWN_LINKS, TORQUES, WORKSPACE), 0)
    for _ in range(candidates):
        segment = draw_possible(task, rng)
        if isinstance(segment, Segment):
            kept.append(segment)
            pieces.append(information(task, sampled(segment, RATE_HZ)))
        else:
            reasons[segment] += 1
    if len(kept) < task.segments:
        worst = max(reasons, key=lambda reason: reasons[reason])
        raise NoExcitation(
            f"{len(kept)} of {candidates} motions within {task.reach_rad:.2f} rad of home are possible, "
            f"{task.segments} are needed; most were refused for {worst}: begin elsewhere, or reach less far"
        )
    # The directions that all candidates together excite.
    values, vectors = np.linalg.eigh(np.sum(pieces, axis=0))
    base = vectors[:, values > BASE_TOLERANCE * values[-1]]
    within = np.array([base.T @ piece @ base for piece in pieces])
    chosen = _exchanged(within, _greedy(within, task.segments))
    log_det = float(np.linalg.slogdet(within[chosen].sum(axis=0))[1])
    return Excitation(tuple(kept[k] for k in chosen), base.shape[1], log_det)


def draw_possible(task: ExcitationTask, rng: np.random.Generator) -> Segment | str:
    """Draw one motion within the limits, made smaller if necessary, or return the limit that refuses it.

    Raises:
        NoExcitation: a joint has no room at all.
    """
    drawn = draw_segment(rng, task.limits, task.home_rad, task.reach_rad, task.segment_s)
    for share in SHRINK:
        segment = smaller(drawn, task.home_rad, share)
        reason = _reason_against(task, segment)
        if not reason:
            return segment
    return reason


def information(task: ExcitationTask, motion: SampledMotion) -> Array:
    """Return Y^T W Y (10 n, 10 n) of a motion, parameters in kg (see `pseudo_inertia.parameter_scale`)."""
    scale = parameter_scale(len(task.limits))
    weights = task.torque_sigma_nm**-2.0
    gram = gram_matrix(task.chain, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2, weights)
    return np.asarray(scale[:, None] * gram * scale)


def _reason_against(task: ExcitationTask, segment: Segment) -> str:
    motion = sampled(segment, RATE_HZ)
    torque = inverse_dynamics(task.chain, task.phi, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2)
    if (np.abs(torque) > TORQUE_SHARE * task.max_effort_nm).any():
        return TORQUES
    # The way back is another: short journeys end first on both.
    ends = task.home_rad, segment.pose_rad
    ways = [way(*pair, task.travel_speed_rad_s, RATE_HZ) for pair in (ends, ends[::-1])]
    positions = np.vstack([motion.q_rad, *ways])
    if clearance_m(task.chain, positions, task.home_rad).min() < CLEARANCE_M:
        return OWN_LINKS
    return "" if task.allowed is None or task.allowed(positions) else WORKSPACE


def _log_det(total: Array) -> float:
    """Return the log determinant of the information with a prior of `MAX_SIGMA_KG`."""
    return float(np.linalg.slogdet(total + np.eye(len(total)) / MAX_SIGMA_KG**2)[1])


def _greedy(within: Array, count: int) -> list[int]:
    chosen: list[int] = []
    total = np.zeros(within.shape[1:])
    for _ in range(count):
        left = [k for k in range(len(within)) if k not in chosen]
        chosen.append(max(left, key=lambda k: _log_det(total + within[k])))
        total = total + within[chosen[-1]]
    return chosen


def _exchanged(within: Array, chosen: Sequence[int]) -> list[int]:
    """Replace each motion by the one that complements the others best, until no exchange improves."""
    order = list(chosen)
    for _ in range(MAX_PASSES):
        before = list(order)
        for place in range(len(order)):
            others = within[order[:place] + order[place + 1 :]].sum(axis=0)
            free = [k for k in range(len(within)) if k not in order or k == order[place]]
            order[place] = max(free, key=lambda k: _log_det(others + within[k]))
        if order == before:
            break
    return order

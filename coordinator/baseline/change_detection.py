"""Detection of changed links between two sessions of one robot, with size and significance.

Both sessions are fitted with the same scale and misalignment of the IMUs, which change over years, not
between two sessions: their errors cancel in the difference of the two chains. So do other model errors, if
the motions are the same. Biases drift, and are free in each session.

The perturbations from the former chain to the later one, d ~ N(D x, C), are compared under hypotheses; C is
that of the sensors' noise alone, since model errors are common to both sessions, and of the floors
below. A link that changes by a twist displaces everything beyond it by that same twist, so that "link k
changed" has six parameters, and "nothing changed" none. The gain in chi^2 of the best six is
chi^2-distributed with as many degrees of freedom as directions of the six are observable (Wilks, 1938); the
probability of as large a gain by chance is multiplied by the number of links tested (Bonferroni). Links are
added one by one, the one that explains most first, until the residual is insignificant.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from coordinator.baseline.baseline_robot import BaselineRobot
from coordinator.batch_estimation.estimator import UNKNOWN_ABOVE, Refinement, refine_chain, with_placement
from coordinator.batch_estimation.imu_intrinsics import ImuIntrinsics, undone
from coordinator.identification.robot_refinement import KEEP_EVERY, MAX_IMU_SAMPLES
from coordinator.recording.journal import Purpose
from coordinator.synchronisation.motion_windows import Window, filtered, thinned, unbroken_windows
from module_agent.model.chain import Array, Chain
from module_agent.model.imu_prior import UNCALIBRATED
from module_agent.model.perturbation import adjoint, perturbation_between
from module_agent.model.read_only import frozen
from module_agent.signals.filtering import REFINEMENT_CUTOFF_HZ

# Prior of corrected IMUs: scale and misalignment are the same in both sessions.
TIED = UNCALIBRATED._replace(scale=1e-5, misalignment_rad=1e-5, place_m=0.0, mounting_rad=0.0)
MOVING: tuple[Purpose, ...] = ("constant", "windowed_sine", "whole")


class TiedFits(NamedTuple):
    """One robot's chain from a former session and from a later one, under the same errors of the IMUs."""

    before: Refinement
    after: Refinement


def tied_fits(known: BaselineRobot, later: BaselineRobot) -> TiedFits:
    """Fit the sessions of two runs of one robot, from the known chain, with the IMUs' errors found then.

    The later chain may differ from the known one by some 0.2 rad and 0.1 m; its modules must be the same.

    Raises:
        ValueError: a hole in a recording, or too few samples.
    """
    refinement = known.kinematics.refinement
    chain, imus = with_placement(known.chain, refinement.placement), refinement.intrinsics
    first, second = (_fit(chain, corrected(exploration(run, chain.serials), imus)) for run in (known, later))
    return TiedFits(first, second)


def exploration(run: BaselineRobot, serials: Sequence[str]) -> list[Window]:
    """Return the readings of all modules during the last exploration of every joint, ordered by `serials`."""
    moving = run.recording.motions(*MOVING)
    # All take part in a motion of the whole robot: it is one stretch of the recording.
    last = {("" if e.purpose == "whole" else e.serial, e.purpose): e for e in moving}
    events = [*last.values(), *run.recording.motions("repeat")]
    clocks = run.kinematics.clocks
    return [
        one
        for event in events
        for one in unbroken_windows(run.recording, clocks, serials, event, REFINEMENT_CUTOFF_HZ)
    ]


def corrected(windows: Sequence[Window], imus: ImuIntrinsics) -> list[Window]:
    """Return the readings as IMUs without errors of scale and axes would have given them, biases left in."""
    return [
        one._replace(
            gyro_rad_s=undone(imus.gyro_matrix, one.gyro_rad_s),
            accel_m_s2=undone(imus.accel_matrix, one.accel_m_s2),
        )
        for one in windows
    ]


def _fit(chain: Chain, windows: Sequence[Window]) -> Refinement:
    samples = sum(len(one.t_ns) for one in windows) * len(chain.serials)
    keep_every = max(KEEP_EVERY, -(-samples // MAX_IMU_SAMPLES))
    parts = [filtered(one, REFINEMENT_CUTOFF_HZ) for one in windows]
    return refine_chain(chain, thinned(parts, keep_every), TIED)


# Differences of an unchanged link between two sessions with different motions, by compliance and filters.
# Measured: up to 0.2 mm and 0.45 mrad where the sessions' motions have other lengths.
FLOOR_RAD, FLOOR_M = 3e-4, 1e-4
# Probability that a check of an unchanged robot reports a change.
FALSE_ALARMS = 1e-4


class LinkChange(NamedTuple):
    """How the IMU of one module is displaced against its parent, in the IMU's own frame at q = 0.

    rotation_rad, displacement_m: (3,), zero along what cannot be seen. covariance: (6, 6) of [rotation,
    displacement] over what can be seen. unseen: (k, 6) orthonormal directions of the same that cannot.
    gain: by how much the change lowers chi^2, which has `seen` degrees of freedom; of several links together
    the additional gain of each.
    """

    child: int
    rotation_rad: Array
    displacement_m: Array
    covariance: Array
    unseen: Array
    gain: float

    @property
    def seen(self) -> int:
        """The number of observable directions of the six."""
        return 6 - len(self.unseen)

    @property
    def chance(self) -> float:
        """The probability that chance alone gains as much for this one link."""
        return float(chdtrc(self.seen, max(self.gain, 0.0))) if self.seen else 1.0

    @property
    def length_m(self) -> float:
        """The length of the displacement."""
        return float(np.linalg.norm(self.displacement_m))

    @property
    def length_sigma_m(self) -> float:
        """The standard deviation of the length: along the displacement, or at worst where there is none."""
        spread = self.covariance[3:, 3:]
        if self.length_m < 1e-9:
            return float(np.sqrt(np.linalg.eigvalsh(spread).max()))
        along = self.displacement_m / self.length_m
        return float(np.sqrt(along @ spread @ along))


class Findings(NamedTuple):
    """Result of a comparison.

    changed: the links that changed, estimated with the rest unchanged, the most certain first.
    false_alarm: for each of these the probability that it is one, over all links. each: every link with
    all the others free to have changed as well. would_find_m: (n,) the smallest displacement of every
    link that would surely have been found, whatever its direction of those that can be seen; NaN for the
    root.
    """

    changed: tuple[LinkChange, ...]
    false_alarm: tuple[float, ...]
    each: tuple[LinkChange, ...]
    would_find_m: Array
    min_false_alarm: float


class _Problem(NamedTuple):
    """The differences that both sessions can see, whitened: columns (r, 6) of every link, and y (r,)."""

    slopes: dict[int, Array]
    y: Array


def find_changes(fits: TiedFits, false_alarms: float = FALSE_ALARMS) -> Findings:
    """Compare the chains of two sessions.

    Args:
        fits: both sessions' fits.
        false_alarms: the probability that a robot that has not changed is said to have, at most.
    """
    problem = _problem(fits)
    links = tuple(problem.slopes)
    changed: list[LinkChange] = []
    alarms: list[float] = []
    least = 1.0
    while len(changed) < len(links):
        best = _next(problem, [c.child for c in changed])
        alarm = min(1.0, best.chance * len(links))
        least = min(least, alarm)
        if alarm > false_alarms:
            break
        changed.append(best)
        alarms.append(alarm)
    found, _ = _explained(problem, [c.child for c in changed])
    limit = np.full(len(fits.before.chain.serials), np.nan)
    for child in links:
        limit[child] = _would_find(_explained(problem, [child])[0][0], false_alarms / len(links))
    each, _ = _explained(problem, links)
    return Findings(tuple(found), tuple(alarms), tuple(each), frozen(limit), least)


def _problem(fits: TiedFits) -> _Problem:
    chain = fits.before.chain
    slopes = {child: _slope(chain, child) for child in range(1, len(chain.serials))}
    kept = _visible(fits)
    own = np.diag(np.repeat([FLOOR_RAD, FLOOR_M], 3) ** 2)
    covariance = fits.before.noise_covariance[6:, 6:] + fits.after.noise_covariance[6:, 6:]
    covariance = covariance + sum(slope @ own @ slope.T for slope in slopes.values())
    white = np.linalg.inv(np.linalg.cholesky(kept.T @ covariance @ kept)) @ kept.T
    difference = perturbation_between(chain, fits.after.chain)[6:]
    return _Problem({child: white @ slope for child, slope in slopes.items()}, white @ difference)


def _slope(chain: Chain, child: int) -> Array:
    """Return the increments (6 (n - 1), 6) of all but the root by one link's change in its IMU's frame."""
    found = np.zeros((6 * len(chain.serials), 6))
    for module in chain.descendants(child):
        found[6 * module : 6 * module + 6] = adjoint(chain.imu_home[child])
    return found[6:]


def _visible(fits: TiedFits) -> Array:
    """Return orthonormal increments (6 (n - 1), r), as columns, that both sessions know."""
    unknown = np.hstack([fit.estimate.null_basis[6:] for fit in fits])
    full, sizes, _ = np.linalg.svd(np.column_stack([unknown, np.zeros(len(unknown))]))
    return np.asarray(full[:, np.count_nonzero(sizes > 1e-6) :])


def _next(problem: _Problem, taken: Sequence[int]) -> LinkChange:
    """Return the link that explains most of what those taken leave."""
    _, before = _explained(problem, taken)
    candidates = []
    for child in problem.slopes:
        if child not in taken:
            (first, *_), gain = _explained(problem, [child, *taken])
            candidates.append(first._replace(gain=gain - before))
    return min(candidates, key=lambda c: (c.chance, -c.gain))


def _explained(problem: _Problem, children: Sequence[int]) -> tuple[list[LinkChange], float]:
    """Return the changes of some links that explain the differences best, and by how much they lower chi^2.

    What cannot be seen is left at zero.
    """
    if not children:
        return [], 0.0
    slopes = np.concatenate([problem.slopes[child] for child in children], axis=1)
    values, vectors = np.linalg.eigh(slopes.T @ slopes)
    known = values > UNKNOWN_ABOVE**-2
    kept = vectors[:, known] / np.sqrt(values[known])
    scores = kept.T @ (slopes.T @ problem.y)
    twist, covariance, gain = kept @ scores, kept @ kept.T, float(scores @ scores)
    found = []
    for i, child in enumerate(children):
        at = slice(6 * i, 6 * i + 6)
        unseen = _unseen(vectors[at][:, ~known])
        part, spread = twist[at], covariance[at, at]
        own = float(part @ np.linalg.pinv(spread, rcond=1e-9, hermitian=True) @ part)
        found.append(LinkChange(child, frozen(part[:3]), frozen(part[3:]), frozen(spread), unseen, own))
    return found, gain


def _unseen(parts: Array) -> Array:
    """Return orthonormal rows that span one link's share of what cannot be seen."""
    if not parts.size:
        return frozen(np.zeros((0, 6)))
    full, sizes, _ = np.linalg.svd(parts)
    return frozen(full[:, : np.count_nonzero(sizes > 1e-3)].T)


def _would_find(change: LinkChange, chance: float) -> float:
    """Return the displacement [m] whose gain is enough in the worst of the directions that can be seen."""
    if not change.seen:
        return float("nan")
    # Noise takes away as often as it adds: two sigmas more are found in 98 of 100.
    needed = float(np.sqrt(chdtri(change.seen, chance))) + 2.0
    return needed * float(np.sqrt(np.linalg.eigvalsh(change.covariance[3:, 3:]).max()))

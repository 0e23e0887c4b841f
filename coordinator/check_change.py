"""Which link of a robot has changed between two sessions, by how much, and how surely.

The increments from the former chain to the later one, d ~ N(D x, C), are compared under hypotheses; C is
that of the sensors' noise alone, as what a model leaves out is common to both sessions, and of the floors
below. A link that changes by a twist displaces everything beyond it by that same twist, so that "link k
changed" has six parameters, and "nothing changed" none. The gain in chi^2 of the best six is
chi^2-distributed with as many degrees of freedom as of the six can be seen (Wilks, 1938); the probability of
as large a gain by chance is multiplied by the number of links that are looked at (Bonferroni). Links are
taken in one by one, the one that explains most first, until what is left is chance.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from coordinator.check_fit import TiedFits
from coordinator.kinematics.forward import descendants
from coordinator.kinematics.increments import adjoint, frozen, increments_between
from coordinator.kinematics.refinement import UNKNOWN_ABOVE
from module_agent.dynamics.chain import Array, Chain

# What two sessions of unlike motions leave between them for each link, of the same robot: links and springs
# that give, filters. Measured: up to 0.2 mm and 0.45 mrad where the sessions' motions have other lengths.
FLOOR_RAD, FLOOR_M = 3e-4, 1e-4
# Of all checks of a robot that has not changed, how many may say that it has.
FALSE_ALARMS = 1e-4


class LinkChange(NamedTuple):
    """How the IMU of one module is displaced against its parent, in the IMU's own frame at q = 0.

    rotation_rad, displacement_m: (3,), zero along what cannot be seen. covariance: (6, 6) of [rotation,
    displacement] over what can be seen. unseen: (k, 6) orthonormal directions of the same that cannot.
    gain: by how much the change lowers chi^2, which has `seen` degrees of freedom; of several links together
    what each of them adds to the others.
    """

    child: int
    rotation_rad: Array
    displacement_m: Array
    covariance: Array
    unseen: Array
    gain: float

    @property
    def seen(self) -> int:
        """How many of the six parameters can be seen."""
        return 6 - len(self.unseen)

    @property
    def chance(self) -> float:
        """The probability that chance alone gains as much for this one link."""
        return float(chi2.sf(self.gain, self.seen)) if self.seen else 1.0

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
    """What a comparison says.

    changed: the links that changed, with the rest taken as unchanged, the surest first. false_alarm: for each
    of these the probability that it is one, over all links. each: every link with all the others free to
    have changed as well. would_find_m: (n,) the smallest displacement of every link that would surely have
    been found, whatever its direction of those that can be seen; NaN for the root.
    """

    changed: tuple[LinkChange, ...]
    false_alarm: tuple[float, ...]
    each: tuple[LinkChange, ...]
    would_find_m: Array
    least_false_alarm: float


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
    found = tuple(_explained(problem, [c.child for c in changed]).links)
    limit = np.full(len(fits.before.chain.serials), np.nan)
    for child in links:
        limit[child] = _would_find(_explained(problem, [child]).links[0], false_alarms / len(links))
    each = tuple(_explained(problem, links).links)
    return Findings(found, tuple(alarms), each, frozen(limit), least)


def _problem(fits: TiedFits) -> _Problem:
    chain = fits.before.chain
    slopes = {child: _slope(chain, child) for child in range(1, len(chain.serials))}
    kept = _visible(fits)
    own = np.diag(np.repeat([FLOOR_RAD, FLOOR_M], 3) ** 2)
    covariance = fits.before.noise_covariance[6:, 6:] + fits.after.noise_covariance[6:, 6:]
    covariance = covariance + sum(slope @ own @ slope.T for slope in slopes.values())
    white = np.linalg.inv(np.linalg.cholesky(kept.T @ covariance @ kept)) @ kept.T
    difference = increments_between(chain, fits.after.chain)[6:]
    return _Problem({child: white @ slope for child, slope in slopes.items()}, white @ difference)


def _slope(chain: Chain, child: int) -> Array:
    """Return the increments (6 (n - 1), 6) of all but the root by one link's change in its IMU's frame."""
    found = np.zeros((6 * len(chain.serials), 6))
    for module in descendants(chain, child):
        found[6 * module : 6 * module + 6] = adjoint(chain.imu_home[child])
    return found[6:]


def _visible(fits: TiedFits) -> Array:
    """Return orthonormal increments (6 (n - 1), r), as columns, that both sessions know."""
    unknown = np.concatenate([fits.before.null_basis[6:], fits.after.null_basis[6:]], axis=1)
    full, sizes, _ = np.linalg.svd(np.column_stack([unknown, np.zeros(len(unknown))]))
    return np.asarray(full[:, np.count_nonzero(sizes > 1e-6) :])


def _next(problem: _Problem, taken: Sequence[int]) -> LinkChange:
    """Return the link that explains most of what those taken leave."""
    before = _explained(problem, taken).gain
    candidates = []
    for child in problem.slopes:
        if child not in taken:
            together = _explained(problem, [child, *taken])
            candidates.append(together.links[0]._replace(gain=together.gain - before))
    return min(candidates, key=lambda c: (c.chance, -c.gain))


class _Explained(NamedTuple):
    """Changes of some links, and by how much all together lower chi^2."""

    links: list[LinkChange]
    gain: float


def _explained(problem: _Problem, children: Sequence[int]) -> _Explained:
    """Return the changes of some links that explain the differences best.

    What cannot be seen is left at zero.
    """
    if not children:
        return _Explained([], 0.0)
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
    return _Explained(found, gain)


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
    needed = float(np.sqrt(chi2.isf(chance, change.seen))) + 2.0
    return needed * float(np.sqrt(np.linalg.eigvalsh(change.covariance[3:, 3:]).max()))

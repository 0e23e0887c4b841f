"""A result against the truth of the second simulator: topology, and errors of links over what is claimed."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from coordinator.identification.result import Result, TransformPart
from tests.second_simulator.robot import Array, Robot

# A share of 95 % intervals that chance has less often than this is a contradiction.
CHANCE = 1e-3
# Directions with a smaller share of a covariance, parameters in their sigmas, are exact.
EXACT = 1e-6


class LinkError(NamedTuple):
    """The errors of one link in standard deviations, estimate - truth.

    length: of the distance from the parent's axis to the child's IMU. transform: (6,) of the parameters as in
    `TransformPart`, NaN where the result says that one is not known. square: of the Mahalanobis distance of
    the truth by the covariance of all `known` parameters.
    """

    child: str
    length: float
    transform: Array
    square: float
    known: int


def topology_errors(result: Result, robot: Robot) -> list[str]:
    """Return the modules whose parent or mounting is wrong, that are missing, or that do not exist."""
    identified, true = (
        {
            serial: (serials[above] if above >= 0 else None, back)
            for serial, above, back in zip(serials, parent, backwards, strict=True)
        }
        for serials, parent, backwards in (
            (result.chain.serials, result.chain.parent, result.chain.reversed),
            (robot.serials, robot.parent, robot.reversed),
        )
    )
    return [s for s in {**true, **identified} if true.get(s) != identified.get(s)]


def link_errors(result: Result, robot: Robot) -> list[LinkError]:
    """Return the errors of all links; the topology must be right."""
    errors = []
    for link, transform in zip(result.links, result.transforms, strict=True):
        child = robot.serials.index(link.child)
        # A length of which nothing is claimed counts as wrong.
        sigma_mm = link.link_length_sigma_mm or 0.0
        length = float(np.divide(link.link_length_mm - 1e3 * robot.link_length_m(child), sigma_mm))
        errors.append(LinkError(link.child, length, *_transform_errors(transform, *robot.link(child))))
    return errors


def _transform_errors(part: TransformPart, turn: Array, place_m: Array) -> tuple[Array, float, int]:
    values, sigma = np.array(part.values), np.array([one or np.nan for one in part.sigma])
    true = Rotation.from_matrix(turn).as_rotvec(degrees=True)
    # A rotation vector of nearly half a turn has a twin that points the other way.
    size = float(np.linalg.norm(true))
    twins = [true] if size == 0.0 else [true, true * (1.0 - 360.0 / size)]
    nearest = min(twins, key=lambda twin: float(np.linalg.norm(twin - values[3:])))
    errors = (values - np.concatenate([1e3 * place_m, nearest])) / sigma
    known = np.isfinite(errors)
    if not known.any():
        return errors, 0.0, 0
    covariance = (np.array(part.covariance) / np.outer(sigma, sigma))[np.ix_(known, known)]
    shares, directions = np.linalg.eigh(covariance)
    used = shares > EXACT
    squares = (directions[:, used].T @ errors[known]) ** 2 / shares[used]
    return errors, float(squares.sum()), len(squares)


class Coverage(NamedTuple):
    """How many of `total` 95 % intervals cover, and how few and how many would be a contradiction."""

    covered: int
    total: int
    low: int
    high: int

    @property
    def honest(self) -> bool:
        """Whether chance has such a count of intervals that claim what they should."""
        return self.low <= self.covered <= self.high

    def __str__(self) -> str:
        """Return the count, its share and the bounds."""
        share = 100.0 * self.covered / max(1, self.total)
        return f"{self.covered} of {self.total} ({share:.1f} %), {self.low} to {self.high} by chance"


def coverage(covered: list[bool]) -> Coverage:
    """Count what 95 % intervals cover, against the binomial distribution of independent ones."""
    low, high = binom.interval(1.0 - CHANCE, len(covered), 0.95)
    return Coverage(int(sum(covered)), len(covered), int(low), int(high))


def lengths_covered(links: list[LinkError]) -> Coverage:
    """Return the coverage of the lengths' intervals."""
    return coverage([abs(link.length) < 1.96 for link in links])


def transforms_covered(links: list[LinkError]) -> Coverage:
    """Return the coverage of the transforms' ellipsoids, of the parameters that are known."""
    return coverage([link.square < chi2.ppf(0.95, link.known) for link in links if link.known])


def reduced_chi2(links: list[LinkError]) -> tuple[float, float, float]:
    """Return the transforms' squared errors per known parameter, and how little and how much is chance."""
    known = sum(link.known for link in links)
    low, high = chi2.interval(1.0 - CHANCE, known)
    return sum(link.square for link in links) / known, float(low) / known, float(high) / known


def parameters_covered(links: list[LinkError]) -> Coverage:
    """Return the coverage of the single parameters' intervals; those of one link are not independent."""
    errors = np.array([link.transform for link in links]).ravel()
    return coverage([abs(error) < 1.96 for error in errors[np.isfinite(errors)].tolist()])

"""One line of a benchmark: a figure of a case, by the thesis' way, by ours, its bound, and its bar."""

from collections.abc import Sequence
from math import isfinite, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

# A range of per cent in which the share of 95 % intervals that cover must lie.
COVERAGE = (92.0, 98.0)
# With fewer intervals than this, chance alone leaves the range: one standard deviation is then over 1.5 %.
FEW_INTERVALS = 200
SIGMAS_95 = 1.96
_SIGMAS_99 = 2.58
# Ratios of errors have a bar from so many trials on.
ENOUGH_TRIALS = 13

Limit = float | tuple[float, float] | None


class Row(NamedTuple):
    """A figure of a case; None where there is none.

    limit: what `ours` must not exceed, or a range that it must lie in; None for a figure without a bar.
    case, profile, known: as of `Case`, filled in when its trials are concluded.
    """

    figure: str
    ours: float | None
    limit: Limit = None
    thesis: float | None = None
    bound: float | None = None
    case: str = ""
    profile: str = ""
    known: str = ""

    @property
    def holds(self) -> bool | None:
        """Whether the bar is met; None without one. A figure that could not be measured misses its bar."""
        if self.limit is None:
            return None
        if self.ours is None:
            return False
        low, high = self.limit if isinstance(self.limit, tuple) else (float("-inf"), self.limit)
        return low <= self.ours <= high

    def plain(self) -> dict[str, object]:
        """Return the row as it stands in JSON."""
        figures = {name: _finite(getattr(self, name)) for name in ("thesis", "ours", "bound")}
        about = {name: getattr(self, name) for name in ("case", "profile", "known", "figure")}
        return {**about, **figures, "limit": self.limit, "holds": self.holds}


def _finite(value: float | None) -> float | None:
    return value if value is not None and isfinite(value) else None


def mean_abs(values: Sequence[float | None]) -> float | None:
    """Return the mean size of the values that are there, None if none is."""
    known = [abs(value) for value in values if value is not None]
    return float(np.mean(known)) if known else None


def rms(values: Sequence[float | None]) -> float | None:
    """Return the root mean square of the values that are there, None if none is."""
    known = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def largest(values: Sequence[float | None]) -> float | None:
    """Return the largest size of the values that are there, None if none is; NaN if one is NaN."""
    known = [abs(value) for value in values if value is not None]
    # Python's max passes over a NaN, or not, by its place.
    return float(np.max(known)) if known else None


def ratio(over: float | None, under: float | None) -> float | None:
    """Return a ratio, None where one of the two is not known or the lower one is 0."""
    return None if over is None or not under else over / under


def widened(limit: float, terms: int) -> float:
    """Return the bar of an rms error over its bound: `limit`, or what chance makes of 1 in 99 of 100 cases.

    terms: how many independent normal errors it is of, three of every place.
    """
    return max(limit, float(np.sqrt(chdtri(terms, 0.01) / terms))) if terms else limit


def scaled(value: float | None, factor: float) -> float | None:
    """Return a value in another unit."""
    return None if value is None else factor * value


def count(figure: str, hits: Sequence[bool]) -> Row:
    """Return a row that counts what must never happen, with a bar of 0; None without any trial."""
    return Row(f"{figure}, of {len(hits)}", float(sum(hits)) if hits else None, 0.0)


def coverage(sigmas_off: Sequence[float]) -> Row:
    """Return the share of 95 % intervals that cover the truth, from |error| / sigma of every interval [%].

    The bar is `COVERAGE`; with few intervals it is wider by what chance does to them in 99 of 100 cases.
    """
    figure = f"95 % intervals that cover, of {len(sigmas_off)} [%]"
    if not sigmas_off:
        return Row(figure, None, COVERAGE)
    share = 100.0 * float(np.mean(np.asarray(sigmas_off) <= SIGMAS_95))
    chance = 0.0
    if len(sigmas_off) < FEW_INTERVALS:
        chance = 100.0 * _SIGMAS_99 * sqrt(0.95 * 0.05 / len(sigmas_off))
    low, high = COVERAGE
    return Row(figure, share, (max(low - chance, 0.0), min(high + chance, 100.0)))

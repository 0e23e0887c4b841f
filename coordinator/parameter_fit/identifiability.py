"""What may be said of every single parameter: identified, weak, or not identifiable, and why.

A parameter is known by itself if a base parameter holds it alone. One that only shows in sums is not
identifiable from torques, but what is known beforehand may settle the sum; then it is weak, whatever its
standard deviation, because it is no better than the prior's way of sharing out.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.parameter_fit.base_parameters import BaseParameters

Kind = Literal["identified", "weak", "not identifiable"]

# Relative standard deviation: the limit that identification of robots is used to (Khalil and Dombre 2002,
# section 12.4).
WEAK_ABOVE = 0.1
# Of the parameters that a sum shares: as many are named as one reads.
_NAMED = 6


class Identifiability(NamedTuple):
    """What is known of one parameter.

    value, sigma: from torques alone if it is known alone, with the prior's help if that settles it, else
    None. sums: the base parameters that it is in. lumped_with: the other parameters in those. words: kind,
    value and reason, to read.
    """

    name: str
    kind: Kind
    value: float | None
    sigma: float | None
    sums: tuple[int, ...]
    lumped_with: tuple[str, ...]
    words: str


def identifiabilities(
    base: BaseParameters,
    units: Sequence[str],
    informed: ArrayLike | None = None,
    informed_sigma: ArrayLike | None = None,
) -> tuple[Identifiability, ...]:
    """Return a verdict for every one of p columns.

    Args:
        base: what torques alone tell.
        units: (p,) of the parameters.
        informed, informed_sigma: (p,) parameters and their standard deviations with a prior
            (`physical_fit`), in the same frames; None where there is no prior.

    Raises:
        ValueError: shapes that do not fit, or only one of the two that belong together.
    """
    count = len(base.columns.names)
    if len(units) != count:
        raise ValueError(f"{len(units)} units for {count} parameters")
    if (informed is None) != (informed_sigma is None):
        raise ValueError("parameters with a prior need their standard deviations, and the other way round")
    values, sigmas = (
        np.full(count, np.nan) if one is None else np.asarray(one, dtype=float)
        for one in (informed, informed_sigma)
    )
    if values.shape != (count,) or sigmas.shape != (count,):
        raise ValueError(f"{values.shape} values and {sigmas.shape} deviations for {count} parameters")
    members = [base.lumped(i) for i in range(base.rank)]
    sums: list[list[int]] = [[] for _ in range(count)]
    for i, some in enumerate(members):
        for j in some:
            sums[j].append(i)
    found = []
    for j, (name, unit) in enumerate(zip(base.columns.names, units, strict=True)):
        if len(sums[j]) == 1 and len(members[sums[j][0]]) == 1:
            i = sums[j][0]
            found.append(_known_alone(name, unit, i, float(base.value[i]), float(base.sigma[i])))
            continue
        others = sorted({k for i in sums[j] for k in members[i]} - {j})
        names = tuple(base.columns.names[k] for k in others)
        found.append(_in_sums(name, unit, tuple(sums[j]), names, float(values[j]), float(sigmas[j])))
    return tuple(found)


def words_of_body(some: Sequence[Identifiability]) -> str:
    """Return the verdicts of one body in a line: which are identified, weak, only in sums, without effect."""
    groups: dict[str, list[str]] = {}
    for verdict in some:
        group: str = verdict.kind
        if group == "not identifiable":
            group = "only in sums" if verdict.sums else "without effect"
        groups.setdefault(group, []).append(verdict.name)
    order = ("identified", "weak", "only in sums", "without effect")
    return "; ".join(f"{group}: {', '.join(groups[group])}" for group in order if group in groups)


def words_of_base(base: BaseParameters) -> str:
    """Return in a line how many base parameters there are, and how well they are known."""
    strong = int(np.sum(base.relative_sigma <= WEAK_ABOVE))
    size = len(base.columns.names)
    return (
        f"{base.rank} sums of {size} parameters are known, {strong} of them within {100 * WEAK_ABOVE:.0f} %"
    )


def _known_alone(name: str, unit: str, place: int, value: float, sigma: float) -> Identifiability:
    ratio = sigma / abs(value) if value else np.inf
    kind: Kind = "identified" if ratio <= WEAK_ABOVE else "weak"
    return Identifiability(name, kind, value, sigma, (place,), (), f"{kind}: {_figures(value, sigma, unit)}")


def _in_sums(
    name: str, unit: str, sums: tuple[int, ...], others: tuple[str, ...], value: float, sigma: float
) -> Identifiability:
    if not sums:
        words = "not identifiable: without effect on torques"
        return Identifiability(name, "not identifiable", None, None, (), (), words)
    more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
    where = f"in sums with {', '.join(others[:_NAMED])}{more}"
    if sigma <= WEAK_ABOVE * abs(value):
        words = f"weak: {_figures(value, sigma, unit)} by the prior, only {where}"
        return Identifiability(name, "weak", value, sigma, sums, others, words)
    return Identifiability(
        name, "not identifiable", None, None, sums, others, f"not identifiable: only {where}"
    )


def _figures(value: float, sigma: float, unit: str) -> str:
    """Return a value with the digits that its deviation leaves, "0.2550 +- 0.0012 kg m (0.5 %)"."""
    places = max(0, 1 - int(np.floor(np.log10(sigma)))) if sigma > 0.0 else 6
    known = sigma < abs(value)
    share = f" ({100.0 * sigma / abs(value):.2g} %)" if known else ", may be zero"
    return f"{value:.{places}f} +- {sigma:.{places}f} {unit}{share}"

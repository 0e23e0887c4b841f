"""The identifiability of every single parameter: identified, weak, or not identifiable, and why.

A parameter is identified by itself if a base parameter consists of it alone. One that only appears in
combination with others is not identifiable from torques, but a prior may settle it. Then it is weak, whatever
its standard deviation, because the prior decides how the combination is shared out.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from coordinator.parameter_fit.base_parameters import BaseParameters

Kind = Literal["identified", "weak", "not identifiable"]
# Of an estimate: no prior is involved, and a value within its own sigma is no evidence of the parameter.
Precision = Literal["identified", "weak", "not distinguishable from zero"]

# Relative standard deviation: the limit that identification of robots is used to (Khalil and Dombre 2002,
# section 12.4).
WEAK_ABOVE = 0.1
# So many of the parameters in a combination are named in a summary.
_NAMED = 6


class Identifiability(NamedTuple):
    """The identifiability of one parameter.

    value, sigma: from torques alone if it is a base parameter by itself, from torques and prior if these
    settle it, else None. base_parameters: the places of the base parameters that it is in. lumped_with: the
    other parameters in those. summary: kind, value and reason in a sentence.
    """

    name: str
    kind: Kind
    value: float | None
    sigma: float | None
    base_parameters: tuple[int, ...]
    lumped_with: tuple[str, ...]
    summary: str


def identifiabilities(
    base: BaseParameters,
    units: Sequence[str],
    informed: ArrayLike | None = None,
    informed_sigma: ArrayLike | None = None,
) -> tuple[Identifiability, ...]:
    """Return the identifiability of every one of p parameters.

    Args:
        base: the base parameters of the torques alone.
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
    places: list[list[int]] = [[] for _ in range(count)]
    for i, some in enumerate(members):
        for j in some:
            places[j].append(i)
    results = []
    for j, (name, unit) in enumerate(zip(base.columns.names, units, strict=True)):
        others = sorted({k for i in places[j] for k in members[i]} - {j})
        one = Identifiability(
            name=name,
            kind="not identifiable",
            value=None,
            sigma=None,
            base_parameters=tuple(places[j]),
            lumped_with=tuple(base.columns.names[k] for k in others),
            summary="not identifiable: without effect on torques",
        )
        if len(places[j]) == 1 and not others:
            i = places[j][0]
            results.append(_known_alone(one, unit, float(base.value[i]), float(base.sigma[i])))
        elif places[j]:
            results.append(_in_combination(one, unit, float(values[j]), float(sigmas[j])))
        else:
            results.append(one)
    return tuple(results)


def precision(relative_sigma: float) -> Precision:
    """Return how well an estimate is known by its standard deviation over its absolute value."""
    if relative_sigma <= WEAK_ABOVE:
        return "identified"
    return "weak" if relative_sigma < 1.0 else "not distinguishable from zero"


def body_summary(parameters: Sequence[Identifiability]) -> str:
    """Return the parameters of one body in a line, grouped by how well they are known."""
    groups: dict[str, list[str]] = {}
    for one in parameters:
        group: str = one.kind
        if group == "not identifiable":
            group = "only in combinations" if one.base_parameters else "without effect"
        groups.setdefault(group, []).append(one.name)
    order = ("identified", "weak", "only in combinations", "without effect")
    return "; ".join(f"{group}: {', '.join(groups[group])}" for group in order if group in groups)


def base_summary(base: BaseParameters) -> str:
    """Return in a line how many base parameters there are, and how well they are known."""
    strong = int(np.sum(base.relative_sigma <= WEAK_ABOVE))
    size = len(base.columns.names)
    return (
        f"{base.rank} base parameters of {size} parameters, {strong} of them known within "
        f"{100 * WEAK_ABOVE:.0f} %"
    )


def _known_alone(one: Identifiability, unit: str, value: float, sigma: float) -> Identifiability:
    ratio = sigma / abs(value) if value else np.inf
    kind: Kind = "identified" if ratio <= WEAK_ABOVE else "weak"
    return one._replace(
        kind=kind, value=value, sigma=sigma, summary=f"{kind}: {_figures(value, sigma, unit)}"
    )


def _in_combination(one: Identifiability, unit: str, value: float, sigma: float) -> Identifiability:
    others = one.lumped_with
    more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
    where = f"in combination with {', '.join(others[:_NAMED])}{more}"
    if sigma <= WEAK_ABOVE * abs(value):
        summary = f"weak: {_figures(value, sigma, unit)} by the prior, only {where}"
        return one._replace(kind="weak", value=value, sigma=sigma, summary=summary)
    return one._replace(summary=f"not identifiable: only {where}")


def _figures(value: float, sigma: float, unit: str) -> str:
    """Return a value with the digits that its deviation leaves, "0.2550 +- 0.0012 kg m (0.5 %)"."""
    places = max(0, 1 - int(np.floor(np.log10(sigma)))) if sigma > 0.0 else 6
    known = sigma < abs(value)
    share = f" ({100.0 * sigma / abs(value):.2g} %)" if known else ", may be zero"
    return f"{value:.{places}f} +- {sigma:.{places}f} {unit}{share}"

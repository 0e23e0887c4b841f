"""An estimated parameter as it is plotted: whose it is, and a range in which its band can be seen."""

import math
from typing import NamedTuple

Range = tuple[float, float]

# The first band fills two fifths of the plot. Once it has shrunk below a thirtieth of it, the plot zooms in.
FIRST_SIGMAS = 2.5
ZOOM_BELOW = 1.0 / 30.0
ZOOMED_SIGMAS = 8.0
AGREEING_SIGMAS = 4.0
# Of a normal distribution 95 % lie nearer to the middle.
NINETY_FIVE_SIGMAS = 1.96
# What is put into a plot besides, such as the truth, is this part of it away from its edge.
BESIDE_EDGE = 0.06


class Estimate(NamedTuple):
    """One estimate of a parameter with its standard deviation; `serial` names what has it."""

    name: str
    serial: str
    value: float
    sigma: float
    units: str


class Parameter(NamedTuple):
    """A parameter that has been estimated.

    ranges: what has it, in the order of the first estimates, and its plot's range (None: the viewer's own).
    """

    name: str
    units: str
    ranges: tuple[tuple[str, Range | None], ...] = ()

    def ranges_by_serial(self) -> dict[str, Range | None]:
        """Return the ranges as a dictionary in the same order."""
        return dict(self.ranges)

    def without_ranges(self) -> "Parameter":
        """Return the parameter with the viewer's own ranges."""
        return self._replace(ranges=tuple((serial, None) for serial, _ in self.ranges))

    def title(self) -> str:
        """Return the name as one reads it."""
        return self.name.replace("_", " ")

    def seen(
        self, serial: str, value: float, sigma: float, previous: float | None, truth: float | None = None
    ) -> "Parameter":
        """Return the parameter with a plot in which this estimate, its band and the truth can be seen."""
        ranges = self.ranges_by_serial()
        ranges[serial] = including(fitting(ranges.get(serial), value, sigma, previous), truth)
        return self._replace(ranges=tuple(ranges.items()))


def fitting(before: Range | None, value: float, sigma: float, previous: float | None) -> Range | None:
    """Return the range for an estimate, the one before if that still does: a new one means a new layout.

    The viewer fits a plot to the lines and cuts their bands off, so the range has to be set. Without a finite
    positive sigma there is no band, and the viewer's own choice stays. The plot zooms in only on an estimate
    that agrees with the previous one: a jump of many sigmas says that sigma is wrong, and is to be seen.
    """
    if not (math.isfinite(value) and math.isfinite(sigma) and sigma > 0.0):
        return before
    if before is None:
        return (value - FIRST_SIGMAS * sigma, value + FIRST_SIGMAS * sigma)
    low, high = before
    if value - sigma < low or high < value + sigma:
        low, high = min(low, value - FIRST_SIGMAS * sigma), max(high, value + FIRST_SIGMAS * sigma)
    agrees = previous is not None and abs(value - previous) < AGREEING_SIGMAS * sigma
    if agrees and 2.0 * sigma < ZOOM_BELOW * (high - low):
        return including((value - ZOOMED_SIGMAS * sigma, value + ZOOMED_SIGMAS * sigma), previous)
    return (low, high)


def including(around: Range | None, value: float | None) -> Range | None:
    """Return a range in which a further value can be seen too."""
    if around is None or value is None or not math.isfinite(value):
        return around
    low, high = around
    edge = BESIDE_EDGE * (max(high, value) - min(low, value))
    return (low if value > low else value - edge, high if value < high else value + edge)


def is_dynamic(parameter: Parameter) -> bool:
    """Return whether it belongs to dynamics: masses, moments, friction and springs have units of kg or Nm."""
    return "kg" in parameter.units or "Nm" in parameter.units


def with_estimate(
    parameters: tuple[Parameter, ...],
    estimate: Estimate,
    previous: float | None,
    truth: float | None = None,
) -> tuple[Parameter, ...]:
    """Return the parameters with this estimate among them; the units are those said first."""
    known = {parameter.name: parameter for parameter in parameters}
    parameter = known.get(estimate.name, Parameter(estimate.name, estimate.units))
    known[estimate.name] = parameter.seen(estimate.serial, estimate.value, estimate.sigma, previous, truth)
    return tuple(known.values())

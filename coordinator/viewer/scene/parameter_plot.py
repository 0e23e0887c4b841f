"""The plot of an estimated parameter: its module, and an axis range in which its band is visible."""

import math
from typing import NamedTuple

Range = tuple[float, float]

LINK_LENGTH, AXIS_ANGLE = "link_length", "axis_angle"

# The first band fills two fifths of the plot. Once it has shrunk below a thirtieth of it, the plot zooms in.
FIRST_SIGMAS = 2.5
ZOOM_BELOW = 1.0 / 30.0
ZOOMED_SIGMAS = 8.0
AGREEING_SIGMAS = 4.0
# Half width of the 95 % interval of a normal distribution.
NINETY_FIVE_SIGMAS = 1.96
# The viewer labels powers of ten, if they are at least this share of a plot apart.
LABELLED_SHARE = 1.0 / 7.0
# Distance of a further value, such as the truth, from the edge of a plot, as a fraction of its height.
EDGE_MARGIN = 0.06


class Estimate(NamedTuple):
    """One estimate of a parameter of the module `serial` with its standard deviation."""

    name: str
    serial: str
    value: float
    sigma: float
    units: str


class Parameter(NamedTuple):
    """A parameter that has been estimated.

    ranges: (serial, axis range) in the order of the first estimates; None leaves the range to the viewer.
    """

    name: str
    units: str
    ranges: tuple[tuple[str, Range | None], ...] = ()

    def ranges_by_serial(self) -> dict[str, Range | None]:
        """Return the axis range by serial, in the same order."""
        return dict(self.ranges)

    def title(self) -> str:
        """Return the name without underscores."""
        return self.name.replace("_", " ")


def fitting(before: Range | None, value: float, sigma: float, previous: float | None) -> Range | None:
    """Return the axis range for an estimate, unchanged where that is possible: a new one needs a new layout.

    The viewer fits a plot to the lines and cuts their bands off, so the range has to be set. Without a finite
    positive sigma there is no band, and the range stays as it was. The plot zooms in only on an estimate
    that agrees with the previous one: a jump of many sigmas means that sigma is wrong, and must stay visible.
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
    """Return a range in which a further value is visible too."""
    if around is None or value is None or not math.isfinite(value):
        return around
    low, high = around
    edge = EDGE_MARGIN * (max(high, value) - min(low, value))
    return (low if value > low else value - edge, high if value < high else value + edge)


def labelled(shown: Range) -> Range:
    """Return a range in which the viewer labels two places at least: one number alone gives no scale."""
    low, high = shown
    step = 10.0 ** math.ceil(math.log10(max(LABELLED_SHARE * (high - low), 1e-12)))
    first, last = math.ceil(low / step), math.floor(high / step)
    while last - first < 1:
        if (last + 1) * step - high <= low - (first - 1) * step:
            last += 1
            high = (last + EDGE_MARGIN) * step
        else:
            first -= 1
            low = (first - EDGE_MARGIN) * step
    return low, high


def with_estimate(
    parameters: tuple[Parameter, ...],
    estimate: Estimate,
    previous: float | None,
    truth: float | None = None,
) -> tuple[Parameter, ...]:
    """Return the parameters including this estimate, with a range in which it and the truth are visible.

    The units are those of the first estimate.
    """
    known = {parameter.name: parameter for parameter in parameters}
    parameter = known.get(estimate.name, Parameter(estimate.name, estimate.units))
    ranges = parameter.ranges_by_serial()
    fitted = fitting(ranges.get(estimate.serial), estimate.value, estimate.sigma, previous)
    ranges[estimate.serial] = including(fitted, truth)
    known[estimate.name] = parameter._replace(ranges=tuple(ranges.items()))
    return tuple(known.values())

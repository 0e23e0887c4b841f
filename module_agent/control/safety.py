"""The safety configuration of one module: what it does not exceed, whatever its holder commands.

`hardware.motor_guard` enforces it on every PWM; `safety_file` reads and writes it.
"""

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from module_agent.model.errors import UsageError
from module_agent.wire.messages import Limits

# What happens at a limit, before which the joint is slowed down. disabled: it is none; motor_off: the motor
# is off; hold: the joint is held there against its load; spring: it is pushed back, and gives way to a load.
LimitAction = Literal["disabled", "motor_off", "hold", "spring"]
MStopAction = Literal["disabled", "motor_off", "hold"]

# At this temperature a module has no PWM left, whatever its configuration says.
MAX_WINDING_C = 154.0
# A winding is armed again 14 K below its limit, which a warm room must not prevent.
MIN_WINDING_C = 60.0
# An arm of length r that a motor can just hold level decelerates by g / r under the same torque: 10 rad/s^2
# for a metre, of which gravity may take half.
BRAKING_RAD_S2 = 5.0
# No joint is turned that far; what is beyond is a mistake, or meant to be no limit.
MAX_POSITION_RAD = 1e5


def _pair(value: object) -> object:
    """Return both sides from one number, which stands for -number .. number."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return (-value, value)
    return value


def _both(value: object) -> object:
    return (value, value) if isinstance(value, str) else value


def _check_range(value: "_Pair") -> "_Pair":
    low, high = value
    # A comparison with NaN is false.
    if not low < high:
        raise ValueError(f"{low:g} .. {high:g}: the lower limit must be below the upper one")
    if any(math.isfinite(limit) and abs(limit) > MAX_POSITION_RAD for limit in value):
        raise ValueError(f"{low:g} .. {high:g}: at most {MAX_POSITION_RAD:g}, or inf for no limit")
    return value


def _check_around_zero(value: "_Pair") -> "_Pair":
    low, high = value
    if not low < 0.0 < high:
        raise ValueError(f"{low:g} .. {high:g}: the lower limit must be below 0 and the upper one above")
    return value


_Number = Annotated[float, Field(strict=True)]
_Pair = tuple[_Number, _Number]
_Range = Annotated[_Pair, AfterValidator(_check_range)]
_Interval = Annotated[_Pair, BeforeValidator(_pair), AfterValidator(_check_around_zero)]
_INFINITE = (-math.inf, math.inf)


class Safety(BaseModel):
    """What one module does not exceed; by default what its type does not.

    position_rad: lowest and highest position, by the module's own encoder. at_limit: what happens at the
    lower and at the upper one. velocity_rad_s, effort_nm: lowest and highest speed of the output, and torque
    that the motor makes there. current_a: of the motor, either sign. winding_c: at this temperature the motor
    is off. braking_rad_s2: the deceleration that the module manages under its heaviest load; it begins to
    brake before a limit accordingly. m_stop: what the module does while its emergency stop is pressed; None
    is what it does on a stop.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    position_rad: _Range = _INFINITE
    at_limit: Annotated[tuple[LimitAction, LimitAction], BeforeValidator(_both)] = ("hold", "hold")
    velocity_rad_s: _Interval = _INFINITE
    effort_nm: _Interval = _INFINITE
    current_a: Annotated[_Number, Field(gt=0.0)] = math.inf
    winding_c: Annotated[_Number, Field(ge=MIN_WINDING_C, le=MAX_WINDING_C)] = MAX_WINDING_C
    braking_rad_s2: Annotated[_Number, Field(gt=0.0, le=1e4)] = BRAKING_RAD_S2
    m_stop: MStopAction | None = None

    @property
    def range_rad(self) -> tuple[float, float]:
        """The lowest and the highest position that is enforced."""
        sides = zip(self.position_rad, self.at_limit, _INFINITE, strict=True)
        low, high = (free if action == "disabled" else limit for limit, action, free in sides)
        return low, high

    @property
    def speed_rad_s(self) -> float:
        """The speed that is possible in both directions."""
        return min(-self.velocity_rad_s[0], self.velocity_rad_s[1])

    def tightened(self, limits: Limits) -> Limits:
        """Return the limits of a type with those of this configuration: the narrower of both.

        Raises:
            UsageError: no position is within both ranges.
        """
        low, high = self.range_rad
        stated_low, stated_high = limits.min_position_rad, limits.max_position_rad
        low = low if stated_low is None else max(low, stated_low)
        high = high if stated_high is None else min(high, stated_high)
        if low >= high:
            raise UsageError(
                f"position_rad {self.position_rad[0]:g} .. {self.position_rad[1]:g}: the type's own range is "
                f"{stated_low:g} .. {stated_high:g} rad, so that no position is allowed"
            )
        return Limits(
            max_speed_rad_s=min(limits.max_speed_rad_s, self.speed_rad_s),
            max_effort_nm=min(limits.max_effort_nm, -self.effort_nm[0], self.effort_nm[1]),
            min_position_rad=None if low == -math.inf else low,
            max_position_rad=None if high == math.inf else high,
        )


# What a module has without a configuration.
UNCONFIGURED = Safety()

"""The factory gains and the limits of every module type."""

import math

from module_agent.model.catalogue import ModuleType
from module_agent.wire.messages import GainSet, Limits, PidGains
from module_agent.wire.refusal import Refusal, WireError

# Factory gains are up to 30; the thesis' integral gains, if meant per tick of 1 ms, are up to 1000 1/s.
MAX_GAIN, MAX_INTEGRAL_GAIN = 1e3, 1e4
# What stands for no limit in a message, which has no infinity.
UNLIMITED = 1e6
# The gains that are limits, of which a module may have none.
_LIMITS = ("i_clamp", "min_output", "max_output")


def default_gains(kind: ModuleType, strategy: int) -> GainSet:
    """Return the factory gains of a module type for control strategy 0-4.

    Position outputs Nm under strategies 2 and 4, velocity under strategy 2; those outputs are limited to the
    type's effort, all others to full PWM.
    """
    kp = {2: kind.gains.strategy_2, 4: kind.gains.strategy_4}.get(strategy, kind.gains.strategy_3)
    effort, speed = kind.max_effort_nm, kind.velocity_clamp_rad_s
    position_limit = effort if strategy in (2, 4) else 1.0
    velocity_limit = effort if strategy == 2 else 1.0
    return GainSet(
        strategy=strategy,
        position=PidGains(kp=kp[0], min_output=-position_limit, max_output=position_limit),
        velocity=PidGains(
            kp=kp[1],
            feed_forward=0.0 if strategy == 2 else 1.0,
            min_target=-speed,
            max_target=speed,
            min_output=-velocity_limit,
            max_output=velocity_limit,
            output_lowpass=0.75,
        ),
        effort=PidGains(
            kp=kp[2],
            kd=0.001,
            feed_forward=1.0,
            min_target=-1.6 * effort,
            max_target=1.6 * effort,
            output_lowpass=0.9,
            d_on_error=False,
        ),
    )


def check_gains(gains: GainSet) -> None:
    """Check that gains are of a size that some controller of a module could have; limits may be none.

    Raises:
        WireError: LIMIT, with the loop, the gain and its range.
    """
    for name in ("position", "velocity", "effort"):
        loop: PidGains = getattr(gains, name)
        for field in ("kp", "ki", "kd", "feed_forward", "punch", "i_clamp", "min_output", "max_output"):
            value: float = getattr(loop, field)
            most = MAX_INTEGRAL_GAIN if field == "ki" else MAX_GAIN
            if abs(value) > most and not (field in _LIMITS and abs(value) == UNLIMITED):
                none = ", or inf for no limit" if field in _LIMITS else ""
                raise WireError(
                    Refusal.LIMIT,
                    f"{field} {value:g} of the {name} loop; possible are -{most:g} .. {most:g}{none}",
                )


def for_message(value: float) -> float:
    """Return a gain of a file or of a module as a message carries it; an infinite one is `UNLIMITED`."""
    return min(max(value, -UNLIMITED), UNLIMITED)


def from_message(value: float) -> float:
    """Return a gain of a message as files and modules have it: infinite where it is `UNLIMITED`."""
    return value if abs(value) < UNLIMITED else math.copysign(math.inf, value)


def catalogue_limits(kind: ModuleType) -> Limits:
    """Return the limits of a module type."""
    low, high = kind.range_rad or (None, None)
    speed, effort = kind.max_speed_rad_s, kind.max_effort_nm
    return Limits(max_speed_rad_s=speed, max_effort_nm=effort, min_position_rad=low, max_position_rad=high)

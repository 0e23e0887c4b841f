"""How a module has aged since it was built: what is added to the constants that were drawn for it."""

import math
from typing import NamedTuple

from module_agent.model.errors import UsageError


class Ageing(NamedTuple):
    """What has become of a module; the default is a module as it was built.

    play_rad: added to the gap between gear and spring. hysteresis_nm: added to the whole width of the torque
    sensor's loop. gyro_bias_rad_s, accel_bias_m_s2: added on every axis. gyro_scale, accel_scale,
    effort_scale: relative, added to the scale errors. effort_offset_nm: added to the torque sensor's offset.
    """

    play_rad: float = 0.0
    hysteresis_nm: float = 0.0
    gyro_bias_rad_s: float = 0.0
    accel_bias_m_s2: float = 0.0
    gyro_scale: float = 0.0
    accel_scale: float = 0.0
    effort_scale: float = 0.0
    effort_offset_nm: float = 0.0


# What can only grow.
_WIDTHS = ("play_rad", "hysteresis_nm")


def check_ageing(ageing: Ageing) -> Ageing:
    """Return the ageing if a module can have it.

    Raises:
        UsageError: a value that is not finite, or a width below zero.
    """
    for name, value in ageing._asdict().items():
        if not math.isfinite(value) or (name in _WIDTHS and value < 0.0):
            wanted = "a number from 0 on" if name in _WIDTHS else "a finite number"
            raise UsageError(f"{name} of an aged module is {value}; it must be {wanted}")
    return ageing

"""Motions of all joints at once, separated by their frequencies (thesis 7.2: whole manipulator movements).

Each joint turns slowly and widely, so that gravity turns in the IMUs, and quickly about that, so that lever
arms show. No two joints share a frequency; within the window they are nearly orthogonal.
"""

from collections.abc import Mapping

import numpy as np

from coordinator.excitation.joint_limits import JointLimits, NoExcitation
from module_agent.wire.messages import MultiSine, Sine

# Slow: several turns of gravity within the window. Fast: compliant links and bases lengthen the
# apparent radius by about (f / 13 Hz)^2 at any amplitude.
SLOW_HZ = (0.15, 0.4)
FAST_HZ = (0.6, 1.3)
# The surroundings are not known yet: all joints together move a tip as far as the sum of their motions.
SLOW_RAD = 0.25
FAST_RAD = 0.12
# Half of speed and acceleration is left to the fast motion.
SLOW_SHARE = 0.5
MIN_DURATION_S = 11.0
# Periods of the difference of neighbouring frequencies within the flat part of the window.
BEATS = 0.5
FLAT_SHARE = 0.7


def simultaneous_duration_s(joints: int) -> float:
    """Return how long all joints must turn for their frequencies to be separable."""
    spacing_hz = (FAST_HZ[1] - FAST_HZ[0]) / max(joints - 1, 1)
    return max(MIN_DURATION_S, BEATS / spacing_hz / FLAT_SHARE)


def simultaneous_patterns(
    limits: Mapping[str, JointLimits], home_rad: float, total_s: float | None = None
) -> dict[str, MultiSine]:
    """Return a motion about `home_rad` for every joint, to be run at the same time.

    Slower joints get the lower frequencies.

    Raises:
        NoExcitation: a joint has no room to move about its home, or no torque left to accelerate with.
    """
    order = sorted(limits, key=lambda s: (limits[s].speed_rad_s, s))
    slow, fast = np.linspace(*SLOW_HZ, len(order)), np.linspace(*FAST_HZ, len(order))
    lasting_s = total_s if total_s is not None else simultaneous_duration_s(len(order))
    return {
        serial: _pattern(serial, limits[serial], home_rad, (float(slow[k]), float(fast[k])), lasting_s)
        for k, serial in enumerate(order)
    }


def _pattern(
    serial: str, limits: JointLimits, home_rad: float, slow_fast_hz: tuple[float, float], total_s: float
) -> MultiSine:
    room = limits.room_rad(home_rad)
    if room <= 0.0 or limits.accel_rad_s2 <= 0.0:
        raise NoExcitation(
            f"{serial} cannot move about {home_rad:.2f} rad: its range is {limits.low_rad:.2f} .. "
            f"{limits.high_rad:.2f} rad, it may accelerate by {limits.accel_rad_s2:.2f} rad/s^2"
        )
    slow_w, fast_w = (2.0 * np.pi * hz for hz in slow_fast_hz)
    speed, accel = limits.speed_rad_s, limits.accel_rad_s2
    slow = min(SLOW_RAD, 0.8 * room, SLOW_SHARE * speed / slow_w, SLOW_SHARE * accel / slow_w**2)
    speed, accel = speed - slow * slow_w, accel - slow * slow_w**2
    fast = min(FAST_RAD, 0.2 * room, speed / fast_w, accel / fast_w**2)
    pairs = zip((slow, fast), slow_fast_hz, strict=True)
    sines = tuple(Sine(amplitude_rad=radians, frequency_hz=hz) for radians, hz in pairs)
    pattern = MultiSine(sines=sines, duration_s=total_s)
    # The taper may raise speed or acceleration above the limits.
    return scaled(pattern, limits.fitting_scale(pattern))


def scaled(pattern: MultiSine, share: float) -> MultiSine:
    """Return the motion with all amplitudes multiplied."""
    sines = tuple(s.model_copy(update={"amplitude_rad": share * s.amplitude_rad}) for s in pattern.sines)
    return pattern.model_copy(update={"sines": sines})

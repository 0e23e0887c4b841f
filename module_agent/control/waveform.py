"""Motion patterns as position and velocity over time, relative to where the motion begins.

All functions are vectorised over the time samples. Sources: thesis eq. 13 (constant motion), eq. 14 (windowed
sine), table 6 and figure 44 (dynamic pattern); sums of sines as excitation: Swevers et al., Optimal robot
excitation and identification, 1997.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from module_agent.wire.messages import (
    ConstantMotion,
    DynamicPattern,
    GoTo,
    MultiSine,
    Pattern,
    Rest,
    WindowedSine,
)

Array = NDArray[np.float64]

# A Gaussian cut at +-Tm is not yet zero there (2 % at Tm = 2.8 s, Ts = 1 s), and a step would be a spike of
# acceleration: this share of the duration at either end carries it to exactly zero.
TAPER_SHARE = 0.15
MIN_GOTO_S = 0.2
# Peak speed over mean speed of a minimum-jerk path: 15/8.
MINIMUM_JERK_PEAK = 1.875


class Waveform(NamedTuple):
    """Samples of a motion: offset from the origin [rad] and velocity [rad/s], each of shape (samples,)."""

    offset_rad: Array
    velocity_rad_s: Array


def duration_s(pattern: Pattern, origin_rad: float) -> float:
    """Return how long the pattern lasts when it begins at `origin_rad`."""
    match pattern:
        case Rest():
            return pattern.duration_s
        case GoTo():
            return minimum_jerk_duration_s(abs(pattern.target_rad - origin_rad), pattern.max_speed_rad_s)
        case ConstantMotion():
            return pattern.duration_s + 2.0 * pattern.ramp_s
        case WindowedSine():
            return 2.0 * pattern.centre_s
        case DynamicPattern():
            return 2.0 * pattern.half_width_s * pattern.repeats
        case MultiSine():
            return pattern.duration_s


def waveform(pattern: Pattern, origin_rad: float, t_s: Array) -> Waveform:
    """Sample a pattern at the times `t_s` (samples,) since its start, 0 <= t <= duration, ascending."""
    match pattern:
        case Rest():
            return Waveform(np.zeros_like(t_s), np.zeros_like(t_s))
        case GoTo():
            return minimum_jerk(pattern.target_rad - origin_rad, duration_s(pattern, origin_rad), t_s)
        case ConstantMotion():
            return _constant(pattern, t_s)
        case WindowedSine():
            return _windowed_sine(pattern, t_s)
        case DynamicPattern():
            return _dynamic(pattern, t_s)
        case MultiSine():
            return _multi_sine(pattern, t_s)


def minimum_jerk_duration_s(travel_rad: float, max_speed_rad_s: float) -> float:
    """Return how long a minimum-jerk path of |travel_rad| takes whose peak speed is `max_speed_rad_s`."""
    return max(MINIMUM_JERK_PEAK * travel_rad / max_speed_rad_s, MIN_GOTO_S)


def minimum_jerk(travel_rad: float, total_s: float, t_s: ArrayLike) -> Waveform:
    """Return x(s) = travel (10 s^3 - 15 s^4 + 6 s^5), s = t / total, and its rate (Flash and Hogan, 1985).

    Before 0 and after `total_s` the path stands still at its ends.
    """
    s = np.clip(np.asarray(t_s) / total_s, 0.0, 1.0)
    return Waveform(
        travel_rad * s**3 * (10.0 - 15.0 * s + 6.0 * s**2),
        travel_rad / total_s * 30.0 * s**2 * (1.0 - s) ** 2,
    )


def _constant(pattern: ConstantMotion, t_s: Array) -> Waveform:
    ramp, top = pattern.ramp_s, pattern.ramp_s + pattern.duration_s
    knots = np.array([0.0, ramp, top, top + ramp])
    velocity = pattern.velocity_rad_s * np.interp(t_s, knots, [0.0, 1.0, 1.0, 0.0])
    # The integral of a trapezoid, piece by piece.
    rising = np.minimum(t_s, ramp) ** 2 / (2.0 * ramp) if ramp else np.zeros_like(t_s)
    level = np.clip(t_s - ramp, 0.0, pattern.duration_s)
    falling = np.clip(t_s - top, 0.0, ramp)
    fall = falling - falling**2 / (2.0 * ramp) if ramp else np.zeros_like(t_s)
    return Waveform(pattern.velocity_rad_s * (rising + level + fall), velocity)


def taper(t_s: Array, total_s: float) -> tuple[Array, Array]:
    """Return a cosine taper, 0 at both ends and 1 between, and its time derivative."""
    rise = TAPER_SHARE * total_s
    edge = np.minimum(np.minimum(t_s, total_s - t_s), rise)
    phase = np.pi * edge / rise
    sign = np.where(t_s < 0.5 * total_s, 1.0, -1.0)
    inside = edge < rise
    return 0.5 * (1.0 - np.cos(phase)), np.where(inside, sign * 0.5 * np.pi / rise * np.sin(phase), 0.0)


def _window(t_s: Array, half_s: float, sigma_s: float) -> tuple[Array, Array]:
    """Return a Gaussian about the middle of 2 `half_s`, tapered to zero at the ends, and its derivative."""
    s = t_s - half_s
    edge, edge_rate = taper(t_s, 2.0 * half_s)
    window = np.exp(-(s**2) / (2.0 * sigma_s**2))
    return window * edge, window * (-s / sigma_s**2) * edge + window * edge_rate


def _windowed_sine(pattern: WindowedSine, t_s: Array) -> Waveform:
    omega = 2.0 * np.pi * pattern.frequency_hz
    window, window_rate = _window(t_s, pattern.centre_s, pattern.sigma_s)
    wave = pattern.amplitude * window * np.sin(omega * t_s)
    if pattern.of == "velocity":
        steps = 0.5 * (wave[1:] + wave[:-1]) * np.diff(t_s)
        return Waveform(np.concatenate(([0.0], np.cumsum(steps))), wave)
    rate = pattern.amplitude * (window_rate * np.sin(omega * t_s) + window * omega * np.cos(omega * t_s))
    return Waveform(wave, rate)


def _dynamic(pattern: DynamicPattern, t_s: Array) -> Waveform:
    width = 2.0 * pattern.half_width_s
    count = np.minimum(np.floor(t_s / width), pattern.repeats - 1)
    inside = t_s - count * width
    s = inside - pattern.half_width_s
    sign = np.where(count % 2 == 1, -1.0, 1.0) if pattern.alternate else 1.0
    omega = 2.0 * np.pi * pattern.frequency_hz
    window, window_rate = _window(inside, pattern.half_width_s, pattern.sigma_s)
    scale = sign * pattern.amplitude_rad
    return Waveform(
        scale * window * np.sin(omega * s),
        scale * (window_rate * np.sin(omega * s) + window * omega * np.cos(omega * s)),
    )


def _multi_sine(pattern: MultiSine, t_s: Array) -> Waveform:
    amplitude = np.array([sine.amplitude_rad for sine in pattern.sines])
    omega = 2.0 * np.pi * np.array([sine.frequency_hz for sine in pattern.sines])
    phase = t_s[:, None] * omega
    window, window_rate = taper(t_s, pattern.duration_s)
    wave, rate = np.sin(phase) @ amplitude, np.cos(phase) @ (amplitude * omega)
    return Waveform(window * wave, window_rate * wave + window * rate)

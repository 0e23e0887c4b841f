"""Motion patterns are what the thesis writes, begin and end at rest, and their velocity is the derivative."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from module_agent.control.waveform import Array, Waveform, duration_s, waveform
from module_agent.wire.messages import (
    ConstantMotion,
    DynamicPattern,
    GoTo,
    MultiSine,
    Pattern,
    Rest,
    Sine,
    WindowedSine,
)

PATTERNS: list[Pattern] = [
    Rest(duration_s=1.0),
    GoTo(target_rad=1.3, max_speed_rad_s=0.7),
    GoTo(target_rad=-2.0, max_speed_rad_s=1.4),
    ConstantMotion(velocity_rad_s=-1.0, duration_s=0.75),
    ConstantMotion(velocity_rad_s=0.6, duration_s=0.5, ramp_s=0.0),
    WindowedSine(amplitude=0.09),
    WindowedSine(amplitude=1.0, of="velocity", frequency_hz=3.0),
    DynamicPattern(amplitude_rad=0.2),
    DynamicPattern(amplitude_rad=0.4, frequency_hz=0.7, sigma_s=0.5, half_width_s=1.0, alternate=True),
    MultiSine(
        sines=(Sine(amplitude_rad=0.25, frequency_hz=0.3), Sine(amplitude_rad=0.05, frequency_hz=2.0)),
        duration_s=5.0,
    ),
]


def sampled(pattern: Pattern, step_s: float = 1e-4) -> tuple[Array, Waveform]:
    t = np.arange(0.0, duration_s(pattern, 0.5), step_s)
    return t, waveform(pattern, 0.5, t)


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda p: p.kind)
def test_velocity_is_the_derivative_of_position(pattern: Pattern) -> None:
    t, motion = sampled(pattern)
    numeric = np.gradient(motion.offset_rad, t)
    # The second-order error of central differences at 0.1 ms; corners of a rampless motion are left out.
    inner = slice(5, -5)
    assert np.abs(numeric[inner] - motion.velocity_rad_s[inner]).max() < 2e-3


SMOOTH = [p for p in PATTERNS if getattr(p, "ramp_s", 1.0) > 0]


@pytest.mark.parametrize("pattern", SMOOTH, ids=lambda p: p.kind)
def test_a_motion_begins_and_ends_at_rest(pattern: Pattern) -> None:
    total = duration_s(pattern, 0.5)
    ends = waveform(pattern, 0.5, np.array([0.0, total]))
    assert ends.velocity_rad_s == pytest.approx([0.0, 0.0], abs=1e-9)
    assert ends.offset_rad[0] == pytest.approx(0.0, abs=1e-12)


def test_goto_arrives_and_keeps_its_speed_limit() -> None:
    pattern = GoTo(target_rad=1.3, max_speed_rad_s=0.7)
    _, motion = sampled(pattern)
    total = duration_s(pattern, 0.5)
    assert waveform(pattern, 0.5, np.array([total])).offset_rad[0] == pytest.approx(0.8)
    assert np.abs(motion.velocity_rad_s).max() == pytest.approx(0.7, rel=1e-4)


def test_constant_motion_is_constant_and_covers_its_distance() -> None:
    pattern = ConstantMotion(velocity_rad_s=1.0, duration_s=0.75, ramp_s=0.15)
    t, motion = sampled(pattern)
    level = (t > 0.15) & (t < 0.9)
    assert motion.velocity_rad_s[level] == pytest.approx(1.0)
    assert motion.offset_rad[-1] == pytest.approx(0.9, abs=1e-3)


def test_the_windowed_sine_is_eq_14_where_the_taper_is_one() -> None:
    pattern = WindowedSine(amplitude=0.09, frequency_hz=2.0, centre_s=2.8, sigma_s=1.0)
    t, motion = sampled(pattern)
    middle = (t > 0.85) & (t < 4.75)
    expected = np.exp(-((t - 2.8) ** 2) / 2.0) * 0.09 * np.sin(2 * np.pi * 2.0 * t)
    assert motion.offset_rad[middle] == pytest.approx(expected[middle], abs=1e-12)


def test_a_velocity_amplitude_bounds_the_velocity() -> None:
    _, motion = sampled(WindowedSine(amplitude=1.0, of="velocity"))
    assert np.abs(motion.velocity_rad_s).max() == pytest.approx(1.0, rel=0.02)


def test_the_dynamic_pattern_repeats_the_steep_part() -> None:
    pattern = DynamicPattern(amplitude_rad=0.2, repeats=3)
    t, motion = sampled(pattern, 1e-3)
    period = motion.offset_rad[:1000]
    assert motion.offset_rad[1000:2000] == pytest.approx(period, abs=1e-9)
    # Table 6: the steepest slope is in the middle, A 2 pi f.
    assert motion.velocity_rad_s.max() == pytest.approx(0.2 * 2 * np.pi, rel=1e-3)
    assert np.argmax(period) > 500 > np.argmin(period)
    assert t[-1] == pytest.approx(3.0, abs=2e-3)


def test_an_alternating_pattern_mirrors_every_second_time() -> None:
    pattern = DynamicPattern(amplitude_rad=0.2, repeats=2, alternate=True)
    _, motion = sampled(pattern, 1e-3)
    assert motion.offset_rad[1000:2000] == pytest.approx(-motion.offset_rad[:1000], abs=1e-9)


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(0.05, 9.0))
def test_goto_never_overshoots(origin: float, target: float, speed: float) -> None:
    pattern = GoTo(target_rad=target, max_speed_rad_s=speed)
    t = np.linspace(0.0, duration_s(pattern, origin), 200)
    position = origin + waveform(pattern, origin, t).offset_rad
    low, high = min(origin, target), max(origin, target)
    assert position.min() >= low - 1e-9
    assert position.max() <= high + 1e-9


def test_a_multi_sine_is_the_sum_of_its_sines_where_the_taper_is_one() -> None:
    sines = (Sine(amplitude_rad=0.25, frequency_hz=0.3), Sine(amplitude_rad=0.05, frequency_hz=2.0))
    t, motion = sampled(MultiSine(sines=sines, duration_s=5.0))
    middle = (t > 0.76) & (t < 4.24)
    slow, fast = (s.amplitude_rad * np.sin(2 * np.pi * s.frequency_hz * t) for s in sines)
    expected = slow + fast
    np.testing.assert_allclose(motion.offset_rad[middle], expected[middle], atol=1e-12)

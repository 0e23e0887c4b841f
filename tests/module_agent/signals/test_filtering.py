"""The low-pass, the derivative and the common time base keep what the torque equation needs."""

import subprocess
import sys

import numpy as np
import pytest
from numpy.random import Generator
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter, sosfiltfilt

from module_agent.model.errors import DataError
from module_agent.signals.filtering import (
    FILTER_ORDER,
    SHORT,
    differentiate,
    filtered_motion,
    leaky_sum,
    resample,
    settling_samples,
    zero_phase_low_pass,
)

RATE_HZ = 250.0


def seconds(duration_s: float) -> np.ndarray:
    return np.arange(round(duration_s * RATE_HZ)) / RATE_HZ


def test_slow_motion_passes_with_neither_loss_nor_delay() -> None:
    t = seconds(4.0)
    slow = np.sin(2 * np.pi * 2.0 * t)
    edge = settling_samples(RATE_HZ, 10.0)
    error = (zero_phase_low_pass(slow, RATE_HZ, 10.0) - slow)[edge:-edge]
    # The gain at a fifth of the cut-off is 1 - (1/5)^8 = 1 - 2.6e-6; the rest is what the ends still ring.
    assert np.abs(error).max() < 1e-4


def test_half_the_amplitude_is_left_at_the_cutoff() -> None:
    t = seconds(8.0)
    tone = np.sin(2 * np.pi * 20.0 * t)
    passed = zero_phase_low_pass(tone, RATE_HZ, 20.0)[500:1500]
    assert passed @ tone[500:1500] / (tone[500:1500] @ tone[500:1500]) == pytest.approx(0.5, abs=1e-3)


def test_noise_above_the_cutoff_is_gone() -> None:
    t = seconds(4.0)
    fast = np.sin(2 * np.pi * 60.0 * t)
    assert np.abs(zero_phase_low_pass(fast, RATE_HZ, 10.0)[200:800]).max() < 1e-3


@pytest.mark.parametrize("cutoff_hz", [0.0, 125.0, -1.0])
def test_a_cutoff_beyond_half_the_rate_is_refused(cutoff_hz: float) -> None:
    with pytest.raises(DataError, match=r"outside 0 to 125\.0"):
        zero_phase_low_pass(np.zeros(1000), RATE_HZ, cutoff_hz)


def test_the_derivative_of_a_sine_is_its_cosine() -> None:
    t = seconds(2.0)
    rate = 2 * np.pi * 25.0
    found = differentiate(np.column_stack([np.sin(rate * t), np.cos(rate * t)]), RATE_HZ)[20:-20]
    expected = rate * np.column_stack([np.cos(rate * t), -np.sin(rate * t)])[20:-20]
    # A tenth of the sampling rate: the spline's derivative is short by (w h)^4 / 180 = 0.09 %.
    assert np.abs(found - expected).max() < 1.5e-3 * rate


@pytest.mark.parametrize("samples", [2, 3, SHORT, SHORT + 1])
def test_the_slopes_of_signals_of_any_length_are_those_of_their_spline(rng: Generator, samples: int) -> None:
    signal = rng.normal(size=(samples, 2, 3))
    t = np.arange(samples) / RATE_HZ
    # 256 products of numbers of up to 250 / s.
    assert np.abs(differentiate(signal, RATE_HZ) - CubicSpline(t, signal)(t, 1)).max() < 1e-9


def test_what_is_no_number_has_no_slope() -> None:
    with pytest.raises(ValueError, match="finite"):
        differentiate(np.array([0.0, np.nan, 1.0]), RATE_HZ)


def test_clocks_that_drift_apart_come_onto_one_time_base(rng: Generator) -> None:
    start = 1_700_000_000_000_000_000
    t_ns = [
        start + np.cumsum(rng.integers(3_900_000, 4_100_000, 600)) + offset for offset in (0, -1_234_567, 999)
    ]
    signals = [np.sin(2 * np.pi * 5.0 * (t - start) / 1e9) for t in t_ns]
    common = start + 40_000_000 + 4_000_000 * np.arange(500)
    expected = np.sin(2 * np.pi * 5.0 * (common - start) / 1e9)
    cubic = resample(t_ns, signals, common)
    assert cubic.shape == (500, 3)
    # (w h)^4 * 5 / 384 with w h = 0.13.
    assert np.abs(cubic - expected[:, None]).max() < 1e-5


def test_nothing_is_extrapolated_and_no_hole_is_bridged_in_silence() -> None:
    t = np.arange(100) * 4_000_000
    x = np.zeros(100)
    with pytest.raises(DataError, match="column 1 has samples from 4000000 to 396000000 ns"):
        resample([t, t[1:]], [x, x[1:]], t)
    with pytest.raises(DataError, match=r"column 0 has a hole of 64\.0 ms before sample 30"):
        resample([np.delete(t, slice(30, 45))], [np.delete(x, slice(30, 45))], t)
    with pytest.raises(DataError, match="time of sample 3 is not after"):
        resample([t[[0, 1, 3, 2, 4]]], [x[:5]], t[:2])


@pytest.mark.parametrize("with_velocity", [True, False])
def test_the_same_filter_on_both_sides_leaves_the_inertia_unbiased(
    rng: Generator, with_velocity: bool
) -> None:
    # An inertia and a damper under a motion with content up to the cut-off: filtering is linear, so the
    # torque equation still holds between the filtered signals although they have lost much of their
    # amplitude.
    t = seconds(12.0)
    q, qd, qdd = np.zeros((3, t.size))
    for f, a in ((1.0, 0.3), (7.0, 0.05), (11.0, 0.02)):
        w = 2 * np.pi * f
        q, qd, qdd = q + a * np.sin(w * t), qd + a * w * np.cos(w * t), qdd - a * w**2 * np.sin(w * t)
    tau = 0.08 * qdd + 0.5 * qd
    t_ns = np.round(t * 1e9).astype(np.int64)
    velocity = qd[:, None] if with_velocity else None
    motion = filtered_motion(t_ns, q[:, None], velocity, tau[:, None], RATE_HZ, 10.0)
    lhs = np.column_stack([motion.qdd_rad_s2[:, 0], motion.qd_rad_s[:, 0]])
    inertia, damping = np.linalg.lstsq(lhs, motion.tau_nm[:, 0], rcond=None)[0]
    assert np.std(motion.qdd_rad_s2) < 0.8 * np.std(qdd)  # the filter did take something
    # The derivative of a cubic spline at 11 Hz is short by (2 pi 11 / 250)^4 / 180 = 0.003 %.
    assert inertia == pytest.approx(0.08, rel=3e-4)
    assert damping == pytest.approx(0.5, rel=3e-4)


def test_the_motion_is_read_only_and_needs_uniform_times() -> None:
    t_ns = 4_000_000 * np.arange(500)
    x = np.zeros((500, 2))
    motion = filtered_motion(t_ns, x, x, x, RATE_HZ, 20.0)
    edge = settling_samples(RATE_HZ, 20.0)
    assert motion.t_ns[0] == 4_000_000 * edge
    assert motion.q_rad.shape == (500 - 2 * edge, 2)
    assert not any(signal.flags.writeable for signal in motion)
    t_ns[100:] += 500_000
    with pytest.raises(DataError, match=r"sample 100 is 500\.0 us off"):
        filtered_motion(t_ns, x, x, x, RATE_HZ, 20.0)


@pytest.mark.parametrize(
    ("samples", "cutoff_hz"), [((400,), 6.0), ((300, 3), 15.0), ((900, 2, 3), 2.0), ((60, 2), 110.0)]
)
def test_the_low_pass_is_the_one_of_scipy(rng: Generator, samples: tuple[int, ...], cutoff_hz: float) -> None:
    signal = 1e3 + np.cumsum(rng.normal(size=samples), axis=0)
    sections = butter(FILTER_ORDER, cutoff_hz, fs=RATE_HZ, output="sos")
    expected = sosfiltfilt(sections, signal, axis=0, padlen=settling_samples(RATE_HZ, cutoff_hz))
    # Both round: by a few bits, more the lower the cut-off, as poles come close to each other.
    np.testing.assert_allclose(zero_phase_low_pass(signal, RATE_HZ, cutoff_hz), expected, rtol=1e-11)


@pytest.mark.parametrize("samples", [1, 2, 500])
def test_a_leaky_sum_goes_on_from_what_was_before(rng: Generator, samples: int) -> None:
    signal, before = rng.normal(size=(samples, 3)), rng.normal(size=3)
    expected, _ = lfilter([1.0], [1.0, -0.8], signal, axis=0, zi=0.8 * before[None])
    np.testing.assert_allclose(leaky_sum(signal, 0.8, before), expected, rtol=1e-13, atol=1e-14)


def test_agents_start_without_what_takes_scipy_longest_to_load() -> None:
    """`scipy.signal` and `scipy.stats` take 0.3 to 0.4 s of 1.1 s in every process."""
    code = "import sys, module_agent.host, sim.commands.run, sim.commands.benchmark; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "module_agent.host" in loaded.split()
    assert not {"scipy.signal", "scipy.stats"} & set(loaded.split())

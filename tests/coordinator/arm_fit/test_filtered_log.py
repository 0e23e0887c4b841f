"""Filtering and thinning: the motion passes, the noise does not, and what was taken away is stated."""

import numpy as np
import pytest
from numpy.random import default_rng

from coordinator.arm_fit.data_file import JointLog
from coordinator.arm_fit.filtered_log import filtered_log, max_samples
from module_agent.model.errors import UsageError

RATE_HZ = 1000.0


def waving(frequency_hz: float, noise: float = 0.0, seconds: float = 8.0) -> JointLog:
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    wave = np.stack([np.sin(2.0 * np.pi * frequency_hz * t), np.cos(2.0 * np.pi * frequency_hz * t)], axis=1)
    return JointLog(RATE_HZ, wave, None, wave + noise * default_rng(2).normal(size=wave.shape), False)


def test_the_motion_passes_and_its_derivatives_are_those_of_the_sine() -> None:
    found = filtered_log(waving(1.0), 10.0)
    w = 2.0 * np.pi
    # At a tenth of the cut-off the low-pass has 1 - 1e-8, the spline at 1000 samples a period less than 1e-9;
    # what is left of its ends after twice the samples that are cut off is 1e-4.
    inner = slice(2 * found.settling, -2 * found.settling)
    np.testing.assert_allclose(found.qdd_rad_s2[inner], -(w**2) * found.q_rad[inner], atol=1e-4 * w**2)
    np.testing.assert_allclose(found.tau_nm, found.q_rad, atol=1e-12)
    # 60 samples a second for 10 Hz.
    assert found.rate_hz == pytest.approx(1000.0 / 16)


def test_the_noise_that_the_low_pass_takes_is_stated() -> None:
    found = filtered_log(waving(1.0, noise=0.5), 10.0)
    # White noise of 0.5 on a torque of rms 0.707; a fiftieth of it stays below 10 of 500 Hz.
    expected = 0.5 * np.sqrt(1.0 - 10.0 / 500.0) / np.hypot(np.sqrt(0.5), 0.5)
    assert found.noise == pytest.approx(expected, rel=0.02)
    assert np.std(found.tau_raw_nm - found.tau_nm) == pytest.approx(0.5, rel=0.1)


def test_what_is_made_of_the_fine_signals_is_filtered_as_the_torque_is() -> None:
    log = waving(1.0)
    square = np.sign(np.diff(log.q_rad, axis=0, append=log.q_rad[-1:]))
    found = filtered_log(log._replace(tau_nm=square), 10.0)
    again = found.low_passed([np.sign(piece) for piece in found.fine_qd_rad_s])
    # The sign of a forward difference turns up to a sample of 1 ms early, on a slope of about 40 a second.
    inner = slice(found.settling, -found.settling)
    np.testing.assert_allclose(again[inner], found.tau_nm[inner], atol=0.05)
    # Without the low-pass the sign is off by all of its height at the reversals.
    assert np.abs(np.sign(found.qd_rad_s) - found.tau_nm)[inner].max() > 0.5


def test_a_long_recording_is_thinned_until_it_fits() -> None:
    whole, some = (filtered_log(waving(1.0), 10.0, most) for most in (None, 100))
    assert len(whole.q_rad) > 400
    assert 90 <= len(some.q_rad) <= 100
    # It is the same motion, at the stated rate.
    speed = np.gradient(some.q_rad[:, 0]) * some.rate_hz
    assert np.abs(speed).max() == pytest.approx(np.abs(some.qd_rad_s[:, 0]).max(), rel=0.2)
    square = np.sign(some.fine_qd_rad_s[0])
    assert len(some.low_passed([square])) == len(some.q_rad)
    assert max_samples(7) > 10_000


def test_the_ends_are_lost_once_and_pieces_are_filtered_by_themselves() -> None:
    log = waving(1.0)
    found = filtered_log(log, 10.0)
    # Two periods of the cut-off at either end.
    assert len(found.q_rad) == pytest.approx((8.0 - 0.4) * found.rate_hz, abs=1)
    gap = np.r_[0:3000, 3400:4000, 4100:8000]
    pieces = log._replace(q_rad=log.q_rad[gap], tau_nm=log.tau_nm[gap], breaks=(3000, 3600))
    holed = filtered_log(pieces, 10.0)
    assert len(holed.q_rad) == pytest.approx((3.0 + 0.6 + 3.9 - 3 * 0.4) * found.rate_hz, abs=3)
    # Nothing of the step at a hole reaches a speed; the ends of the low-pass leave 1 %.
    assert np.abs(holed.qd_rad_s).max() == pytest.approx(2.0 * np.pi, rel=0.02)
    assert filtered_log(pieces, 5.0).dropped_s == pytest.approx(0.6, abs=0.002)


def test_a_recording_too_short_for_its_cut_off_is_refused() -> None:
    with pytest.raises(UsageError, match="the low-pass unsettles 4000 each"):
        filtered_log(waving(1.0, seconds=1.0), 1.0)

"""The one prior of IMUs and links covers the modules that the simulator draws."""

import numpy as np
import pytest

from coordinator.batch_estimation.imu_intrinsics import SIZE
from module_agent.model import imu_prior
from module_agent.model.imu_prior import CALIBRATED, UNCALIBRATED
from sim.imperfections.noise_profile import NOISE_PROFILES


@pytest.mark.parametrize(("name", "prior"), [("x5", CALIBRATED), ("x5-uncalibrated", UNCALIBRATED)])
def test_a_prior_is_as_wide_as_the_modules_of_its_profile(name: str, prior: imu_prior.ImuPrior) -> None:
    profile = NOISE_PROFILES[name]
    assert profile.gyro_bias_rad_s <= prior.gyro_bias_rad_s
    assert profile.accel_bias_m_s2 <= prior.accel_bias_m_s2
    assert profile.gyro_g_sensitivity_s_m <= prior.g_sensitivity_s_m
    assert max(profile.gyro_scale, profile.accel_scale) <= prior.scale
    assert profile.imu_misalignment_rad <= 1.01 * prior.misalignment_rad
    assert np.hypot(profile.imu_place_m, profile.housing_axis_m) <= 1.01 * prior.place_m
    assert np.hypot(profile.imu_mounting_rad, profile.housing_axis_rad) <= prior.mounting_rad


def test_the_delay_covers_low_passes_of_40_to_200_hz_and_none() -> None:
    for corner_hz, sigmas in ((92.0, 0.1), (40.0, 2.2), (200.0, 1.0), (np.inf, 1.7)):
        # Group delay at zero frequency of a second-order Butterworth low-pass: sqrt(2) / (2 pi f).
        delay_s = np.sqrt(2.0) / (2.0 * np.pi * corner_hz)
        assert abs(delay_s - imu_prior.DELAY_S) < sigmas * imu_prior.DELAY_SIGMA_S


def test_the_sigmas_are_those_of_the_vector_of_errors() -> None:
    assert UNCALIBRATED.sigmas.shape == (SIZE,)
    assert UNCALIBRATED.sigmas[24] == imu_prior.DELAY_RMS_S

"""The IMU against what others made: Allan deviation, digital filters, rotations; and its sizes."""

from typing import Any

import allantools
import numpy as np
import pytest
from scipy import signal
from scipy.spatial.transform import Rotation

from sim.imperfections.noise_profile import NOISE_PROFILES, NoiseProfile, switched
from sim.sensors.imu import butterworth

NOTHING = NoiseProfile(name="nothing")
X5 = NOISE_PROFILES["x5"]
G = 9.81
MANY = tuple(f"m{i}" for i in range(400))


def only(*effects: str) -> NoiseProfile:
    return switched(NOTHING, on=effects)


def imu(samples: np.ndarray) -> np.ndarray:
    return samples[..., -7:-1]


def allan(records: np.ndarray, rate_hz: float, taus_s: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the averaging times and the root of the mean Allan variance of all records (T, ...)."""
    variances = []
    for record in records.reshape(len(records), -1).T:
        found, deviation, _, _ = allantools.oadev(record, rate=rate_hz, data_type="freq", taus=taus_s)
        variances.append(deviation**2)
    return found, np.sqrt(np.mean(variances, axis=0))


def test_white_noise_has_the_allan_deviation_of_the_profile_and_its_slope(bench: Any) -> None:
    samples = imu(bench(only("imu-white"), imu_ticks=1, tick_ns=4_000_000).read(20_000))
    taus = [0.004, 0.02, 0.1, 0.5, 2.0]
    for axes, sigma in ((slice(0, 3), X5.gyro_white_rad_s), (slice(3, 6), X5.accel_white_m_s2)):
        found, deviation = allan(samples[..., axes], 250.0, taus)
        # Six records of 80 s: 240 independent pairs at 2 s, so 4.6 % at one sigma, and far less below.
        np.testing.assert_allclose(deviation, sigma / np.sqrt(found * 250.0), rtol=0.15)
        np.testing.assert_allclose(deviation[:3], sigma / np.sqrt(found[:3] * 250.0), rtol=0.03)
        assert np.polyfit(np.log(found[:3]), np.log(deviation[:3]), 1)[0] == pytest.approx(-0.5, abs=0.02)


def test_noise_of_a_faster_output_grows_with_the_root_of_its_rate(bench: Any) -> None:
    fast = imu(bench(only("imu-white"), imu_ticks=1).read(8000))
    # 48000 draws per sensor: one sigma of the deviation is 0.3 %.
    assert fast[..., :3].std() == pytest.approx(2.0 * X5.gyro_white_rad_s, rel=0.02)
    assert (fast[..., 3:] - np.array([0, 0, G])).std() == pytest.approx(2.0 * X5.accel_white_m_s2, rel=0.02)


def markov_allan(tau_s: np.ndarray, sigma: float, time_s: float) -> np.ndarray:
    """Return the Allan deviation of a first-order Gauss-Markov process (IEEE Std 952-1997, eq. C.19)."""
    decay = np.exp(-tau_s / time_s)
    bracket = 1.0 - time_s / (2.0 * tau_s) * (3.0 - 4.0 * decay + decay**2)
    return np.asarray(sigma * np.sqrt(2.0 * time_s / tau_s * bracket))


def test_drift_has_the_allan_deviation_of_a_gauss_markov_process(bench: Any) -> None:
    # 4 hours of 2 samples per second; white noise at that rate is left in, and is below a tenth from 20 s on.
    serials = tuple("abcdefgh")
    samples = imu(
        bench(only("imu-drift", "imu-white"), serials, imu_ticks=1, tick_ns=500_000_000).read(28_800)
    )
    taus = [20.0, 60.0, 200.0, 600.0]
    for axes, drift, white in (
        (slice(0, 3), X5.gyro_drift_rad_s, X5.gyro_white_rad_s),
        (slice(3, 6), X5.accel_drift_m_s2, X5.accel_white_m_s2),
    ):
        found, deviation = allan(samples[..., axes], 2.0, taus)
        expected = np.hypot(markov_allan(found, drift, 100.0), white / np.sqrt(found * 250.0))
        # 24 records of 14400 s: at 600 s some 570 independent differences, one sigma 3 %.
        np.testing.assert_allclose(deviation, expected, rtol=0.12)
        assert deviation[2] > 0.55 * drift


def test_drift_is_in_its_steady_state_from_the_first_reading(bench: Any) -> None:
    first = imu(bench(only("imu-drift"), MANY).read(1))[0]
    # 1200 draws: one sigma of the deviation is 2 %.
    assert first[:, :3].std() == pytest.approx(X5.gyro_drift_rad_s, rel=0.09)
    assert (first[:, 3:] - np.array([0, 0, G])).std() == pytest.approx(X5.accel_drift_m_s2, rel=0.09)


def test_steps_round_to_the_nearest_of_sixteen_bits(bench: Any) -> None:
    steps = only("imu-steps", "imu-white")
    fine, coarse = (
        imu(bench(p, imu_ticks=1).read(2000, gyro=0.1)) for p in (switched(steps, off=("imu-steps",)), steps)
    )
    step = np.array([X5.gyro_step_rad_s] * 3 + [X5.accel_step_m_s2] * 3)
    np.testing.assert_allclose(coarse / step, np.rint(coarse / step), atol=1e-9)
    error = coarse - fine
    assert np.all(np.abs(error) <= step / 2 * (1 + 1e-9))
    # The noise is as large as a step of the gyro, which spreads the rounding evenly; 12000 draws.
    assert error[..., :3].std() == pytest.approx(step[0] / np.sqrt(12.0), rel=0.04)
    assert 2.0 * X5.gyro_range_rad_s / step[0] == 2**16


def test_readings_stop_at_the_range(bench: Any) -> None:
    turning = np.array([50.0, -50.0, 1.0])
    shaken = np.array([100.0, -100.0, 2.0])
    read = imu(bench(only("imu-range")).read(1, gyro=turning, force=shaken))[0, 0]
    high, far = np.radians(2000.0), 8.0 * 9.80665
    np.testing.assert_allclose(read, [high, -high, 1.0, far, -far, 2.0], rtol=1e-15)


@pytest.mark.parametrize("bandwidth_hz", [5.0, 92.0, 184.0, 400.0])
def test_the_low_pass_is_a_butterworth_filter(bandwidth_hz: float) -> None:
    b0, b1, b2, a1, a2 = butterworth(bandwidth_hz, 1e-3)
    b, a = signal.butter(2, bandwidth_hz, fs=1000.0)
    np.testing.assert_allclose([b0, b1, b2], b, rtol=1e-9)
    np.testing.assert_allclose([1.0, a1, a2], a, rtol=1e-9, atol=1e-12)


def test_all_axes_pass_the_low_pass_before_they_are_sampled(bench: Any) -> None:
    rng = np.random.default_rng(5)
    felt = rng.standard_normal((400, 2, 6)).cumsum(axis=0)
    read = imu(bench(only("imu-bandwidth")).read(400, gyro=felt[..., :3], force=felt[..., 3:]))
    b, a = signal.butter(2, 92.0, fs=1000.0)
    start = signal.lfilter_zi(b, a)[:, None, None] * felt[0]
    expected, _ = signal.lfilter(b, a, felt, axis=0, zi=start)
    # Sampled every fourth tick, then held.
    np.testing.assert_allclose(read, expected[np.arange(400) // 4 * 4], atol=1e-11)


@pytest.mark.parametrize("frequency_hz", [2.0, 40.0, 92.0, 160.0])
def test_a_vibration_comes_through_as_the_filters_frequency_response_says(
    bench: Any, frequency_hz: float
) -> None:
    t = np.arange(2000) * 1e-3
    wave = np.exp(2j * np.pi * frequency_hz * t)
    read = imu(bench(only("imu-bandwidth"), imu_ticks=1).read(2000, gyro=wave.imag[:, None, None]))
    # Whole periods after 0.5 s, when the start is damped by e^-200.
    found = 2j * np.mean(read[1000:, 0, 1] * wave.conj()[1000:])
    _, response = signal.freqz(*signal.butter(2, 92.0, fs=1000.0), worN=[frequency_hz], fs=1000.0)
    assert found == pytest.approx(response[0], abs=1e-9)
    if frequency_hz == 92.0:
        assert abs(found) == pytest.approx(np.sqrt(0.5), rel=1e-9)


def test_slow_motion_comes_late_by_the_group_delay_which_the_stamp_does_not_hide(bench: Any) -> None:
    t = np.arange(200)[:, None, None] * 1e-3
    samples = bench(only("imu-bandwidth"), imu_ticks=1).read(200, gyro=3.0 * t)
    stamped_s = samples[-1, 0, 1] * 1e-9
    assert stamped_s == pytest.approx(0.199, abs=1e-12)
    late_s = stamped_s - imu(samples)[-1, 0, 0] / 3.0
    assert late_s == pytest.approx(np.sqrt(2.0) / (2.0 * np.pi * 92.0), rel=0.05)


def test_constant_errors_are_spread_as_the_profile_says(bench: Any) -> None:
    tried = bench(NOISE_PROFILES["x5-uncalibrated"], MANY).sensors.errors
    # 1200 draws each: one sigma of the deviation is 2 %.
    for errors, gyro, accel in (
        (tried.imu_bias, X5.gyro_bias_rad_s, 0.020 * 9.80665),
        (tried.imu_scale, 0.01, 0.01),
    ):
        assert errors[:, :3].std() == pytest.approx(gyro, rel=0.09)
        assert errors[:, 3:].std() == pytest.approx(accel, rel=0.09)
    turns = Rotation.from_matrix(tried.misalignment.reshape(-1, 3, 3)).as_rotvec().reshape(400, 2, 3)
    for sensor in (0, 1):
        assert turns[:, sensor].std() == pytest.approx(np.radians(1.0), rel=0.09)


def test_no_constant_error_of_a_module_tells_of_another(bench: Any) -> None:
    errors = bench(NOISE_PROFILES["poor"], MANY).sensors.errors
    straight, oblique = (
        bench(only(name), MANY).sensors.errors.misalignment for name in ("imu-misalignment", "imu-skew")
    )
    turns = Rotation.from_matrix(straight.reshape(-1, 3, 3)).as_rotvec()
    drawn = np.hstack(
        [
            errors.imu_bias,
            errors.imu_scale,
            turns.reshape(400, 6),
            oblique[..., [1, 2, 2], [0, 0, 1]].reshape(400, 6),
            errors.g_sensitivity.reshape(400, 9),
            errors.effort_offset_nm[:, None],
            errors.effort_scale[:, None],
        ]
    )
    correlation = np.corrcoef(drawn, rowvar=False) - np.eye(35)
    # One sigma for 400 modules is 0.05; the largest of 595 pairs is at four of them.
    assert np.abs(correlation).max() < 0.25


def test_misaligned_axes_stay_at_right_angles_unless_they_are_skewed(bench: Any) -> None:
    straight = bench(only("imu-misalignment"), MANY).sensors.errors.misalignment
    np.testing.assert_allclose(
        straight @ np.swapaxes(straight, -1, -2), np.broadcast_to(np.eye(3), straight.shape), atol=1e-12
    )
    oblique = bench(only("imu-skew"), MANY).sensors.errors.misalignment
    angles = (oblique @ np.swapaxes(oblique, -1, -2))[..., [1, 2, 2], [0, 0, 1]]
    # 2400 draws: one sigma of the deviation is 1.4 %; second-order terms are 0.5 %.
    assert angles.std() == pytest.approx(0.005, rel=0.07)


def test_readings_follow_from_the_published_errors(bench: Any) -> None:
    rng = np.random.default_rng(7)
    tried = bench(only("imu-bias", "imu-scale", "imu-misalignment", "imu-skew", "g-sensitivity"), MANY[:5])
    gyro, force = rng.standard_normal((2, 5, 3))
    read = imu(tried.read(1, gyro=gyro, force=force))[0]
    errors = tried.sensors.errors
    for i in range(5):
        turned = errors.misalignment[i, 0] @ gyro[i]
        expected = np.diag(1.0 + errors.imu_scale[i, :3]) @ turned + errors.g_sensitivity[i] @ force[i]
        np.testing.assert_allclose(read[i, :3], expected + errors.imu_bias[i, :3], atol=1e-14)
        felt = np.diag(1.0 + errors.imu_scale[i, 3:]) @ errors.misalignment[i, 1] @ force[i]
        np.testing.assert_allclose(read[i, 3:], felt + errors.imu_bias[i, 3:], atol=1e-14)


def test_a_misaligned_accelerometer_sees_gravity_turned_the_other_way(bench: Any) -> None:
    tried = bench(only("imu-misalignment"), MANY[:20])
    felt = imu(tried.read(1))[0, :, 3:]
    axes = Rotation.from_matrix(tried.sensors.errors.misalignment[:, 1])
    np.testing.assert_allclose(axes.inv().apply(felt), np.broadcast_to([0, 0, G], (20, 3)), atol=1e-12)


def test_a_gyro_turned_over_in_gravity_shows_its_g_sensitivity(bench: Any) -> None:
    tried = bench(only("g-sensitivity", "imu-bias"), MANY)
    columns = []
    for axis in np.eye(3):
        up, down = (imu(tried.read(4, force=sign * G * axis))[0, :, :3] for sign in (1.0, -1.0))
        columns.append((up - down) / (2.0 * G))
    found = np.stack(columns, axis=-1)
    np.testing.assert_allclose(found, tried.sensors.errors.g_sensitivity, atol=1e-15)
    # 3600 draws: one sigma of the deviation is 1.2 %. A tenth of a degree per second and g.
    assert found.std() == pytest.approx(np.radians(0.1) / 9.80665, rel=0.06)


@pytest.mark.parametrize(("kind", "factor"), [("X5-1", 1.0), ("X5-9", 1.0), ("X5-9-old", 3.0)])
def test_gears_shake_the_imu_the_more_the_faster_they_turn_and_older_modules_more(
    bench: Any, kind: str, factor: float
) -> None:
    shaken = []
    for share in (0.0, 0.5, -1.0):
        tried = bench(only("vibration"), kind=kind, imu_ticks=1)
        read = imu(tried.read(3000, motor_rad_s=share * tried.kind.max_speed_rad_s))
        shaken.append([read[..., :3].std(), read[..., 3:].std(axis=(0, 1)).mean()])
    np.testing.assert_allclose(shaken[0], 0.0, atol=1e-12)
    # 18000 draws: one sigma of the deviation is 0.5 %.
    full = factor * np.array([X5.vibration_rad_s, X5.vibration_m_s2])
    np.testing.assert_allclose(shaken[1:], [full / 2.0, full], rtol=0.03)


def test_noise_at_rest_is_that_of_a_real_module(bench: Any) -> None:
    # A real X5-1 near standstill: gyro 0.61 to 0.68 mrad/s, accelerometer 9 to 14 mm/s^2, steps included.
    read = imu(bench(X5).read(8000))[::4]
    gyro, accel = read[..., :3].std(axis=0), read[..., 3:].std(axis=0)
    # 2000 readings: one sigma of a deviation is 1.6 %; where a bias lies between two steps of the gyro, which
    # are larger than its noise, its rounding may count for more or less.
    assert np.all((gyro > 0.5e-3) & (gyro < 0.8e-3))
    assert np.all((accel > 9e-3) & (accel < 14e-3))

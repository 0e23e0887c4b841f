"""Encoder, speed estimates and torque sensor: sizes, lags and the loop of the hysteresis."""

from typing import Any

import numpy as np
import pytest
from scipy import signal
from scipy.integrate import solve_ivp

from module_agent.hardware.hardware import SensorSample
from sim.imperfections.noise_profile import NOISE_PROFILES, NoiseProfile, switched

NOTHING = NoiseProfile(name="nothing")
X5 = NOISE_PROFILES["x5"]
FIELDS = SensorSample._fields
COUNT_RAD = 2.0 * np.pi / 2**16
MANY = tuple(f"m{i}" for i in range(400))


def column(samples: np.ndarray, name: str) -> np.ndarray:
    return samples[..., FIELDS.index(name)]


def test_positions_are_whole_encoder_counts_half_a_count_off_at_most(bench: Any) -> None:
    q = np.linspace(0.0, 0.4, 4000)[:, None]
    read = column(bench(switched(NOTHING, on=("encoder",))).read(4000, q_rad=q), "position_rad")
    np.testing.assert_allclose(read / COUNT_RAD, np.rint(read / COUNT_RAD), atol=1e-9)
    assert np.abs(read - q).max() <= COUNT_RAD / 2 * (1 + 1e-9)
    # Spread evenly over a count: its deviation is count / sqrt(12); 4000 points of a sweep give 2 %.
    assert (read - q).std() == pytest.approx(COUNT_RAD / np.sqrt(12.0), rel=0.02)


def sine(frequency_hz: float, ticks: int) -> dict[str, np.ndarray]:
    w, t = 2.0 * np.pi * frequency_hz, np.arange(ticks)[:, None] * 1e-3
    return {
        "q_rad": np.sin(w * t),
        "qd_rad_s": w * np.cos(w * t),
        "motor_rad_s": w * np.cos(w * t),
    }


def lag_s(signal_: np.ndarray, truth: np.ndarray, frequency_hz: float) -> float:
    """Return by how much a sine comes late, by correlation over whole periods."""
    turn = np.exp(-2j * np.pi * frequency_hz * np.arange(len(truth)) * 1e-3)
    return float(np.angle((turn @ truth) / (turn @ signal_)) / (2.0 * np.pi * frequency_hz))


def test_the_velocity_is_the_low_passed_difference_of_the_encoder_readings(bench: Any) -> None:
    profile = NOTHING.model_copy(update={"velocity_bandwidth_hz": 100.0, "position_step_rad": COUNT_RAD})
    samples = bench(profile).read(1000, **sine(3.0, 1000))
    share = 1.0 - np.exp(-2.0 * np.pi * 0.1)
    difference = np.diff(column(samples, "position_rad")[:, 0]) / 1e-3
    velocity = column(samples, "velocity_rad_s")[:, 0]
    expected, _ = signal.lfilter([share], [1.0, share - 1.0], difference, zi=[velocity[0] * (1.0 - share)])
    np.testing.assert_allclose(velocity[1:], expected, atol=1e-9)


def test_velocity_and_motor_speed_are_as_late_as_in_the_log_of_a_real_module(bench: Any) -> None:
    # Recorded at 1 Hz: velocity 1.3 ms (its third harmonic 1.7 ms), motor speed 10.7 ms behind the encoder.
    truth = sine(1.0, 2000)
    samples = bench(switched(NOTHING, on=("velocity-estimate", "motor-speed-estimate"))).read(2000, **truth)
    # One whole period, after the first has damped what the start left.
    late = slice(1000, 2000)
    rate = truth["qd_rad_s"][late, 0]
    assert 1.3e-3 < lag_s(column(samples, "velocity_rad_s")[late, 0], rate, 1.0) < 1.75e-3
    motor = column(samples, "motor_velocity_rad_s")[late, 0] / 1742.22
    assert lag_s(motor, rate, 1.0) == pytest.approx(10.7e-3, abs=1e-3)
    assert np.ptp(motor) == pytest.approx(np.ptp(rate), rel=0.01)


def test_counts_of_the_encoder_are_noise_of_the_velocity(bench: Any) -> None:
    profile = NOTHING.model_copy(update={"velocity_bandwidth_hz": 100.0, "position_step_rad": COUNT_RAD})
    # Ten counts and a bit a tick: the rounding is then evenly spread and white.
    ticks = 8000
    q = np.arange(ticks)[:, None] * 1e-3
    velocity = column(bench(profile).read(ticks, q_rad=q, qd_rad_s=1.0), "velocity_rad_s")[200:]
    share = 1.0 - np.exp(-2.0 * np.pi * 0.1)
    gain = share * np.sqrt(2.0 / (2.0 - share))
    # The rounding errors of successive ticks are not quite independent: a fifth.
    assert velocity.std() == pytest.approx(gain * COUNT_RAD / np.sqrt(12.0) / 1e-3, rel=0.2)
    assert velocity.mean() == pytest.approx(1.0, abs=1e-3)


def test_white_noise_of_velocity_and_torque_has_its_size(bench: Any) -> None:
    profile = NOTHING.model_copy(
        update={
            "velocity_white_rad_s": X5.velocity_white_rad_s,
            "effort_white_fraction": X5.effort_white_fraction,
        }
    )
    samples = bench(profile).read(8000)
    # 16000 draws: one sigma of the deviation is 0.6 %.
    assert column(samples, "velocity_rad_s").std() == pytest.approx(5e-3, rel=0.03)
    assert column(samples, "effort_nm").std() == pytest.approx(0.002 * 13.0, rel=0.03)


def test_offset_and_scale_of_the_torque_sensor_are_spread_as_the_profile_says(bench: Any) -> None:
    tried = bench(switched(NOTHING, on=("torque-calibration",)), MANY, kind="X5-4")
    none, much = (column(tried.read(1, elastic_nm=t), "effort_nm")[0] for t in (0.0, 5.0))
    # 400 draws: one sigma of the deviation is 3.5 %.
    assert none.std() == pytest.approx(0.005 * 7.0, rel=0.15)
    assert ((much - none) / 5.0 - 1.0).std() == pytest.approx(0.02, rel=0.15)
    np.testing.assert_allclose(none, tried.sensors.errors.effort_offset_nm, atol=1e-15)
    np.testing.assert_allclose((much - none) / 5.0 - 1.0, tried.sensors.errors.effort_scale, atol=1e-12)


WIDTH_NM = 0.005 * 13.0
ROUNDING_NM = 0.05 * 13.0


def cycled(bench: Any, torque: np.ndarray) -> np.ndarray:
    """Return what the torque sensor hides, torque minus reading, along a history of torque."""
    samples = bench(switched(NOTHING, on=("torque-hysteresis",)), ("a",)).read(
        len(torque), elastic_nm=torque[:, None]
    )
    return torque - column(samples, "effort_nm")[:, 0]


@pytest.mark.parametrize("amplitude_nm", [0.2, 1.0, 8.0])
def test_the_loop_of_the_torque_has_the_area_of_dahls_law(bench: Any, amplitude_nm: float) -> None:
    torque = amplitude_nm * np.sin(2.0 * np.pi * np.arange(12001) / 2000.0)
    hidden = cycled(bench, torque)
    # The sixth cycle repeats itself, from trough to trough. Its two branches are exponentials.
    loop = slice(9500, 11501)
    half, far = WIDTH_NM / 2.0, np.exp(-2.0 * amplitude_nm / ROUNDING_NM)
    end = half * np.tanh(amplitude_nm / ROUNDING_NM)
    area = 2.0 * (2.0 * amplitude_nm * half - (half + end) * ROUNDING_NM * (1.0 - far))
    # Positive: the reading lags behind the torque. A trapezium rule over 2000 points is good to 1e-5; small
    # amplitudes settle slowly.
    assert np.trapezoid(hidden[loop], torque[loop]) == pytest.approx(area, rel=2e-3)


def test_a_wide_loop_is_as_wide_as_the_profile_says(bench: Any) -> None:
    torque = 8.0 * np.sin(2.0 * np.pi * np.arange(4001) / 2000.0)
    hidden = cycled(bench, torque)
    rising, falling = hidden[2000], hidden[3000]
    assert rising - falling == pytest.approx(WIDTH_NM, rel=1e-4)


def test_the_hysteresis_agrees_with_an_integration_of_dahls_equation(bench: Any) -> None:
    phase = np.arange(3001) / 1000.0

    def torque(t: float | np.ndarray) -> Any:
        return 1.5 * np.sin(2.0 * np.pi * t) + 0.5 * np.sin(6.0 * np.pi * t)

    def slope(t: float, hidden: np.ndarray) -> np.ndarray:
        rate = 2.0 * np.pi * (1.5 * np.cos(2.0 * np.pi * t) + 1.5 * np.cos(6.0 * np.pi * t))
        return (WIDTH_NM / 2.0 - np.sign(rate) * hidden) / ROUNDING_NM * rate

    found = solve_ivp(slope, (0.0, 3.0), [0.0], t_eval=phase, rtol=1e-9, atol=1e-12, max_step=1e-3)
    # A reversal between two samples is seen at the sample: 1.5 (2 pi)^2 (0.5 ms)^2 of torque at most, of
    # which the friction follows a twentieth.
    np.testing.assert_allclose(cycled(bench, torque(phase)), found.y[0], atol=5e-6)


def test_the_loop_does_not_depend_on_how_fast_it_is_run_through(bench: Any) -> None:
    torque = 2.0 * np.sin(2.0 * np.pi * np.arange(4001) / 1000.0)
    # Reversals are at ticks of both histories.
    np.testing.assert_allclose(cycled(bench, torque[::10]), cycled(bench, torque)[::10], atol=1e-14)


def test_the_reading_of_a_torque_that_grows_grows_even_at_the_widest_loop_allowed(bench: Any) -> None:
    profile = NOTHING.model_copy(update={"effort_hysteresis_fraction": 0.05})
    torque = np.concatenate([np.linspace(0.0, -5.0, 500), np.linspace(-5.0, 5.0, 1000)])
    read = column(bench(profile, ("a",)).read(1500, elastic_nm=torque[:, None]), "effort_nm")[:, 0]
    assert np.all(np.diff(read)[500:] > 0.0)
    assert np.all(np.diff(read)[1:499] < 0.0)


def test_jitter_is_the_rate_times_a_time_of_the_size_of_the_profile(bench: Any) -> None:
    ticks = 4000
    t = np.arange(ticks)[:, None] * 1e-3
    samples = bench(switched(NOTHING, on=("sampling-jitter",)), imu_ticks=1).read(
        ticks,
        q_rad=3.0 * t,
        qd_rad_s=3.0,
        elastic_nm=2.0 * t,
        gyro=t[..., None] * 5.0,
        force=t[..., None] * 7.0,
    )
    off_s = (column(samples, "position_rad") - 3.0 * t) / 3.0
    # 8000 draws: one sigma of the deviation is 0.8 %, of the mean 1.1 % of a deviation.
    assert off_s.std() == pytest.approx(2e-5, rel=0.04)
    assert abs(off_s.mean()) < 4.5 * 2e-5 / np.sqrt(8000.0)
    # Independent from tick to tick: the correlation of 8000 pairs is within 0.045 (4 sigma).
    assert abs(np.corrcoef(off_s[1:].ravel(), off_s[:-1].ravel())[0, 1]) < 0.045
    # Encoder and torque are sampled by one board together, the IMU is a chip of its own.
    effort_off_s = (column(samples, "effort_nm") - 2.0 * t) / 2.0
    np.testing.assert_allclose(effort_off_s[1:], off_s[1:], atol=1e-12)
    gyro_off_s = (column(samples, "gyro_x_rad_s") - 5.0 * t) / 5.0
    accel_off_s = (column(samples, "accel_z_m_s2") - 7.0 * t) / 7.0
    np.testing.assert_allclose(gyro_off_s[1:], accel_off_s[1:], atol=1e-12)
    assert gyro_off_s.std() == pytest.approx(2e-5, rel=0.04)
    assert abs(np.corrcoef(gyro_off_s.ravel(), off_s.ravel())[0, 1]) < 0.045


def test_jitter_has_nothing_to_do_with_noise(bench: Any) -> None:
    profile = NOTHING.model_copy(
        update={"sampling_jitter_s": 2e-5, "velocity_white_rad_s": 5e-3, "effort_white_fraction": 0.002}
    )
    q = np.arange(8000)[:, None] * 3e-3
    samples = bench(profile, ("a",)).read(8000, q_rad=q, qd_rad_s=3.0)
    errors = [column(samples, name)[:, 0] for name in ("position_rad", "velocity_rad_s", "effort_nm")]
    errors[0] -= q[:, 0]
    # 8000 pairs: a correlation is within 0.045 (4 sigma).
    assert np.abs(np.corrcoef(errors) - np.eye(3)).max() < 0.045


def test_a_joint_at_rest_knows_no_jitter(bench: Any) -> None:
    samples = bench(switched(NOTHING, on=("sampling-jitter",))).read(100, q_rad=0.3, elastic_nm=1.0)
    assert np.all(column(samples, "position_rad") == 0.3)
    assert np.all(column(samples, "effort_nm") == 1.0)
    assert np.all(column(samples, "accel_z_m_s2") == 9.81)

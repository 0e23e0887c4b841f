"""All sensors together: every effect is there, alone in what it touches, and gone when it is switched off."""

from typing import Any

import numpy as np
import pytest

from module_agent.hardware.hardware import SensorSample
from sim.imperfections.effects import EFFECTS
from sim.imperfections.noise_profile import NOISE_PROFILES, NoiseProfile, noise_profile, switched
from sim.imperfections.random_streams import generator
from sim.sensors.module_clock import module_time
from sim.sensors.sensors import imus_due

FIELDS = SensorSample._fields
IMU = FIELDS[-7:-1]
GYRO, ACCEL = IMU[:3], IMU[3:]
EFFORT = ("effort_nm", "deflection_rad")
# What each effect of sensors and clocks may change in a sample.
TOUCHES: dict[str, tuple[str, ...]] = {
    "imu-white": IMU,
    "imu-bias": IMU,
    "imu-drift": IMU,
    "imu-scale": IMU,
    "imu-misalignment": IMU,
    # The first axis of a sensor is the one that the others are not at right angles with.
    "imu-skew": (*GYRO[1:], *ACCEL[1:]),
    "g-sensitivity": GYRO,
    "imu-bandwidth": IMU,
    "imu-range": IMU,
    "imu-steps": IMU,
    "vibration": IMU,
    "encoder": ("position_rad", "velocity_rad_s"),
    "velocity-estimate": ("velocity_rad_s", "deflection_velocity_rad_s"),
    "motor-speed-estimate": ("motor_velocity_rad_s",),
    "torque-noise": EFFORT,
    "torque-calibration": EFFORT,
    "torque-hysteresis": EFFORT,
    "clock": ("t_ns", "imu_t_ns"),
    "sampling-jitter": ("position_rad", "velocity_rad_s", *EFFORT, *IMU),
}
# Those that add to a reading, whatever else is done to it before converters limit and round it.
ADDED = ("imu-white", "imu-bias", "imu-drift", "g-sensitivity", "vibration", "torque-noise")
NOTHING = NoiseProfile(name="nothing")
TICKS = 240


def motion(ticks: int = TICKS) -> dict[str, np.ndarray]:
    """Return a brisk motion of two modules, with a blow that the converters cannot follow."""
    t = np.arange(ticks)[:, None] * 1e-3 + np.array([0.0, 0.03])
    w = 2.0 * np.pi * 4.0
    axes = np.array([1.0, -0.6, 0.3])
    blow = np.where((t > 0.1) & (t < 0.15), 400.0, 0.0)
    return {
        "q_rad": 0.2 * np.sin(w * t),
        "qd_rad_s": 0.2 * w * np.cos(w * t),
        "motor_rad_s": 0.2 * w * np.cos(w * t + 0.1),
        "elastic_nm": 5.0 * np.sin(w * t),
        "gyro": (3.0 * np.sin(w * t) + blow)[..., None] * axes,
        "force": (9.0 * np.cos(w * t) + blow)[..., None] * axes[::-1] + np.array([0.0, 0.0, 9.81]),
    }


def columns(samples: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    return samples[..., [FIELDS.index(name) for name in names]]


def test_every_effect_of_sensors_and_clocks_is_tried_here() -> None:
    parts = ("IMU", "encoder and torque", "clock")
    assert set(TOUCHES) == {e.name for e in EFFECTS.values() if e.part in parts}


@pytest.mark.parametrize("name", TOUCHES)
def test_an_effect_switched_off_leaves_all_else_as_it_was_to_the_last_bit(bench: Any, name: str) -> None:
    poor = NOISE_PROFILES["poor"]
    having, without = (bench(p).read(TICKS, **motion()) for p in (poor, switched(poor, off=(name,))))
    touched = TOUCHES[name]
    others = tuple(f for f in FIELDS if f not in touched)
    np.testing.assert_array_equal(columns(having, others), columns(without, others))
    for field in touched:
        assert np.any(columns(having, (field,)) != columns(without, (field,))), field


@pytest.mark.parametrize("name", ADDED)
def test_an_added_error_is_the_same_alone_and_among_all_others(bench: Any, name: str) -> None:
    # Without what changes the truth on its way, and without converters, errors of this kind superpose.
    off = ("imu-bandwidth", "sampling-jitter", "imu-range", "imu-steps")
    poor = switched(NOISE_PROFILES["poor"], off=off)
    alone = NOTHING.model_copy(update={f: getattr(poor, f) for f in EFFECTS[name].sizes})
    having, without, only, nothing = (
        columns(bench(p).read(TICKS, **motion()), TOUCHES[name])
        for p in (poor, switched(poor, off=(name,)), alone, NOTHING)
    )
    assert np.ptp(only - nothing) > 1e-4
    # The accelerometer's true values go to 400, of which doubles keep 6e-14.
    np.testing.assert_allclose(having - without, only - nothing, atol=1e-11)


def test_without_any_effect_the_sensors_read_the_truth(bench: Any) -> None:
    truth = motion()
    samples = bench(NOTHING, imu_ticks=1).read(TICKS, **truth)
    for name, field in (("q_rad", "position_rad"), ("qd_rad_s", "velocity_rad_s"), ("elastic_nm", EFFORT[0])):
        np.testing.assert_array_equal(columns(samples, (field,))[..., 0], truth[name])
    np.testing.assert_array_equal(columns(samples, GYRO), truth["gyro"])
    np.testing.assert_array_equal(columns(samples, ACCEL), truth["force"])
    np.testing.assert_allclose(
        columns(samples, ("motor_velocity_rad_s",))[..., 0], 1742.22 * truth["motor_rad_s"], rtol=1e-14
    )


def test_an_added_module_does_not_change_the_readings_of_the_others(bench: Any) -> None:
    few = bench(NOISE_PROFILES["poor"], ("a", "b")).read(600)
    many = bench(NOISE_PROFILES["poor"], ("new", "a", "b")).read(600)
    np.testing.assert_array_equal(few, many[:, 1:])
    assert not np.array_equal(many[:, 0, -7:-1], many[:, 1, -7:-1])
    assert generator(3, "a", "clock").random() != generator(3, "b", "clock").random()


def test_the_same_seed_reads_the_same_and_another_does_not(bench: Any) -> None:
    first, again, other = (bench(NOISE_PROFILES["poor"], seed=s).read(600) for s in (4, 4, 5))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != other)


@pytest.mark.parametrize("name", NOISE_PROFILES)
def test_stamps_are_the_modules_clock_at_the_tick_whatever_the_jitter(bench: Any, name: str) -> None:
    tried = bench(noise_profile(name))
    samples = tried.read(101, q_rad=1.0)
    for i, clock in enumerate(tried.sensors.clocks):
        stamps = samples[:, i, 0]
        np.testing.assert_array_equal(stamps, [module_time(clock, k * 1_000_000) for k in range(101)])
        assert np.all(np.diff(stamps) > 0)
        np.testing.assert_array_equal(samples[:, i, 1], stamps[np.arange(101) // 4 * 4])


def test_the_truth_of_the_imu_is_needed_every_tick_only_by_a_chip_that_looks_between_its_samples(
    bench: Any,
) -> None:
    due = {
        name: [imus_due(bench(noise_profile(name)).sensors.arrays, k) for k in range(8)]
        for name in ("ideal", "x5")
    }
    assert due["ideal"] == [True, False, False, False] * 2
    assert all(due["x5"])


def test_deflection_is_the_reading_of_the_effort_over_the_stiffness(bench: Any) -> None:
    # As in a real module's log, where the ratio is constant to the last digit.
    samples = bench(NOISE_PROFILES["poor"], kind="X5-1").read(TICKS, **motion())
    effort, deflection = np.moveaxis(columns(samples, EFFORT), -1, 0)
    np.testing.assert_allclose(effort, -40.0 * deflection, rtol=1e-12)

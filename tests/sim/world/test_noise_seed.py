"""Another day of the same robot: what its modules are stays, what comes and goes is drawn anew."""

import math

import numpy as np

from module_agent.hardware.hardware import SensorSample
from sim.robot.robot_file import load_robot
from sim.world.world import World


def _trace(noise_seed: int | None, ticks: int = 80) -> np.ndarray:
    world = World(load_robot("a2085_03"), 7, "poor", noise_seed=noise_seed)
    waves = (0.2 * np.sin(2.0 * math.pi * k * 1e-3 + np.arange(3)) for k in range(ticks))
    samples = np.array([[tuple(sample) for sample in world.step(pwm.tolist())] for pwm in waves])
    world.close()
    return samples


def test_another_day_the_modules_have_the_same_errors_and_clocks() -> None:
    first, second = (World(load_robot("a2085_03"), 7, "poor", noise_seed=day) for day in (1, 2))
    for name, value in first.sensors.errors._asdict().items():
        assert np.array_equal(value, getattr(second.sensors.errors, name)), name
    assert first.sensors.clocks == second.sensors.clocks
    first.close()
    second.close()


def test_another_day_the_sensors_noise_is_another() -> None:
    one, again, other = _trace(1), _trace(1), _trace(2)
    assert np.array_equal(one, again)
    # White noise of the accelerometer is 0.035 m/s^2, its resolution 0.002: no axis of any module repeats.
    accel = [SensorSample._fields.index(f"accel_{axis}_m_s2") for axis in "xyz"]
    assert np.all(np.any(one[..., accel] != other[..., accel], axis=0))


def test_without_a_day_the_noise_hangs_on_the_seed() -> None:
    assert np.array_equal(_trace(None), _trace(7))

import math
from collections.abc import Iterator

import numpy as np
import pytest

from module_agent.hardware.hardware import HardwareLost, SensorSample, Wires
from module_agent.model.errors import UsageError
from sim.robot.robot_file import Robot, load_robot, parse_robot
from sim.robot.robot_tree import true_chain
from sim.sensors.module_clock import module_time
from sim.world.world import World

IDEAL_ARM = "a2085_03"


def _imu(samples: list[SensorSample]) -> np.ndarray:
    return np.array([s[-7:-1] for s in samples])


def _waves(world: World, ticks: int, amplitude: float = 0.2) -> Iterator[list[SensorSample]]:
    phase = np.arange(len(world.modules))
    for k in range(ticks):
        yield world.step((amplitude * np.sin(2.0 * math.pi * k * 1e-3 + phase)).tolist())


def _waving(world: World, ticks: int) -> list[list[SensorSample]]:
    return list(_waves(world, ticks))


def test_the_same_seed_and_pwm_give_the_same_samples_bit_by_bit() -> None:
    robot = load_robot("tree_y")
    first, again, other = (World(robot, seed) for seed in (7, 7, 8))
    trace = _waving(first, 600)
    assert _waving(again, 600) == trace
    assert _waving(other, 600) != trace


def test_two_worlds_side_by_side_do_not_feel_each_other() -> None:
    robot = load_robot(IDEAL_ARM)
    alone = _waving(World(robot, 1), 50)
    one, two = World(robot, 1), World(load_robot("arm6"), 2)
    mixed = []
    for k in range(50):
        mixed.append(one.step((0.2 * np.sin(2.0 * math.pi * k * 1e-3 + np.arange(3))).tolist()))
        two.step([0.5] * 6)
    two.close()
    assert mixed == alone


def test_the_imu_is_read_every_fourth_tick_at_the_instant_of_the_position() -> None:
    world = World(load_robot(IDEAL_ARM), seed=1)
    trace = _waving(world, 12)
    for k, samples in enumerate(trace):
        for i, sample in enumerate(samples):
            read = trace[k - k % 4][i]
            assert sample.t_ns == module_time(world.sensors.clocks[i], k * 1_000_000)
            assert sample.imu_t_ns == read.t_ns
            assert sample[-7:-1] == read[-7:-1]
    assert world.modules[0].imu_period_ns == 4_000_000
    assert world.t_ns == 12_000_000


def test_the_imu_rate_can_be_chosen() -> None:
    world = World(load_robot(IDEAL_ARM), seed=1, imu_rate_hz=50.0)
    assert len({samples[0].imu_t_ns for samples in _waving(world, 40)}) == 2
    assert world.modules[0].imu_period_ns == 20_000_000


@pytest.mark.parametrize("rate_hz", [0.0, 300.0, 2000.0, math.nan, math.inf])
def test_an_imu_rate_that_misses_the_ticks_is_refused(rate_hz: float) -> None:
    with pytest.raises(UsageError, match="must be 1000 Hz divided by a whole number"):
        World(load_robot(IDEAL_ARM), seed=1, imu_rate_hz=rate_hz)


@pytest.mark.parametrize("name", ["thesis_484_horizontal", "thesis_350_vertical", "arm6", "snake16"])
def test_every_imu_at_rest_feels_gravity_where_the_true_chain_has_it(name: str) -> None:
    robot = load_robot(name)
    # The start is the only pose that is exactly at rest, and the chain's home only if it starts there.
    still = robot.model_copy(
        update={"modules": tuple(m.model_copy(update={"start_rad": 0.0}) for m in robot.modules)}
    )
    chain = true_chain(still)
    world = World(still, seed=1, noise="ideal")
    felt = _imu(world.step([0.0] * len(robot.modules)))
    wanted = np.einsum("nji,j->ni", chain.imu_home[:, :3, :3], chain.gravity)
    # Unpowered motors begin to give way at once: at most 0.5 rad/s^2 at the end of a metre.
    np.testing.assert_allclose(felt[:, 3:], wanted, atol=0.5)
    np.testing.assert_allclose(felt[:, :3], 0.0, atol=1e-3)


def test_a_single_swing_gives_the_imu_centripetal_tangential_and_gravity_terms() -> None:
    # A one-joint arm is a formula: at radius r, a = (-r w^2, r alpha, 0) in IMU axes, and g lies along z.
    world = World(load_robot("thesis_484_horizontal"), seed=1, noise="ideal")
    rates = []
    for samples in _waves(world, 1200, 0.3):
        plant = world.plant
        if plant.t_ns % 4_000_000 == 0:
            rates.append(plant.qd_rad_s[0])
            w, alpha = plant.qd_rad_s[0], plant.qdd_rad_s2[0]
            expected = [0.0, 0.0, w, -0.484 * w**2, 0.484 * alpha, 9.81]
            np.testing.assert_allclose(_imu(samples)[1], expected, atol=1e-10)
    assert len(rates) == 300
    assert np.ptp(rates) > 0.3


def test_rate_and_acceleration_belong_to_the_instant_of_the_position() -> None:
    world = World(load_robot("thesis_484_vertical"), seed=1, noise="ideal")
    q, w, alpha = [], [], []
    for _ in _waves(world, 1500, 0.3):
        plant = world.plant
        q.append(plant.q_rad[0])
        w.append(plant.qd_rad_s[0])
        alpha.append(plant.qdd_rad_s2[0])
    # Central differences: a shift of half a tick would show as alpha * dt / 2, about 1e-3 rad/s.
    central = (np.array(q[2:]) - np.array(q[:-2])) / 2e-3
    assert np.ptp(w) > 0.3
    np.testing.assert_allclose(w[1:-1], central, atol=1e-9)
    second = (np.array(q[2:]) - 2.0 * np.array(q[1:-1]) + np.array(q[:-2])) / 1e-6
    np.testing.assert_allclose(alpha[1:-1], second, atol=1e-6)


def test_the_gyro_of_a_reversed_module_turns_against_its_own_joint() -> None:
    text = 'name = "r"\n[[module]]\nserial = "one"\ntype = "X5-4"\nparent = "base"\nmounted = "{}"\n'
    for mounted, sign in (("reversed", -1.0), ("forward", 0.0)):
        world = World(parse_robot(text.format(mounted), "r"), seed=1, noise="ideal")
        for _ in range(101):
            (sample,) = world.step([0.3])
        assert sample.velocity_rad_s > 0.5
        assert sample.gyro_z_rad_s == pytest.approx(sign * sample.velocity_rad_s, abs=1e-12)


def test_ideal_sensors_read_the_true_state() -> None:
    world = World(load_robot("arm6"), seed=1, noise="ideal")
    samples = _waving(world, 300)[-1]
    plant = world.plant
    np.testing.assert_array_equal([s.position_rad for s in samples], plant.q_rad)
    np.testing.assert_array_equal([s.velocity_rad_s for s in samples], plant.qd_rad_s)
    # The spring's own loss (1 ms of its rate) is transmitted but not read: below 0.1 Nm here.
    np.testing.assert_allclose([s.effort_nm for s in samples], plant.spring_torque_nm, atol=0.1)
    np.testing.assert_allclose([s.deflection_rad for s in samples], plant.q_rad - plant.motor_rad, atol=1e-12)


def test_a_positive_effort_pushes_the_load_towards_positive_positions() -> None:
    world = World(load_robot("thesis_484_vertical"), seed=1, noise="ideal")
    first = world.step([0.0, 0.0])
    # Hanging, nothing pulls; driven forwards, the output pushes and the arm rises.
    assert first[0].effort_nm == pytest.approx(0.0, abs=0.15)
    for _ in range(300):
        samples = world.step([0.3, 0.0])
    assert samples[0].effort_nm > 0.3
    assert samples[0].position_rad > -math.pi / 2 + 0.1
    assert samples[0].motor_current_a > 0.0
    assert samples[0].motor_velocity_rad_s > 0.0
    assert samples[0].winding_temperature_c > 25.0
    assert samples[0].voltage_v == 24.0


def test_pwm_beyond_one_is_clipped_and_seen_in_the_plant() -> None:
    world = World(load_robot("thesis_171_horizontal"), seed=1)
    world.step([5.0, 0.1])
    np.testing.assert_array_equal(world.plant.pwm, [1.0, 0.1])
    np.testing.assert_allclose(world.plant.duty, [1.0, 0.2])
    assert not world.plant.q_rad.flags.writeable


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_pwm_that_is_no_number_is_refused_by_serial(bad: float) -> None:
    world = World(load_robot("a2085_04"), seed=1)
    with pytest.raises(ValueError, match="elbow"):
        world.step([0.0, 0.0, bad, 0.0])
    assert world.t_ns == 0


def test_one_pwm_per_module_is_needed() -> None:
    with pytest.raises(ValueError, match="3 PWM values for 4 modules"):
        World(load_robot("a2085_04"), seed=1).step([0.0] * 3)


def test_a_world_is_wires_in_process_until_it_is_closed() -> None:
    wires: Wires = (world := World(load_robot(IDEAL_ARM), seed=1))
    assert [m.serial for m in wires.modules] == ["shoulder-yaw", "shoulder-lift", "elbow"]
    wires.exchange([0.1] * 3)
    assert world.t_ns == 1_000_000
    wires.close()
    wires.close()
    with pytest.raises(HardwareLost):
        wires.exchange([0.1] * 3)
    with pytest.raises(HardwareLost, match="closed"):
        world.step([0.0] * 3)


def test_a_world_takes_the_robots_own_noise_unless_told_otherwise() -> None:
    robot: Robot = load_robot(IDEAL_ARM)
    assert any(World(robot, seed=1).sensors.errors.imu_bias.ravel())
    ideal = World(robot, seed=1, noise="ideal")
    assert not any(ideal.sensors.errors.imu_bias.ravel())
    assert [c.offset_ns for c in ideal.sensors.clocks] == [0, 0, 0]
    with pytest.raises(UsageError, match="known are ideal, x5"):
        World(robot, seed=1, noise="quiet")

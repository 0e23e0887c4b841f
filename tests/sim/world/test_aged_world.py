"""A module that ages has more play, a wider loop of hysteresis and other sensor errors, in either engine."""

import numpy as np
import pytest

from module_agent.model.errors import UsageError
from module_agent.model.read_only import read_only
from sim.geometry.pose import Array
from sim.imperfections.ageing import Ageing
from sim.physics.engine import Physics
from sim.robot.robot_file import load_robot
from sim.world.world import World

ARM = load_robot("a2085_03")
FIRST = ARM.serials[0]
ENGINES: tuple[Physics, ...] = ("compiled", "pybullet")
# Back and forth, so that the gear changes flanks and the spring its direction.
DUTY = 0.15 * np.sign(np.sin(np.arange(600) / 40.0))


def efforts(world: World, duty: Array = DUTY) -> Array:
    """Return the first joint's efforts as read (m,) [Nm] while its motor is driven back and forth."""
    read = [world.step([float(u), 0.0, 0.0])[0].effort_nm for u in duty]
    return read_only(np.array(read))


@pytest.mark.parametrize("physics", ENGINES)
def test_play_lets_the_motor_turn_while_the_spring_carries_nothing(physics: Physics) -> None:
    tight, loose = (World(ARM, 0, "ideal", physics=physics) for _ in range(2))
    loose.age(FIRST, Ageing(play_rad=0.05))
    carried = [np.abs(efforts(world)) for world in (tight, loose)]
    idle = [float(np.mean(effort < 1e-9)) for effort in carried]
    assert idle[0] < 0.01
    assert idle[1] > 0.05


def test_play_of_one_engine_is_that_of_the_other() -> None:
    read = []
    for physics in ENGINES:
        world = World(ARM, 0, "ideal", physics=physics)
        world.age(FIRST, Ageing(play_rad=0.01))
        read.append(efforts(world, DUTY[:100]))
    # Across a gap, rounding grows: to a thousandth of the torques.
    np.testing.assert_allclose(read[0], read[1], atol=1e-3 * np.abs(read[0]).max())


def test_hysteresis_is_half_a_loop_of_what_the_spring_carries_at_most() -> None:
    plain, aged = World(ARM, 0, "ideal"), World(ARM, 0, "ideal")
    aged.age(FIRST, Ageing(hysteresis_nm=0.2))
    off = efforts(plain) - efforts(aged)
    # The held torque is the same at first; the loop is on the reading alone, as the motor is not controlled.
    assert 0.02 < np.abs(off).max() <= 0.1 + 1e-9
    assert np.ptp(off) > 0.02


def test_a_torque_sensor_drifts_in_scale_and_offset() -> None:
    plain, aged = World(ARM, 0, "ideal"), World(ARM, 0, "ideal")
    aged.age(FIRST, Ageing(effort_scale=0.1, effort_offset_nm=0.03))
    np.testing.assert_allclose(efforts(aged), 1.1 * efforts(plain) + 0.03, atol=1e-12)


def test_an_imu_drifts_in_bias_and_scale_and_comes_back() -> None:
    plain, aged = World(ARM, 0, "ideal"), World(ARM, 0, "ideal")
    drifted = Ageing(gyro_bias_rad_s=0.01, accel_bias_m_s2=0.2, accel_scale=0.05)
    for ageing, factor, bias in ((drifted, 1.05, 0.2), (Ageing(), 1.0, 0.0)):
        aged.age(FIRST, ageing)
        for _ in range(8):
            one, other = plain.step([0.0] * 3)[0], aged.step([0.0] * 3)[0]
        assert other.accel_z_m_s2 == pytest.approx(factor * one.accel_z_m_s2 + bias, abs=1e-12)
        assert other.gyro_x_rad_s == pytest.approx(one.gyro_x_rad_s + ageing.gyro_bias_rad_s, abs=1e-12)


def test_what_no_module_can_have_is_refused() -> None:
    world = World(ARM, 0, "ideal")
    with pytest.raises(ValueError, match="no module absent"):
        world.age("absent", Ageing())
    for ageing in (Ageing(play_rad=-1e-3), Ageing(effort_scale=float("nan"))):
        with pytest.raises(UsageError, match="of an aged module"):
            world.age(FIRST, ageing)

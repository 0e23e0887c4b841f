"""Changes grow as planned and reach the world; the weather comes back to where it was."""

import numpy as np
import pytest

from sim.benchmark.slow_change import (
    CHANGE_KINDS,
    GROWTHS,
    ChangeKind,
    SlowChange,
    SlowlyChanging,
    Weather,
    draw_change,
    draw_weather,
)
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.world.world import World

ARM = load_robot("a2085_03")
STILL = Weather(3600.0, 0.0, *np.zeros((3, 3)))
ALONG = (1.0, 0.0, 0.0)


def test_a_change_grows_linearly_and_stays() -> None:
    change = SlowChange("play", ARM.serials[1], 10.0, ALONG, from_s=60.0, over_s=300.0)
    assert [change.size(t_s) for t_s in (0.0, 60.0, 210.0, 360.0, 1e4)] == [0.0, 0.0, 5.0, 10.0, 10.0]


@pytest.mark.parametrize("kind", CHANGE_KINDS)
def test_the_seed_draws_module_size_and_direction_within_their_ranges(kind: ChangeKind) -> None:
    one, again, other = (draw_change(kind, ARM, np.random.default_rng(k), 60.0, 300.0) for k in (1, 1, 2))
    assert one == again != other
    low, high = GROWTHS[kind].sizes
    assert low <= one.full <= high
    assert one.serial in ARM.serials
    assert np.linalg.norm(one.direction) == pytest.approx(1.0)


def test_weather_is_a_swing_of_ten_kelvin_that_begins_at_none() -> None:
    weather = draw_weather(3, np.random.default_rng(4))
    kelvin = [weather.kelvin(t_s) for t_s in np.linspace(0.0, weather.period_s, 500)]
    assert kelvin[0] == 0.0
    assert np.ptp(kelvin) == pytest.approx(10.0, rel=1e-3)
    assert weather.kelvin(weather.period_s) == pytest.approx(0.0, abs=1e-9)


def test_a_payload_and_a_link_are_as_large_as_they_have_grown() -> None:
    for kind, full in (("payload", 0.4), ("link", 8.0)):
        world = World(ARM, 0, "ideal")
        change = SlowChange(kind, ARM.serials[-1], full, ALONG, 10.0, 100.0)  # type: ignore[arg-type]
        changing = SlowlyChanging(world, ARM, STILL, change)
        changing.at(60.0)
        if kind == "payload":
            payload = world.robot.modules[-1].payload
            assert payload is not None
            assert payload.mass_kg == pytest.approx(0.2)
        else:
            moved = true_chain(world.robot).imu_home[2, :3, 3] - true_chain(ARM).imu_home[2, :3, 3]
            assert 1e3 * np.linalg.norm(moved) == pytest.approx(4.0)


def test_friction_of_one_module_slows_its_motor_and_the_others_stay_as_they_were() -> None:
    turned = []
    for full in (0.0, 100.0):
        world = World(ARM, 0, "ideal")
        changing = SlowlyChanging(
            world, ARM, STILL, SlowChange("friction", ARM.serials[0], full, ALONG, 0.0, 10.0)
        )
        # Applied again and again, it is as large as once.
        for t_s in (2.0, 5.0, 20.0):
            changing.at(t_s)
        for _ in range(300):
            world.step([0.2, 0.0, 0.2])
        turned.append(world.plant.motor_rad_s)
    assert turned[1][0] < 0.97 * turned[0][0]
    assert turned[1][2] == pytest.approx(turned[0][2], rel=0.02)


def test_sensors_read_what_has_become_of_them() -> None:
    plain, aged = World(ARM, 0, "ideal"), World(ARM, 0, "ideal")
    SlowlyChanging(aged, ARM, STILL, SlowChange("accel-bias", ARM.serials[0], 0.5, ALONG, 0.0, 10.0)).at(10.0)
    one, other = (world.step([0.0] * 3)[0] for world in (plain, aged))
    assert other.accel_x_m_s2 - one.accel_x_m_s2 == pytest.approx(0.5)

"""What happens to a robot while it lives: a load is put on, a link slips, its gears get stiff."""

import numpy as np
import pytest

from module_agent.model.regressor import inverse_dynamics
from sim.geometry.link_parts import FreePose
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain, true_inertia
from sim.robot.variants import loaded
from sim.world.world import World

ARM = load_robot("a2085_03")
LOAD = FreePose(mass_kg=0.5, com_xyz_m=(0.0, 0.0, 0.05), inertia=(1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0))
TIP = ARM.serials[-1]


def fall(world: World, ticks: int) -> None:
    for _ in range(ticks):
        world.step([0.0] * len(world.modules))


def test_a_world_that_becomes_what_it_is_goes_on_as_if_nothing_had_happened() -> None:
    one, other = World(ARM, 0, "ideal"), World(ARM, 0, "ideal")
    for world in (one, other):
        fall(world, 100)
    other.become(ARM)
    for world in (one, other):
        fall(world, 100)
    # Velocities pass through the engine's joint states: to rounding.
    np.testing.assert_allclose(one.plant.q_rad, other.plant.q_rad, rtol=0.0, atol=1e-12)


def test_springs_carry_a_load_that_is_put_on_from_then_on() -> None:
    world = World(ARM, 0, "ideal")
    full = loaded(ARM, TIP, LOAD)
    fall(world, 5)
    world.become(full)
    fall(world, 1500)
    plant = world.plant
    carried = inverse_dynamics(
        true_chain(full), true_inertia(full), plant.q_rad[None], plant.qd_rad_s[None], plant.qdd_rad_s2[None]
    )
    # In one instant as the discrete step has it.
    np.testing.assert_allclose(plant.spring_torque_nm, carried[0], atol=2e-3)


def test_a_world_keeps_its_modules() -> None:
    world = World(ARM, 0, "ideal")
    with pytest.raises(ValueError, match="keeps its joints"):
        world.become(load_robot("a2085_04"))


def test_a_motor_with_more_friction_turns_slower_under_the_same_duty() -> None:
    worlds = [World(ARM, 0, "ideal"), World(ARM, 0, "ideal")]
    worlds[1].change_friction(ARM.serials[0], 3.0)
    for world in worlds:
        for _ in range(500):
            world.step([0.2, 0.0, 0.0])
    normal, stiff = (world.plant.motor_rad_s[0] for world in worlds)
    assert 0.0 < stiff < normal


def test_friction_is_changed_of_modules_that_are_there_and_to_what_it_can_be() -> None:
    world = World(ARM, 0, "ideal")
    with pytest.raises(ValueError, match="no module absent"):
        world.change_friction("absent", 2.0)
    with pytest.raises(ValueError, match="no friction"):
        world.change_friction(TIP, -1.0)


def test_the_current_of_a_motor_at_rest_falls_with_its_supply() -> None:
    full, sagged = World(ARM, 0, "ideal"), World(ARM, 0, "ideal")
    sagged.supply(0.5 * full.step([0.0] * 3)[0].voltage_v)
    sagged.step([0.0] * 3)
    # The motor begins to turn within the tick: its voltage is a part in a thousand of the current.
    before, after = full.step([1.0] * 3)[0], sagged.step([1.0] * 3)[0]
    assert after.voltage_v == 0.5 * before.voltage_v
    assert after.motor_current_a == pytest.approx(0.5 * before.motor_current_a, rel=0.01)
    for voltage_v in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="a positive voltage"):
            sagged.supply(voltage_v)

"""Random robots are of every kind that there is, and robots indeed: they carry themselves."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from module_agent.model.catalogue import CATALOGUE, module_type
from sim.robot.random_robot import GRAVITY_SHARE, joint_loads, random_robot
from sim.robot.robot_file import Robot
from sim.world.world import World

SEEDS = range(200)


@cache
def drawn() -> tuple[Robot, ...]:
    return tuple(random_robot(seed) for seed in SEEDS)


def test_the_same_seed_draws_the_same_robot_and_another_seed_another() -> None:
    assert random_robot(7) == random_robot(7)
    assert random_robot(7) != random_robot(8)


def test_robots_of_every_size_shape_and_mounting_are_drawn() -> None:
    robots = drawn()
    assert {len(r.modules) for r in robots} == set(range(3, 17))
    assert {m.type for r in robots for m in r.modules} == set(CATALOGUE)
    parts = [part for r in robots for m in r.modules for part in m.link]
    assert any(p.tube for p in parts)
    assert any(p.bracket for p in parts)
    assert any(p.pose for p in parts)
    chains = [r for r in robots if r.parents == tuple(range(-1, len(r.parents) - 1))]
    # Three in ten are meant to be chains, and so are some of the smallest by chance: 60 +- 6.5, and more.
    assert 40 < len(chains) < 120
    assert any(r.parents.count(-1) > 1 for r in robots)
    backwards = [m.mounted == "reversed" for r in robots for m in r.modules]
    assert 0.25 < np.mean(backwards) < 0.35
    assert any(r.modules[0].mounted == "reversed" for r in robots)


def test_bases_stand_every_way_up() -> None:
    up = np.array([r.base.world_pose[2, 2] for r in drawn()])
    assert up.min() < -0.95
    assert up.max() > 0.95
    # A rotation that is uniform tilts by 60 to 120 degrees half of the time, and 60 % of the bases have one.
    assert np.mean(np.abs(up) < 0.5) > 0.2


def test_the_serials_tell_nothing_of_the_order() -> None:
    sorted_already = [list(r.serials) == sorted(r.serials) for r in drawn() if len(r.serials) > 4]
    assert not any(sorted_already)


@given(st.integers(0, 2**32))
@settings(max_examples=25, deadline=None)
def test_parents_come_before_their_children_depth_first(seed: int) -> None:
    parents = random_robot(seed).parents
    assert parents[0] == -1
    for k in range(1, len(parents)):
        way = {-1, k - 1}
        above = k - 1
        while above >= 0:
            above = parents[above]
            way.add(above)
        assert parents[k] in way


@pytest.mark.parametrize("seed", range(0, 200, 10))
def test_every_joint_holds_the_weight_that_is_on_it_in_the_world(seed: int) -> None:
    robot = random_robot(seed)
    world = World(robot, seed, "ideal")
    held = np.abs(world.plant.spring_torque_nm)
    world.close()
    loads = joint_loads(robot)
    # Joints begin up to 0.2 rad off their zero, which lengthens a lever by 0.2 of what lies across it.
    most = np.array([load.weight_nm for load in loads]) * 1.2 + 0.3
    assert (held <= most).all()
    strongest = np.array([module_type(m.type).max_effort_nm for m in robot.modules])
    assert (np.array([load.weight_nm for load in loads]) <= GRAVITY_SHARE * strongest).all()

"""A module of limited rotation cannot turn beyond its stops."""

import numpy as np
import pytest

from sim.robot.robot_file import parse_robot
from sim.world.world import World


def test_a_module_of_limited_rotation_ends_at_its_stop_and_leaves_it_freely() -> None:
    text = """
name = "r"
[[module]]
serial = "A"
type = "SEA-snake"
parent = "base"
start_rad = 1.4
"""
    world = World(parse_robot(text, "r"), seed=1, noise="ideal")
    positions = []
    for _ in range(2000):
        world.step([0.5])
        positions.append(float(world.plant.q_rad[0]))
    most = float(np.pi / 2)
    # The stalled motor pushes with at most 9 Nm: 4.5 mrad into a stop of 2000 Nm/rad.
    assert positions[-1] == pytest.approx(most + 0.0025, abs=0.002)
    assert max(positions) < most + 0.02
    torque = float(world.plant.spring_torque_nm[0])
    assert torque > 1.0
    for _ in range(300):
        world.step([-0.5])
    assert world.plant.q_rad[0] < most - 0.05
    world.close()

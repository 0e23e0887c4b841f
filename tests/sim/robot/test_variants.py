"""Robots stand anywhere on the Earth, and only there; their IMUs feel how strong gravity is."""

import numpy as np

from module_agent.model.catalogue import GRAVITY_M_S2, GRAVITY_SIGMA_M_S2
from sim.robot.robot_file import load_robot
from sim.robot.variants import MAX_M_S2, MIN_M_S2, at_random_site
from sim.world.world import World


def test_what_is_believed_of_gravity_is_how_it_is_drawn() -> None:
    robot = load_robot("thesis_245_horizontal")
    drawn = np.array([at_random_site(robot, seed).base.gravity_m_s2 for seed in range(400)])
    assert MIN_M_S2 <= drawn.min() < drawn.max() <= MAX_M_S2
    # A uniform distribution's: 400 draws tell the mean to a twentieth of its sigma, and sigma to 4 %.
    np.testing.assert_allclose(drawn.mean(), GRAVITY_M_S2, atol=0.2 * GRAVITY_SIGMA_M_S2)
    np.testing.assert_allclose(drawn.std(), GRAVITY_SIGMA_M_S2, rtol=0.1)


def test_the_same_seed_stands_at_the_same_place_and_feels_it() -> None:
    robot = at_random_site(load_robot("thesis_245_horizontal"), 5)
    assert robot == at_random_site(load_robot("thesis_245_horizontal"), 5)
    world = World(robot, seed=1, noise="ideal")
    for _ in range(200):
        samples = world.step([0.0, 0.0])
    world.close()
    still = samples[0]
    felt = float(np.linalg.norm([still.accel_x_m_s2, still.accel_y_m_s2, still.accel_z_m_s2]))
    # An ideal IMU counts in steps and on a fixed base that is all.
    assert abs(felt - robot.base.gravity_m_s2) < 1e-3

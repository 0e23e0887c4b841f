"""Where on the Earth a simulated robot stands, as far as its IMUs feel it: by how strong gravity is there."""

import numpy as np

from sim.robot_file import Robot

LEAST_M_S2, MOST_M_S2 = 9.764, 9.834


def somewhere(robot: Robot, seed: int) -> Robot:
    """Return the robot at a place drawn by the seed; the same seed draws the same place."""
    drawn = float(np.random.default_rng((seed, 0x6A17)).uniform(LEAST_M_S2, MOST_M_S2))
    return robot.model_copy(update={"base": robot.base.model_copy(update={"gravity_m_s2": drawn})})

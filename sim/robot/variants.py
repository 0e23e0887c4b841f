"""A robot that carries something: a payload on what one of its joints turns.

Where on the Earth a simulated robot stands, as far as its IMUs feel it: by how strong gravity is there.
"""

import numpy as np

from sim.geometry.link_parts import FreePose
from sim.robot.robot_file import Robot


def loaded(robot: Robot, serial: str, payload: FreePose) -> Robot:
    """Return the robot with a payload on one of its modules.

    Raises:
        ValueError: the robot has no such module.
    """
    if serial not in robot.serials:
        raise ValueError(f"robot {robot.name} has no module {serial}; it has {', '.join(robot.serials)}")
    modules = [
        module.model_copy(update={"payload": payload}) if module.serial == serial else module
        for module in robot.modules
    ]
    return robot.model_copy(update={"modules": tuple(modules)})


MIN_M_S2, MAX_M_S2 = 9.764, 9.834


def somewhere(robot: Robot, seed: int) -> Robot:
    """Return the robot at a place drawn by the seed; the same seed draws the same place."""
    drawn = float(np.random.default_rng((seed, 0x6A17)).uniform(MIN_M_S2, MAX_M_S2))
    return robot.model_copy(update={"base": robot.base.model_copy(update={"gravity_m_s2": drawn})})

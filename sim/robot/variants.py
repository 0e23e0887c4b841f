"""Variants of a robot: with a payload, with a displaced link, and at a random site on the Earth."""

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


# Gravity on the surface of the Earth.
MIN_M_S2, MAX_M_S2 = 9.764, 9.834


def at_random_site(robot: Robot, seed: int) -> Robot:
    """Return the robot with the strength of gravity at a site drawn by the seed."""
    drawn = float(np.random.default_rng((seed, 0x6A17)).uniform(MIN_M_S2, MAX_M_S2))
    return robot.model_copy(update={"base": robot.base.model_copy(update={"gravity_m_s2": drawn})})

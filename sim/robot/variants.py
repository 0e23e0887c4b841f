"""Variants of a robot: with a payload, with a displaced link, and at a random site on the Earth."""

from math import log1p

import numpy as np

from sim.geometry.link_parts import FreePose
from sim.imperfections.noise_profile import NoiseProfile, noise_profile
from sim.imperfections.random_streams import generator
from sim.robot.robot_file import Build, Robot


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


def as_built(robot: Robot, seed: int, noise: str | NoiseProfile | None = None) -> Robot:
    """Return the robot with modules that differ from their types as the noise profile has them.

    Drawn by seed and serial; modules whose `build` the robot file gives stay as they are. None: the profile
    that the robot names.
    """
    wanted = robot.noise if noise is None else noise
    profile = noise_profile(wanted) if isinstance(wanted, str) else wanted
    modules = [
        module
        if module.build is not None
        else module.model_copy(update={"build": _build(seed, module.serial, profile)})
        for module in robot.modules
    ]
    return robot.model_copy(update={"modules": tuple(modules)})


def _build(seed: int, serial: str, profile: NoiseProfile) -> Build:
    draw = generator(seed, serial, "build").standard_normal(16)
    across = np.array([1.0, 1.0, 0.0])
    return Build(
        imu_xyz_m=tuple(profile.imu_place_m * draw[:3]),
        imu_turn_rad=tuple(profile.imu_mounting_rad * draw[3:6]),
        axis_xyz_m=tuple(profile.housing_axis_m * across * draw[6:9]),
        axis_turn_rad=tuple(profile.housing_axis_rad * across * draw[9:12]),
        mass_factor=float(np.exp(log1p(profile.body_mass) * draw[12])),
        com_xyz_m=tuple(profile.body_centre_m * draw[13:16]),
    )


# Gravity on the surface of the Earth.
MIN_M_S2, MAX_M_S2 = 9.764, 9.834


def at_random_site(robot: Robot, seed: int) -> Robot:
    """Return the robot with the strength of gravity at a site drawn by the seed."""
    drawn = float(np.random.default_rng((seed, 0x6A17)).uniform(MIN_M_S2, MAX_M_S2))
    return robot.model_copy(update={"base": robot.base.model_copy(update={"gravity_m_s2": drawn})})

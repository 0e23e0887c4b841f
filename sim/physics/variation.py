"""How modules of one type differ from each other: factors on the catalogue's figures, drawn from a seed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sim.noise_profile import NoiseProfile
from sim.physics.sensor_noise import generator
from sim.pose import Array, read_only


class Variation(NamedTuple):
    """Factors near 1, (n,) each, read-only: friction, motor constant, winding resistance, spring stiffness.

    The motor constant is torque per ampere and volts per speed alike.
    """

    friction: Array
    motor: Array
    resistance: Array
    spring: Array


def alike(n: int) -> Variation:
    """Return modules that are all as catalogued."""
    return Variation(*(read_only(np.ones(n)) for _ in Variation._fields))


def draw_variation(seed: int, serials: Sequence[str], profile: NoiseProfile) -> Variation:
    """Draw the modules' factors: log-normal, so none is negative, with the profile's relative spreads."""
    spread = np.array(
        [profile.friction_spread, profile.motor_spread, profile.motor_spread, profile.spring_spread]
    )
    normal = np.array([generator(seed, s, "variation").standard_normal(len(spread)) for s in serials])
    return Variation(*(read_only(column) for column in np.exp(normal * spread).T))

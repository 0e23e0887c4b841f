"""The springs between gear and output: linear to stiffening, in series with the gear's gap.

    torque(y) = linear y + cubic y^3        y: the spring's own deflection, motor minus output

is monotone; its energy is linear y^2 / 2 + cubic y^4 / 4. Within the gap of the gear y is zero.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from module_agent.model.catalogue import ModuleType
from module_agent.model.read_only import read_only
from sim.geometry.pose import Array
from sim.imperfections.noise_profile import NoiseProfile

# Published for modules made since 2019: 30-70 Nm/rad near zero, 300-1000 at full load, over a range of types
# whose older springs have 40-150 Nm/rad.
_OLDER_NM_RAD = (40.0, 150.0)
_NEAR_ZERO_NM_RAD = (30.0, 70.0)
_FULL_LOAD_NM_RAD = (300.0, 1000.0)


class Springs(NamedTuple):
    """The springs of n modules, (n,) each, read-only. The gap is the motor's whole play [rad]."""

    linear_nm_rad: Array
    cubic_nm_rad3: Array
    gap_rad: Array

    def deflection(self, stretch_rad: Array) -> Array:
        """Return the springs' own deflections for given angles, motors minus outputs."""
        half = self.gap_rad / 2.0
        return read_only(stretch_rad - np.clip(stretch_rad, -half, half))

    def torque(self, deflection_rad: Array) -> Array:
        """Return the elastic torques [Nm]."""
        return read_only((self.linear_nm_rad + self.cubic_nm_rad3 * deflection_rad**2) * deflection_rad)

    def energy_j(self, deflection_rad: Array) -> Array:
        """Return the energies stored [J]."""
        square = deflection_rad**2
        return read_only((self.linear_nm_rad / 2.0 + self.cubic_nm_rad3 / 4.0 * square) * square)

    def stretch(self, torque_nm: Array) -> Array:
        """Return the angles, motors minus outputs, at which the springs transmit the torques [rad]."""
        y = torque_nm / self.linear_nm_rad
        # Newton's method on a convex function comes down to the root from beyond without overshoot; far off,
        # where the cube rules, every round leaves two thirds.
        for _ in range(60):
            slope = self.linear_nm_rad + 3.0 * self.cubic_nm_rad3 * y**2
            y = y - (self.torque(y) - torque_nm) / slope
        return read_only(y + np.sign(torque_nm) * self.gap_rad / 2.0)


def build_springs(types: Sequence[ModuleType], profile: NoiseProfile, factor: Array) -> Springs:
    """Return the springs under a profile, every module's torque multiplied by its factor (n,)."""
    older = np.array([t.spring_nm_rad for t in types])
    near = np.interp(older, _OLDER_NM_RAD, _NEAR_ZERO_NM_RAD)
    full = np.interp(older, _OLDER_NM_RAD, _FULL_LOAD_NM_RAD)
    # near + 3 cubic y^2 = full, where near y + cubic y^3 is the largest effort.
    at_full = np.array([t.max_effort_nm for t in types]) / (near + (full - near) / 3.0)
    cubic = (full - near) / (3.0 * at_full**2)
    share = profile.spring_stiffening
    return Springs(
        linear_nm_rad=read_only(factor * ((1.0 - share) * older + share * near)),
        cubic_nm_rad3=read_only(factor * share * cubic),
        gap_rad=read_only(np.full(len(types), profile.backlash_rad)),
    )

"""Limits of a joint's motion by its module type, its inertia and its torque at rest.

The inertia is that of a stretched arm before any motion, and estimated from the joint's own slow motion after
it.
"""

from typing import NamedTuple

import numpy as np

from module_agent.control.waveform import duration_s, waveform
from module_agent.model.catalogue import COPPER_PER_K, GRAVITY_M_S2, RESISTANCES_K_W, ModuleType
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.signals.filtering import HELD_JOINT_CUTOFF_HZ, filtered_signals, settling_samples
from module_agent.wire.messages import Pattern

# Of the type's speed: back-EMF then leaves a third of the voltage for torque.
SPEED_SHARE = 0.7
# How much warmer than a room of 25 C the winding may get, and how much more resistance copper then has.
WINDING_RISE_K = 130.0
HOT_RESISTANCE = 1.0 + COPPER_PER_K * WINDING_RISE_K
# Gravity may take all of the continuous torque. So much of the type's torque is still given to a motion,
# which is over before the winding is warm; and so much is never asked for.
MIN_SHARE = 0.1
RESERVE_SHARE = 0.2
# Share of the range of a module that does not turn continuously; the rest is kept from the end stops.
RANGE_SHARE = 0.9
# Links and brackets weigh about 0.6 of the modules; a module with its link reaches about 0.12 m further.
LINK_MASS_SHARE = 0.6
REACH_PER_MODULE_M = 0.12
# Share of the torque that holds an arm level which a module that can carry the arm has left to move it.
LEVEL_SHARE = 0.05
# Of any motion: 100 a period at 4 Hz for 15 s.
PEAK_SAMPLES = 6001


class NoExcitation(DataError):
    """No motion, or too few, within the limits; the message says which limit refused most."""


class JointLimits(NamedTuple):
    """The largest speed and acceleration of a motion, and the range of positions."""

    speed_rad_s: float
    accel_rad_s2: float
    low_rad: float
    high_rad: float

    def room_rad(self, home_rad: float) -> float:
        """Return how far a motion about `home_rad` may go to either side."""
        return min(self.high_rad - home_rad, home_rad - self.low_rad)

    def fitting_scale(self, pattern: Pattern, share: float = 1.0) -> float:
        """Return by how much a motion has to be smaller to take that share of speed and acceleration."""
        speed, accel = motion_peaks(pattern)
        return min(1.0, share * self.speed_rad_s / speed, share * self.accel_rad_s2 / accel)


def continuous_torque_nm(kind: ModuleType) -> float:
    """Return the torque that a module holds for ever: its winding's losses i^2 R warm it by 130 K."""
    motor = kind.motor
    current_a = np.sqrt(WINDING_RISE_K / sum(RESISTANCES_K_W) / (motor.resistance_ohm * HOT_RESISTANCE))
    torque = current_a * motor.torque_constant_nm_a * kind.gear_ratio * motor.efficiency
    return min(float(torque), kind.max_effort_nm)


def joint_limits(kind: ModuleType, rest_torque_nm: float, inertia_kg_m2: float) -> JointLimits:
    """Return the limits of a joint by its type, its torque at rest and an upper bound of its inertia.

    The torque is that where the motion takes place, the inertia that of all that moves, about the axis.

    Raises:
        ValueError: an inertia that is not positive.
    """
    if not inertia_kg_m2 > 0.0:
        raise ValueError(f"an inertia of {inertia_kg_m2} kg m^2; it must be positive")
    held = abs(rest_torque_nm)
    least = min(MIN_SHARE * kind.max_effort_nm, (1.0 - RESERVE_SHARE) * kind.max_effort_nm - held)
    torque = max(continuous_torque_nm(kind) - held, least, 0.0)
    low, high = kind.range_rad or (-np.pi, np.pi)
    return JointLimits(
        SPEED_SHARE * kind.max_speed_rad_s, torque / inertia_kg_m2, RANGE_SHARE * low, RANGE_SHARE * high
    )


def likely_inertia_kg_m2(kinds: list[ModuleType]) -> float:
    """Return the inertia of a stretched arm of all these modules about its base: no joint carries more."""
    mass = (1.0 + LINK_MASS_SHARE) * sum(kind.mass_kg for kind in kinds)
    reach = REACH_PER_MODULE_M * len(kinds)
    # Each module's own housing turns too, a lone one about itself.
    return mass * reach**2 / 3.0 + 2e-3


def least_accel_rad_s2(modules: int) -> float:
    """Return the acceleration that a joint always has left, in an arm of so many modules that holds itself.

    Holding a stretched uniform arm level takes m g L / 2, turning it m L^2 / 3 times the acceleration.
    """
    return LEVEL_SHARE * 1.5 * GRAVITY_M_S2 / (REACH_PER_MODULE_M * modules)


def motion_peaks(pattern: Pattern, origin_rad: float = 0.0) -> tuple[float, float]:
    """Return the largest speed [rad/s] and acceleration [rad/s^2] of a motion."""
    t_s = np.linspace(0.0, duration_s(pattern, origin_rad), PEAK_SAMPLES)
    velocity = waveform(pattern, origin_rad, t_s).velocity_rad_s
    return float(np.abs(velocity).max()), float(np.abs(np.gradient(velocity, t_s)).max())


# A joint moves at least its own output and gear train.
MIN_KG_M2 = 2e-3


class Load(NamedTuple):
    """Inertia about the joint's axis [kg m^2] and its standard deviation."""

    inertia_kg_m2: float
    sigma_kg_m2: float

    @property
    def at_most_kg_m2(self) -> float:
        """An upper bound: two standard deviations more, and a fifth for the model's simplifications."""
        return max(1.2 * (max(self.inertia_kg_m2, 0.0) + 2.0 * self.sigma_kg_m2), MIN_KG_M2)


def measured_load(q_rad: Array, tau_nm: Array, rate_hz: float) -> Load:
    """Fit tau = I d2q/dt2 + c dq/dt + a q + b to one motion of one joint, the others held.

    q_rad, tau_nm: (m,) samples of the joint's position and measured torque. Over a turn in one direction dry
    friction is part of b, and gravity is straight to first order.

    Raises:
        DataError: a motion that is too short for the low-pass.
    """
    q, rate, acceleration, (tau,), _ = filtered_signals(q_rad, [tau_nm], rate_hz, HELD_JOINT_CUTOFF_HZ)
    edge = settling_samples(rate_hz, HELD_JOINT_CUTOFF_HZ) // 2
    kept = slice(edge, len(q) - edge)
    terms = np.column_stack([acceleration, rate, q - q.mean(), np.ones(len(q))])[kept]
    solution, *_ = np.linalg.lstsq(terms, tau[kept], rcond=None)
    residual = tau[kept] - terms @ solution
    # A low-passed sample is not independent of its neighbours.
    independent = len(terms) * min(1.0, 2.0 * HELD_JOINT_CUTOFF_HZ / rate_hz)
    freedom = max(independent - terms.shape[1], 1.0)
    scatter = float(residual @ residual) / len(terms) * independent / freedom
    variance = scatter * np.linalg.pinv(terms.T @ terms)[0, 0] * len(terms) / independent
    return Load(float(solution[0]), float(np.sqrt(variance)))

"""No energy comes from nowhere: one joint's electrical energy against motion, springs and every loss."""

import math

import numpy as np
import pytest

from module_agent.model.catalogue import module_type
from sim.actuator.actuator import Actuators
from sim.actuator.actuator_kernel import ELECTRICAL_W
from sim.actuator.thermal import Windings
from sim.geometry.pose import Array
from sim.imperfections.noise_profile import NOISE_PROFILES, NoiseProfile, switched

DT = 1e-3
EVERYTHING = switched(NOISE_PROFILES["ideal"], ("backlash", "stiffening-spring"))


class Pendulum:
    """An actuator that swings a pendulum against a fan, which takes the work out of the system."""

    def __init__(
        self, name: str, profile: NoiseProfile, inertia: float, weight_nm: float, fan_nm_s_rad: float
    ):
        self.kind = module_type(name)
        self.actuator = Actuators([self.kind], DT, profile)
        self.windings = Windings(1, DT, profile.heat)
        self.inertia, self.weight_nm, self.fan_nm_s_rad = inertia, weight_nm, fan_nm_s_rad
        self.q, self.qd = np.zeros(1), np.zeros(1)
        self.fanned_j = 0.0

    def step(self, pwm: float) -> Array:
        """The powers of a step, from the electrical to the spring's [W]."""
        load = self.weight_nm * np.sin(self.q) + self.fan_nm_s_rad * self.qd
        mass = np.array([[self.inertia]])
        factor = self.windings.resistance_factor
        torque, _ = self.actuator.step(np.array([pwm]), self.q, self.qd, mass, load, factor)
        before = self.qd
        self.qd = self.qd + DT * (torque - load) / self.inertia
        self.fanned_j += float(DT * self.fan_nm_s_rad * before[0] * (before[0] + self.qd[0]) / 2)
        self.q = self.q + DT * self.qd
        self.windings.step(self.actuator.state.copper_w)
        return np.ravel(self.actuator.state[ELECTRICAL_W:])

    def stored_j(self) -> float:
        """What is in rotor and spring."""
        drive, springs = self.actuator.state, self.actuator.springs
        rotor = self.kind.gear_ratio**2 * self.kind.motor.rotor_inertia_kg_m2
        own = springs.deflection(drive.motor_rad - self.q)
        return float((0.5 * rotor * drive.motor_rad_s**2 + springs.energy_j(own))[0])

    def mechanical_j(self) -> float:
        """What has arrived in the pendulum, by its own motion."""
        moving = 0.5 * self.inertia * self.qd[0] ** 2
        return float(moving + self.weight_nm * (1.0 - math.cos(self.q[0])) + self.fanned_j)


def _minute(pendulum: Pendulum) -> Array:
    """Brisk motion for 60 s: the energies in the order of `ActuatorState` [J]."""
    total = np.zeros(6)
    for k in range(60_000):
        t = k * DT
        wave = math.sin(2 * math.pi * 1.3 * t) + 0.8 * math.sin(2 * math.pi * 3.1 * t + 1.0)
        total += pendulum.step(0.28 * wave)
    return total * DT


@pytest.mark.parametrize("profile", [NOISE_PROFILES["ideal"], EVERYTHING], ids=["ideal", "everything"])
@pytest.mark.parametrize(
    ("name", "inertia", "weight_nm", "fan_nm_s_rad"), [("X5-1", 0.02, 0.5, 0.05), ("X5-9", 0.1, 3.0, 2.0)]
)
def test_a_minutes_electrical_energy_is_found_again_in_motion_springs_and_losses(
    name: str, inertia: float, weight_nm: float, fan_nm_s_rad: float, profile: NoiseProfile
) -> None:
    pendulum = Pendulum(name, profile, inertia, weight_nm, fan_nm_s_rad)
    electrical, output, copper, friction, gear, spring = _minute(pendulum)
    stored = pendulum.stored_j()
    # The pendulum got what the springs gave: two reckonings of one work.
    assert output == pytest.approx(pendulum.mechanical_j(), rel=5e-3)
    # Measured 6e-6: the discrete equations conserve energy but for the springs. Each of the large terms
    # is many times the bound, so none can be left out or wrong.
    found = pendulum.mechanical_j() + stored + copper + friction + gear + spring
    assert found == pytest.approx(electrical, rel=1e-3)
    assert min(copper, friction, gear, output) > 0.03 * electrical
    assert spring > 0.0
    assert pendulum.windings.winding_c[0] > 30.0


def test_a_motor_that_is_turned_by_its_load_gives_no_more_than_it_gets() -> None:
    # Dropped on a shorted motor: what the weight gives, less what is left in motion, has become heat.
    pendulum = Pendulum("X5-1", NOISE_PROFILES["ideal"], 0.02, 1.0, 0.0)
    pendulum.q = np.array([2.5])
    pendulum.actuator.reset(pendulum.q, 1.0 * np.sin(pendulum.q))
    start = pendulum.mechanical_j() + pendulum.stored_j()
    lost = np.zeros(6)
    for _ in range(3000):
        lost += pendulum.step(0.0)
    electrical, _, copper, friction, gear, spring = lost * DT
    left = pendulum.mechanical_j() + pendulum.stored_j()
    assert electrical == 0.0
    assert start - left > 1.0
    # The leapfrog's energy swings about the true one by a few per mille where it is not at rest.
    assert copper + friction + gear + spring == pytest.approx(start - left, rel=5e-3)
    assert gear == pytest.approx(0.0, abs=0.02 * (start - left))

"""Series elastic actuators: DC motor, lossy gear with friction, spring; vectorised over the modules.

Motor side quantities are seen at the output: a rotor inertia Jr behind a gear N is N^2 Jr. One step goes as

    i    = (V - Ke N thd) / R
    J thdd = a N Kt i - b thd - f - ts          |f| <= Tc + (1 - eff)/2 N Kt |i|
    ts   = k (th - q) + c (thd - qd) + g (thdd - qdd),   g = k h^2/4 + c h/2

with a = (1 + eff)/2. The gear's loss is a friction that grows with the torque it transmits: driving, the
output gets eff times the motor's torque; driven backwards, all of it; and in between it sticks. The last line
is the average-acceleration rule. It needs qdd = M^-1 (ts - bias), so spring and bodies are solved together,
which is stable for any stiffness and any inertia. Back-EMF and viscous friction are implicit, as the added
inertia h b.
"""

from collections.abc import Sequence

import numpy as np

from module_agent.catalogue import ModuleType
from sim.pose import Array

BUS_VOLTAGE_V = 24.0
# Gains are normalised to 48 V: the duty applied is the firmware's PWM times 48 V / bus voltage.
GAIN_VOLTAGE_V = 48.0
# The spring's loss: damping over stiffness. Below 40 rad/s it is under 2 % of critical.
SPRING_LOSS_S = 1e-3


class Actuators:
    """The motors and springs of n modules; arrays are (n,). Positions and speeds as seen at the output."""

    def __init__(self, types: Sequence[ModuleType], dt_s: float, voltage_v: float = BUS_VOLTAGE_V):
        motors = [t.motor for t in types]
        self.gear = np.array([t.gear_ratio for t in types])
        self.spring_nm_rad = np.array([t.spring_nm_rad for t in types])
        self.damping_nm_s_rad = self.spring_nm_rad * SPRING_LOSS_S
        self.rotor_kg_m2 = self.gear**2 * np.array([m.rotor_inertia_kg_m2 for m in motors])
        resistance = np.array([m.resistance_ohm for m in motors])
        efficiency = np.array([m.efficiency for m in motors])
        torque_per_a = self.gear * np.array([m.torque_constant_nm_a for m in motors])
        viscous = np.array([m.viscous_nm_s_rad for m in motors])
        self._dt = dt_s
        self._amps_per_u = voltage_v / resistance
        self._u_to_duty = GAIN_VOLTAGE_V / voltage_v
        self._amps_per_speed = self.gear * np.array([m.back_emf_v_s_rad for m in motors]) / resistance
        self._mean_torque_per_a = (1.0 + efficiency) / 2.0 * torque_per_a
        self._loss_per_a = (1.0 - efficiency) / 2.0 * torque_per_a
        self._viscous = viscous
        self._coulomb = np.array([m.coulomb_nm for m in motors])
        inertia = self.rotor_kg_m2 + dt_s * (viscous + self._mean_torque_per_a * self._amps_per_speed)
        self._momentum_per_speed = inertia / dt_s
        g = self.spring_nm_rad * dt_s**2 / 4.0 + self.damping_nm_s_rad * dt_s / 2.0
        self._g_per_inertia = g / inertia
        self._shrink = 1.0 / (1.0 + self._g_per_inertia)
        self._added = g * self._shrink
        self.voltage_v = voltage_v
        self.reset(np.zeros(len(types)), np.zeros(len(types)))

    def reset(self, q_rad: Array, load_nm: Array) -> None:
        """Put the motors to rest where their springs carry the load at the given joint positions."""
        self.motor_rad = q_rad + load_nm / self.spring_nm_rad
        self.motor_rad_s = np.zeros_like(q_rad)
        self.torque_nm = np.array(load_nm)
        self.duty = np.zeros_like(q_rad)
        self.current_a = np.zeros_like(q_rad)
        self.deflection_rad = q_rad - self.motor_rad

    def step(self, pwm: Array, q: Array, qd: Array, mass: Array, bias: Array) -> Array:
        """Advance the motors by one step; return the springs' torques on the outputs (n,) [Nm] for that step.

        `mass` (n, n) and `bias` (n,) are the multibody's at (q, qd). The current, deflection and torque kept
        in `self` belong to the beginning of the step, as does the acceleration that the torque brings about.
        """
        duty = np.minimum(np.maximum(pwm * self._u_to_duty, -1.0), 1.0)
        speed = self.motor_rad_s
        current = duty * self._amps_per_u - self._amps_per_speed * speed
        drive = self._mean_torque_per_a * current - self._viscous * speed
        limit = self._coulomb + self._loss_per_a * np.abs(current)
        momentum = self._momentum_per_speed * speed + drive
        # Friction as the last step's torque predicts it; only the spring's second-order term depends on it.
        friction = _clamp(momentum - self.torque_nm, limit)
        stretch = self.motor_rad - q
        pull = self.spring_nm_rad * stretch + self.damping_nm_s_rad * (speed - qd)
        pull += self._g_per_inertia * (drive - friction)
        pull *= self._shrink
        # (M + diag(added)) qdd = pull - bias follows from the module's docstring by eliminating thdd and ts.
        stiffened = mass.copy()
        stiffened.flat[:: len(pull) + 1] += self._added
        torque: Array = pull - self._added * np.linalg.solve(stiffened, pull - bias)
        momentum -= torque
        self.motor_rad_s = (momentum - _clamp(momentum, limit)) / self._momentum_per_speed
        self.motor_rad = self.motor_rad + self._dt * self.motor_rad_s
        self.duty, self.current_a, self.deflection_rad, self.torque_nm = duty, current, -stretch, torque
        return torque


def _clamp(value: Array, limit: Array) -> Array:
    clamped: Array = np.minimum(np.maximum(value, -limit), limit)
    return clamped

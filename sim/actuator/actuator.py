"""Series elastic actuators: DC motor, lossy gear with friction, gap and spring; and the structure's springs.

Motor side quantities are seen at the output: a rotor inertia Jr behind a gear N is N^2 Jr. One step goes as

    i    = (V - K N w) / R                      w: the mean of the motor's speeds before and after the step
    J thdd = a K N i - b w - f - ts             |f| <= Tc + (1 - eff)/2 K N |i|
    ts   = T(y) + c yd + k h^2/4 ydd            y: th - q less the gap, k = dT/dy, c = k times its loss

with a = (1 + eff)/2. One constant K stands for torque per ampere and volts per speed, as it does in any motor
that turns all of its back-EMF's power into mechanical power. The gear's loss is a friction growing with the
torque it transmits: driving, the output gets eff times the motor's torque; driven backwards, all of it; and
in between it sticks. The last line is the average-acceleration rule (Newmark, 1959, beta = 1/4), linearised
at the step's beginning. It needs qdd = M^-1 (ts - bias), so springs and bodies are solved together, which is
stable for any stiffness and any inertia. A passive joint of stiffness k and damping c exerts, by the same
rule, -k q - c qd - (k h^2/4 + c h/2) qdd. An end stop is a one-sided spring, by implicit Euler. All losses
are taken at the mean speeds, at which the discrete equations conserve energy.
"""

from collections.abc import Sequence

import numpy as np

from module_agent.model.catalogue import ModuleType
from module_agent.model.read_only import read_only
from sim.actuator import actuator_kernel as kernel
from sim.actuator.spring import Springs, build_springs
from sim.geometry.pose import Array
from sim.imperfections.module_errors import Variation, alike
from sim.imperfections.noise_profile import NoiseProfile
from sim.physics.skeleton import Skeleton

BUS_VOLTAGE_V = 24.0
# The spring's loss: damping over stiffness. Springs of this kind are rubber bonded between plates (Rollinson
# et al. 2013). Their loss factor is assumed to be 0.1 at 5 Hz, where an arm of half a metre rings on its
# spring. With a third of it light arms ring after every reversal of the gear's friction, and the lengths by
# circle point analysis on a solid table are 10 to 30 % too long; the thesis measured less than 5 %.
SPRING_LOSS_S = 3e-3
# End stops, where a type has them: 0.2 deg deep under the type's largest torque, without rebound. An
# assumption: their material is not published.
STOP_NM_RAD = 2000.0
STOP_LOSS_S = 2e-3
# A gear that loses nearly all still has to turn.
_MIN_EFFICIENCY = 0.05


class Actuators:
    """The motors and springs of n modules on m joints, without a skeleton the modules' own; see `state`.

    `rows` is the state as one array.

    `profile` says which effects act, `variation` how the modules differ from their types.
    """

    def __init__(
        self,
        types: Sequence[ModuleType],
        dt_s: float,
        profile: NoiseProfile,
        variation: Variation | None = None,
        skeleton: Skeleton | None = None,
        voltage_v: float = BUS_VOLTAGE_V,
    ):
        n = len(types)
        variation = alike(n) if variation is None else variation
        self.springs = build_springs(types, profile, variation.spring)
        self._built_gap_rad = self.springs.gap_rad
        self._modules = _module_records(types, self.springs, profile, variation)
        self._modules["joint"] = range(n) if skeleton is None else skeleton.module
        self._passives = np.zeros(0 if skeleton is None else len(skeleton.passive), kernel.PASSIVE)
        if skeleton is not None:
            self._passives["joint"] = skeleton.passive
            self._passives["stiffness"], self._passives["damping"] = skeleton.stiffness, skeleton.damping
        self._dt = dt_s
        self._supply_v = np.array([voltage_v])
        self._cold = np.ones(n)
        self.reset(np.zeros(n), np.zeros(n))

    def reset(self, q_rad: Array, load_nm: Array) -> None:
        """Put the motors to rest where their springs carry the load at the given joint positions."""
        stretch = self.springs.stretch(load_nm)
        self.rows = np.zeros((kernel.ROWS, len(q_rad)))
        self.state = kernel.ActuatorState(*self.rows)
        self.state.motor_rad[:] = q_rad + stretch
        self.state.torque_nm[:] = self.state.elastic_nm[:] = load_nm
        self.state.deflection_rad[:] = -self.springs.deflection(stretch)

    @property
    def arrays(self) -> kernel.Motors:
        """What the kernels know of them."""
        return kernel.Motors(self._modules, self._passives, self._supply_v, self._dt)

    @property
    def voltage_v(self) -> float:
        """The bus voltage, which may change between steps."""
        return float(self._supply_v[0])

    @voltage_v.setter
    def voltage_v(self, voltage_v: float) -> None:
        self._supply_v[0] = voltage_v

    def change_friction(self, module: int, factor: float) -> None:
        """Multiply the Coulomb and viscous friction of one motor and its gear."""
        self._modules["coulomb_nm"][module] *= factor
        self._modules["viscous_nm_s_rad"][module] *= factor

    def widen_gap(self, module: int, by_rad: float) -> None:
        """Set the gap of one module's gear to what it was built with and so much more [rad]."""
        gap_rad = self.springs.gap_rad.copy()
        gap_rad[module] = self._built_gap_rad[module] + by_rad
        self.springs = self.springs._replace(gap_rad=read_only(gap_rad))
        self._modules["half_gap_rad"][module] = gap_rad[module] / 2.0

    def step(
        self,
        pwm: Array,
        q: Array,
        qd: Array,
        mass: Array,
        bias: Array,
        resistance_factor: Array | None = None,
    ) -> tuple[Array, Array]:
        """Advance the motors by one step; return the joints' forces (m,) [Nm, N] and accelerations for it.

        `mass` (m, m) and `bias` (m,) are the multibody's at (q, qd); `resistance_factor` (n,) is the
        resistance of the warm windings over that of cold ones. The accelerations (m,) [rad/s^2, m/s^2], which
        solve M qdd = force - bias, belong to the instant of q.
        """
        force, qdd, self.rows = kernel.advance(
            self.arrays,
            self.rows,
            pwm,
            self._cold if resistance_factor is None else resistance_factor,
            mass,
            bias,
            q,
            qd,
        )
        self.state = kernel.ActuatorState(*self.rows)
        return force, qdd


def _module_records(
    types: Sequence[ModuleType], springs: Springs, profile: NoiseProfile, variation: Variation
) -> kernel.Records:
    motors = [t.motor for t in types]
    gear = np.array([t.gear_ratio for t in types])
    efficiency = 1.0 - profile.gear_loss * (1.0 - np.array([m.efficiency for m in motors]))
    friction = profile.friction * variation.friction
    records: kernel.Records = np.zeros(len(types), kernel.MODULE)
    records["resistance_ohm"] = variation.resistance * [m.resistance_ohm for m in motors]
    records["per_amp_nm"] = variation.motor * gear * [m.back_emf_v_s_rad for m in motors]
    records["loss"] = 1.0 - np.maximum(efficiency, _MIN_EFFICIENCY)
    records["coulomb_nm"] = friction * [m.coulomb_nm for m in motors]
    records["viscous_nm_s_rad"] = friction * [m.viscous_nm_s_rad for m in motors]
    records["rotor_kg_m2"] = gear**2 * [m.rotor_inertia_kg_m2 for m in motors]
    records["linear_nm_rad"], records["cubic_nm_rad3"] = springs.linear_nm_rad, springs.cubic_nm_rad3
    records["half_gap_rad"], records["spring_loss_s"] = springs.gap_rad / 2.0, SPRING_LOSS_S
    ranges = [(-np.inf, np.inf) if t.range_rad is None else t.range_rad for t in types]
    records["min_rad"], records["max_rad"] = np.array(ranges).T
    records["stop_nm_rad"], records["stop_loss_s"] = STOP_NM_RAD, STOP_LOSS_S
    return records

"""The simulated world: a robot in gravity, its motors, sensors and module clocks, in ticks of 1 ms."""

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from module_agent.hardware.hardware import HardwareLost, Readings, SensorSample, WiredModule
from module_agent.model.catalogue import module_type
from module_agent.model.errors import UsageError
from module_agent.model.read_only import read_only
from sim.actuator.actuator import BUS_VOLTAGE_V, Actuators
from sim.actuator.thermal import Windings
from sim.geometry.pose import Array
from sim.imperfections.ageing import Ageing, check_ageing
from sim.imperfections.module_errors import draw_variation
from sim.imperfections.noise_profile import NoiseProfile, noise_profile
from sim.physics.engine import CompiledEngine, Engine, Physics
from sim.physics.equilibrium import equilibrium
from sim.physics.rigid_tree import RigidTree
from sim.physics.skeleton import Skeleton, build_skeleton
from sim.robot.robot_file import Robot
from sim.robot.variants import as_built
from sim.sensors.sensors import Sensors
from sim.world import world_kernel as kernel
from sim.world.external_force import Push, check_pushed

TICK_NS = 1_000_000
TICK_S = 1e-3


def check_imu_rate(rate_hz: float) -> float:
    """Return a rate at which an IMU can be read.

    Raises:
        UsageError: its period is not a whole number of ticks.
    """
    if not (rate_hz > 0.0 and math.isclose(1.0, TICK_S * rate_hz * round(1.0 / (TICK_S * rate_hz)))):
        raise UsageError(
            f"IMU rate {rate_hz:g} Hz: it must be 1000 Hz divided by a whole number, as 50 or 500 Hz"
        )
    return rate_hz


class Plant(NamedTuple):
    """The true state of the modules' joints at the instant of the last samples, (n,) each, read-only.

    duty is what the bridges apply for `pwm`; motor positions and rates are seen at the output;
    spring_torque_nm is what the springs exert on the outputs; with q, qd, qdd and what pushes from outside it
    fulfils the equations of motion.
    structure (p,) is how far the base and the links give: the positions [m, rad] of the passive joints.
    """

    t_ns: int
    pwm: Array
    duty: Array
    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    motor_rad: Array
    motor_rad_s: Array
    spring_torque_nm: Array
    structure: Array


class World:
    """A robot that lives in virtual time; the same seed and PWM give the same samples, bit by bit.

    It is `Wires` to modules in the same process. `sensors` has their clocks and constant errors.

    Position, velocity, effort and IMU of a sample belong to one instant, the beginning of the tick: `t_ns` is
    that instant on the module's clock, and so is `imu_t_ns` in the ticks in which the IMU is read. In between
    the last IMU values are repeated with their own time.

    The world begins at rest, the modules' joints where the robot file has them and all compliant joints at
    their static deflection. `noise_seed` draws the sensors' noise and drift anew for the same modules, as on
    another day; the modules' parameters depend on `seed` alone. `pushes` are external wrenches. `physics` is
    the engine that moves the bodies; by default compiled, PyBullet where there are obstacles to touch.

    Raises:
        UsageError: a push is on no module, the robot's base or links are too soft to carry it, there is no
            such noise profile, the IMU's rate is not a whole fraction of the ticks', the robot overlaps an
            obstacle where it starts, or the engine knows no contact.
    """

    def __init__(
        self,
        robot: Robot,
        seed: int,
        noise: str | NoiseProfile | None = None,
        voltage_v: float = BUS_VOLTAGE_V,
        noise_seed: int | None = None,
        pushes: Sequence[Push] = (),
        imu_rate_hz: float = 250.0,
        physics: Physics | None = None,
    ):
        imu_ticks = round(1.0 / (TICK_S * check_imu_rate(imu_rate_hz)))
        self.profile = noise if isinstance(noise, NoiseProfile) else noise_profile(noise or robot.noise)
        self._seed = seed
        self.robot = robot = as_built(robot, seed, self.profile)
        types = tuple(module_type(m.type) for m in robot.modules)
        drawn = seed, robot.serials, types, self.profile, imu_ticks, TICK_S, noise_seed
        self.sensors = Sensors(*drawn)
        self._skeleton = build_skeleton(robot, self.profile.base_shake, self.profile.link_flex)
        self._joints = np.array(self._skeleton.module)
        self._passive = np.array(self._skeleton.passive, dtype=np.int64)
        self._tree = RigidTree(self._skeleton)
        self._windings = Windings(len(types), TICK_S, self.profile.heat)
        variation = draw_variation(seed, robot.serials, self.profile)
        self._actuators = Actuators(types, TICK_S, self.profile, variation, self._skeleton, voltage_v)
        self._tick = 0
        self.readings = Readings(len(types))
        start, load = equilibrium(robot.name, self._tree, self._skeleton, robot.start_rad)
        self._actuators.reset(robot.start_rad, load)
        self._state = kernel.WorldArrays(
            tree=self._tree.arrays,
            motors=self._actuators.arrays,
            heat=self._windings.arrays,
            sensors=self.sensors.arrays,
            drives=self._actuators.rows,
            q=start,
            qd=np.zeros_like(start),
            ahead=np.zeros_like(start),
            pushed=np.zeros_like(start),
            plant=np.zeros((kernel.PLANT_ROWS, len(types))),
            structure=start[self._passive],
            floats=self.readings.floats,
            integers=self.readings.integers,
            tick_ns=TICK_NS,
        )
        self._plain_state = kernel.plain(self._state)
        plant = self._state.plant
        plant[kernel.Q_RAD], plant[kernel.PLANT_MOTOR_RAD] = robot.start_rad, self._actuators.state.motor_rad
        plant[kernel.SPRING_NM] = load
        self._pushes: list[Push] = []
        self._acting: list[Push] = []
        self._pushes_change_ns = 0
        for one in pushes:
            self.push(one)
        self._physics = _checked_physics(physics, robot)
        self._body = _engine(self._physics, robot, self._skeleton)
        self._body.begin(start)
        self._rehearse()
        self.modules = tuple(
            WiredModule(m.serial, m.type, TICK_NS, imu_ticks * TICK_NS) for m in robot.modules
        )

    @property
    def t_ns(self) -> int:
        """The world's time [ns]: the end of the last tick."""
        return self._tick * TICK_NS

    @property
    def contact_n(self) -> Array:
        """The normal forces of contact on what each module's joint moves up to the next joint, (n,) [N]."""
        total = np.zeros(len(self._joints))
        for body, force_n in enumerate(self._body.contact_n):
            carrier = body
            while carrier >= 0 and carrier not in self._skeleton.module:
                carrier = self._skeleton.parent[carrier]
            if carrier >= 0:
                total[self._skeleton.module.index(carrier)] += force_n
        return read_only(total)

    @property
    def winding_c(self) -> Array:
        """The true temperatures of the motors' windings (n,) [degrees Celsius]."""
        heat = self._windings.arrays
        return read_only(heat.above_k[0] + heat.ambient_c)

    @property
    def plant(self) -> Plant:
        """The true state at the instant of the last samples; at the start before the first tick."""
        t_ns = max(self._tick - 1, 0) * TICK_NS
        state = self._state
        return Plant._make((t_ns, *read_only(state.plant.copy()), read_only(state.structure.copy())))

    def warm(self, above_ambient_k: Array) -> None:
        """Set the modules' temperatures above the ambient: rows winding, housing, body, (3, n) [K]."""
        self._windings.above_k[:] = above_ambient_k

    def push(self, push: Push) -> None:
        """Add an external wrench; may be called between any two steps.

        Raises:
            UsageError: the robot has no such module.
        """
        check_pushed(push, self.robot.serials)
        self._pushes.append(push)
        self._pushes_change_ns = self.t_ns

    def become(self, robot: Robot) -> None:
        """Go on as a robot with the same modules and joints but other links or payloads, moving as before.

        Added mass moves with its body from the first instant on: there is no impact.

        Raises:
            ValueError: other modules, or another number of joints that give.
        """
        robot = as_built(robot, self._seed, self.profile)
        skeleton = build_skeleton(robot, self.profile.base_shake, self.profile.link_flex)
        if robot.serials != self.robot.serials or skeleton.names != self._skeleton.names:
            raise ValueError(
                f"robot {robot.name} has joints {', '.join(skeleton.names)}; those of {self.robot.name} are "
                f"{', '.join(self._skeleton.names)}, and a world keeps its joints"
            )
        body = _engine(self._physics, robot, skeleton)
        body.place(self._state.q, self._state.qd)
        self._body.close()
        self.robot, self._skeleton, self._body, self._tree = robot, skeleton, body, RigidTree(skeleton)
        self._state = self._state._replace(tree=self._tree.arrays)
        self._plain_state = kernel.plain(self._state)

    def change_friction(self, serial: str, factor: float) -> None:
        """Multiply the friction of a module's motor and gear, Coulomb and viscous, from the next tick on.

        Raises:
            ValueError: no such module, or a factor that is negative or not finite.
        """
        if serial not in self.robot.serials:
            raise ValueError(f"no module {serial} here; there are {', '.join(self.robot.serials)}")
        if not (math.isfinite(factor) and factor >= 0.0):
            raise ValueError(f"friction times {factor} is no friction; a number from 0 on is needed")
        self._actuators.change_friction(self.robot.serials.index(serial), factor)

    def age(self, serial: str, ageing: Ageing) -> None:
        """Let a module be as it was built but for its ageing, from the next tick on.

        Raises:
            ValueError: no such module.
            UsageError: an ageing that no module can have.
        """
        if serial not in self.robot.serials:
            raise ValueError(f"no module {serial} here; there are {', '.join(self.robot.serials)}")
        place, ageing = self.robot.serials.index(serial), check_ageing(ageing)
        self._actuators.widen_gap(place, ageing.play_rad)
        self.sensors.age(place, ageing)

    def supply(self, voltage_v: float) -> None:
        """Set the voltage of the modules' supply from the next tick on.

        Raises:
            ValueError: it is not positive and finite.
        """
        if not (math.isfinite(voltage_v) and voltage_v > 0.0):
            raise ValueError(f"{voltage_v} V supply no motor; a positive voltage is needed")
        self._actuators.voltage_v = voltage_v

    def step(self, pwm: Sequence[float]) -> list[SensorSample]:
        """Advance by one tick of 1 ms under one PWM in [-1, 1] per module; return one sample per module.

        Raises:
            ValueError: a PWM is missing, too many or not finite.
            HardwareLost: the world is closed.
        """
        return list(self.exchange(pwm))

    def exchange(self, pwm: Sequence[float]) -> Readings:
        """Advance as `step` does; return `readings`, which hold the samples until the next call."""
        u, state = self._checked(pwm), self._prepared()
        if isinstance(self._body, CompiledEngine):
            kernel.advance(state, self._tick, u)
        else:
            force, qdd, biases, drives = kernel.begin(state, u, self._body.rates)
            q, qd = self._body.step(force, qdd, biases)
            kernel.end(state, self._tick, u, q, qd, drives)
        self._tick += 1
        return self.readings

    def _prepared(self) -> Any:
        """Return the state for the kernels, with what the next tick needs: noise, and what pushes."""
        self.sensors.refill()
        if self._pushes:
            self._state.pushed[:] = self._pushed(self._state.q)
        return self._plain_state

    @property
    def plant_rows(self) -> Array:
        """The memory of `plant`, rows as in `world_kernel`, which the next tick overwrites."""
        return self._state.plant

    @property
    def can_run_ahead(self) -> bool:
        """Whether a kernel can run any number of ticks: the engine is compiled, and nothing will push."""
        return isinstance(self._body, CompiledEngine) and not self._pushes

    def begin_run(self, pwm: Sequence[float]) -> tuple[Any, int, Array]:
        """Return what `world_kernel.tick` needs for a run of ticks: state, number of the first one, its PWM.

        Raises:
            ValueError, HardwareLost: as `step`.
        """
        u = self._checked(pwm)
        return self._prepared(), self._tick, u

    def end_run(self, ticks: int) -> None:
        """Go on from where so many ticks have led."""
        self._tick += ticks

    def close(self) -> None:
        """End the world. May be called twice."""
        self._body.close()

    def _checked(self, pwm: Sequence[float]) -> Array:
        if self._body.closed:
            raise HardwareLost("the world is closed")
        if len(pwm) != len(self.modules):
            raise ValueError(f"{len(pwm)} PWM values for {len(self.modules)} modules")
        if not all(map(math.isfinite, pwm)):
            wrong = next(k for k, value in enumerate(pwm) if not math.isfinite(value))
            serial = self.modules[wrong].serial
            raise ValueError(f"PWM of module {serial} is {pwm[wrong]}; it must be a number in [-1, 1]")
        # Most are within the limits, which is cheaper to see than to enforce.
        within = min(pwm) >= -1.0 and max(pwm) <= 1.0
        return np.array(pwm if within else [min(max(value, -1.0), 1.0) for value in pwm], dtype=np.float64)

    def _pushed(self, q: Array) -> Array:
        """Return the generalised forces (m,) of the pushes at this instant; drop those that have ended."""
        if self.t_ns >= self._pushes_change_ns:
            self._pushes = [push for push in self._pushes if not push.is_over(self.t_ns)]
            self._acting = [push for push in self._pushes if push.acts(self.t_ns)]
            edges_ns = [edge_ns for push in self._pushes for edge_ns in push.lasts_ns]
            self._pushes_change_ns = min((ns for ns in edges_ns if ns > self.t_ns), default=self.t_ns)
        load = np.zeros_like(q)
        for push in self._acting:
            body = int(self._joints[self.robot.serials.index(push.serial)])
            wrench = np.array(push.at_m), np.array(push.force_n), np.array(push.torque_nm)
            load += self._tree.joint_loads(q, body, *wrench)
        return load

    def _rehearse(self) -> None:
        """Call every function that is compiled at its first call, which would stop real time for seconds."""
        self.sensors.refill()
        state, idle = deepcopy(self._plain_state), np.zeros(len(self._joints))
        q, qd = np.array((self._state.q, self._state.qd))
        self._tree.joint_loads(q, 0, *np.zeros((3, 3)))
        if isinstance(self._body, CompiledEngine):
            kernel.advance(state, 0, idle)
        else:
            drives = kernel.begin(state, idle, self._body.rates)[3]
            kernel.end(state, 0, idle, q, qd, drives)


def _checked_physics(physics: Physics | None, robot: Robot) -> Physics:
    if not robot.obstacles:
        return physics or "compiled"
    if physics == "compiled":
        raise UsageError(
            f"robot {robot.name} has obstacles, and compiled physics knows no contact: choose pybullet"
        )
    return "pybullet"


def _engine(physics: Physics, robot: Robot, skeleton: Skeleton) -> Engine:
    if physics == "compiled":
        return CompiledEngine(skeleton, TICK_S)
    # Loading PyBullet takes a quarter of a second, which worlds without it need not wait for.
    from sim.physics.multibody import Multibody

    return Multibody(robot.name, skeleton, TICK_S, robot.obstacles)

"""One tick of a world, compiled: motors, springs and bodies, temperatures and all sensors of all modules.

A tick is `_forces`, an engine's step, `_after`. The compiled engine's step is here too, so that its tick is
one call (`advance`), or a part of one call for many ticks; another engine's is between `begin` and `end`.

Kernels take the state as plain tuples (`plain`), which are handed over in a third of the time of named ones.

The integrator is a leapfrog: its velocities live half a tick before its positions. Velocity forces are those
of the velocity that the last acceleration predicts for the instant of the positions. The velocity at that
instant is the mean of the two around it, the acceleration their difference.
"""

from typing import Any, NamedTuple

import numpy as np

from module_agent.model.compiled import compiled_with
from sim.actuator import actuator_kernel, thermal
from sim.actuator.actuator_kernel import (
    COPPER_W,
    CURRENT_A,
    DUTY,
    ELASTIC_NM,
    MOTOR_RAD,
    RATE_RAD_S,
    ROWS,
    TORQUE_NM,
    Motors,
    drive,
)
from sim.actuator.actuator_kernel import Work as MotorWork
from sim.actuator.actuator_kernel import work_of as motor_work_of
from sim.actuator.thermal import Heat, warm
from sim.geometry.pose import Array
from sim.imperfections.random_streams import Draws
from sim.physics import engine, rigid_kernels
from sim.physics.engine import integrate
from sim.physics.rigid_kernels import Tree, feel, put_bodies, weigh
from sim.physics.rigid_kernels import Work as BodyWork
from sim.physics.rigid_kernels import work_of as body_work_of
from sim.sensors import imu, joint, sensors
from sim.sensors.imu import ImuArrays, follow_imus
from sim.sensors.joint import JointArrays
from sim.sensors.sensors import Integers, SensorArrays, imus_due, read_all

# Whose kernels become part of those here, and of those that call them.
PARTS = (rigid_kernels, engine, actuator_kernel, thermal, imu, joint, sensors)
# Rows of `WorldArrays.plant`.
PLANT_PWM, PLANT_DUTY, Q_RAD, QD_RAD_S, QDD_RAD_S2, PLANT_MOTOR_RAD, PLANT_MOTOR_RAD_S, SPRING_NM = range(8)
PLANT_ROWS = 8


class WorldArrays(NamedTuple):
    """The state of a world with m joints and n modules, and its constants.

    drives (ROWS, n): rows of `ActuatorState`. q, qd (m,): positions, and velocities half a tick before them.
    ahead (m,): by how much the last acceleration changes a velocity in half a tick. pushed (m,): generalised
    forces from outside. plant (PLANT_ROWS, n), structure (p,): the true state at the instant of the last
    samples. floats, integers (n, 17): these samples, see `Readings`.
    """

    tree: Tree
    motors: Motors
    heat: Heat
    sensors: SensorArrays
    drives: Array
    q: Array
    qd: Array
    ahead: Array
    pushed: Array
    plant: Array
    structure: Array
    floats: Array
    integers: Integers
    tick_ns: int


def plain(value: Any) -> Any:
    """Return named tuples as plain ones, those within them too."""
    return tuple(map(plain, value)) if isinstance(value, tuple) else value


@compiled_with(*PARTS, inline=True)
def named(state: Any) -> WorldArrays:
    """Return what `plain` was made of."""
    tree, motors, heat, own, drives, q, qd, ahead, pushed, plant, structure, floats, integers, tick_ns = state
    joints, imus, clocks, imu_values, imu_ns, imu_ticks, every_tick = own
    settings, fixed, noise, jitter, memory = joints
    taps, off, axes, scale, g, bias, per_speed, sizes, keep, renew, drift, filtered = imus[:12]
    joint_arrays = JointArrays(settings, fixed, Draws(*noise), Draws(*jitter), memory)
    draws = Draws(*imus[12]), Draws(*imus[13]), Draws(*imus[14]), Draws(*imus[15])
    imu_arrays = ImuArrays(
        taps, off, axes, scale, g, bias, per_speed, sizes, keep, renew, drift, filtered, *draws
    )
    return WorldArrays(
        Tree(*tree),
        Motors(*motors),
        Heat(*heat),
        SensorArrays(joint_arrays, imu_arrays, clocks, imu_values, imu_ns, imu_ticks, every_tick),
        drives,
        q,
        qd,
        ahead,
        pushed,
        plant,
        structure,
        floats,
        integers,
        tick_ns,
    )


class Work(NamedTuple):
    """What the parts of a tick hand to each other.

    rates, biases (R, m): velocities, the first of them that of the instant, and their bias forces. matrix
    (m, m). after (ROWS, n): the drives' next state. q, qd (m,): the bodies' next state. rate, change (m,):
    velocity and acceleration of the instant.
    gyro, force (n, 3): the truth of the IMUs. ohms, celsius (n,): resistances over cold ones, and windings.
    """

    bodies: BodyWork
    motors: MotorWork
    rates: Array
    biases: Array
    matrix: Array
    after: Array
    q: Array
    qd: Array
    rate: Array
    change: Array
    gyro: Array
    force: Array
    ohms: Array
    celsius: Array


@compiled_with(*PARTS)
def work_of(own: WorldArrays, rates: int) -> Work:
    """Return the work space of a world, for an engine that needs so many rows of bias forces."""
    m, n = len(own.q), own.floats.shape[0]
    return Work(
        body_work_of(m),
        motor_work_of(m, n),
        np.empty((rates, m)),
        np.empty((rates, m)),
        np.empty((m, m)),
        np.empty((ROWS, n)),
        np.empty(m),
        np.empty(m),
        np.empty(m),
        np.empty(m),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty(n),
        np.empty(n),
    )


@compiled_with(*PARTS, inline=True)
def _forces(own: WorldArrays, pwm: Array, w: Work) -> None:
    """Fill in the forces and accelerations of the instant, and the drives' next state."""
    rates, biases, ohms = w.rates, w.biases, w.ohms
    qd, ahead, pushed = own.qd, own.ahead, own.pushed
    above_k, copper_per_k = own.heat.above_k, own.heat.copper_per_k
    for k in range(len(rates)):
        for j in range(len(qd)):
            rates[k, j] = qd[j]
    for j in range(len(qd)):
        rates[0, j] += ahead[j]
    weigh(own.tree, own.q, rates, w.bodies, w.matrix, biases)
    for j in range(len(qd)):
        biases[0, j] -= pushed[j]
    for i in range(len(pwm)):
        ohms[i] = 1.0 + copper_per_k * above_k[0, i]
    drive(own.motors, own.drives, pwm, w.ohms, w.matrix, w.biases[0], own.q, own.qd, w.motors, w.after)


@compiled_with(*PARTS, inline=True)
def _after(own: WorldArrays, tick: int, pwm: Array, q: Array, qd: Array, w: Work) -> None:
    """End a tick with the new positions and velocities (m,): truth, samples and temperatures."""
    before, ahead, rate, change, per_s = own.qd, own.ahead, w.rate, w.change, 1.0 / own.motors.dt_s
    for j in range(len(q)):
        rate[j] = (before[j] + qd[j]) * 0.5
        ahead[j] = rate[j] - before[j]
        change[j] = (qd[j] - before[j]) * per_s
    _note(own, pwm, w)
    if imus_due(own.sensors, tick):
        feel(own.tree, w.rate, w.change, w.bodies, w.gyro, w.force)
        follow_imus(own.sensors.imu, w.gyro, w.force)
    celsius, above_k, ambient_c = w.celsius, own.heat.above_k, own.heat.ambient_c
    for i in range(len(pwm)):
        celsius[i] = above_k[0, i] + ambient_c
    read_all(
        own.sensors,
        tick,
        tick * own.tick_ns,
        own.plant[Q_RAD],
        own.plant[QD_RAD_S],
        w.after[RATE_RAD_S],
        w.after[ELASTIC_NM],
        w.after[CURRENT_A],
        w.celsius,
        own.motors.supply_v[0],
        own.floats,
        own.integers,
    )
    warm(own.heat, w.after[COPPER_W])
    _copy(q, qd, w.after, own.q, own.qd, own.drives)


@compiled_with(*PARTS, inline=True)
def _note(own: WorldArrays, pwm: Array, w: Work) -> None:
    """Write the true state of the instant to `plant` and `structure`."""
    plant, structure, q, drives, after = own.plant, own.structure, own.q, own.drives, w.after
    modules, passives, rate, change = own.motors.modules, own.motors.passives, w.rate, w.change
    for i in range(len(pwm)):
        j = modules[i].joint
        plant[PLANT_PWM, i], plant[PLANT_DUTY, i] = pwm[i], after[DUTY, i]
        plant[Q_RAD, i], plant[QD_RAD_S, i], plant[QDD_RAD_S2, i] = q[j], rate[j], change[j]
        plant[PLANT_MOTOR_RAD, i] = drives[MOTOR_RAD, i]
        plant[PLANT_MOTOR_RAD_S, i] = after[RATE_RAD_S, i]
        plant[SPRING_NM, i] = after[TORQUE_NM, i]
    for k in range(len(structure)):
        structure[k] = q[passives[k].joint]


@compiled_with(*PARTS)
def _copy(q: Array, qd: Array, drives: Array, own_q: Array, own_qd: Array, own_drives: Array) -> None:
    for j in range(len(q)):
        own_q[j], own_qd[j] = q[j], qd[j]
    for row in range(ROWS):
        for i in range(drives.shape[1]):
            own_drives[row, i] = drives[row, i]


@compiled_with(*PARTS)
def keep_truth(plant: Array, t_ns: int, truth: Any) -> None:
    """Keep the true state of a tick where it is due; plant as in `WorldArrays`, truth of a `TruthLog`."""
    stamps, rows, counts = truth
    if counts[2] == 0:
        return
    due = counts[0] % counts[2] == 0
    counts[0] += 1
    if not due:
        return
    at = counts[1]
    counts[1] = at + 1
    stamps[at] = t_ns
    for i in range(plant.shape[1]):
        rows[at, 0, i], rows[at, 1, i], rows[at, 2, i] = (
            plant[Q_RAD, i],
            plant[QD_RAD_S, i],
            plant[SPRING_NM, i],
        )


@compiled_with(*PARTS, inline=True)
def tick(own: WorldArrays, number: int, pwm: Array, w: Work) -> None:
    """Run one tick with the compiled engine; pwm (n,) in [-1, 1]."""
    _forces(own, pwm, w)
    integrate(own.q, own.qd, w.motors.qdd, own.motors.dt_s, w.q, w.qd)
    _after(own, number, pwm, w.q, w.qd, w)


@compiled_with(*PARTS)
def advance(state: Any, number: int, pwm: Array) -> None:
    """Run one tick by itself, see `tick`."""
    own = named(state)
    tick(own, number, pwm, work_of(own, 1))


@compiled_with(*PARTS)
def begin(state: Any, pwm: Array, rates: int) -> tuple[Array, Array, Array, Array]:
    """Begin a tick of another engine: return forces, accelerations (m,), biases (rates, m), next drives."""
    own = named(state)
    w = work_of(own, rates)
    _forces(own, pwm, w)
    return w.motors.whole, w.motors.qdd, w.biases, w.after


@compiled_with(*PARTS)
def end(state: Any, number: int, pwm: Array, q: Array, qd: Array, drives: Array) -> None:
    """End a tick of another engine, which gave positions and velocities (m,)."""
    own = named(state)
    w = work_of(own, 1)
    put_bodies(own.tree, own.q, w.bodies)
    for row in range(ROWS):
        for i in range(len(pwm)):
            w.after[row, i] = drives[row, i]
    _after(own, number, pwm, q, qd, w)

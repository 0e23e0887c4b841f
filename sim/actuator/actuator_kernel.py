"""One step of all motors, springs and passive joints, solved together with the bodies' inertia; compiled.

The equations are those of `sim.actuator.actuator`.
"""

from typing import Any, NamedTuple

import numpy as np

from module_agent.model.compiled import compiled
from sim.geometry.pose import Array

Records = np.ndarray[Any, np.dtype[np.void]]

# per_amp_nm: the motor's torque at the output, likewise volts per speed; loss: the gear's, 1 - efficiency;
# min_rad, max_rad: the end stops, infinite without.
_CONSTANTS = (
    *("resistance_ohm", "per_amp_nm", "loss", "coulomb_nm", "viscous_nm_s_rad", "rotor_kg_m2"),
    *("linear_nm_rad", "cubic_nm_rad3", "spring_loss_s", "half_gap_rad"),
    *("min_rad", "max_rad", "stop_nm_rad", "stop_loss_s"),
)
MODULE = np.dtype([("joint", np.int64), *((name, np.float64) for name in _CONSTANTS)])
PASSIVE = np.dtype([("joint", np.int64), ("stiffness", np.float64), ("damping", np.float64)])


class ActuatorState(NamedTuple):
    """The state of n modules after a step, (n,) each; positions, speeds and torques are seen at the output.

    motor_rad and motor_rad_s belong to the end of the step, the speeds half a step before the positions; all
    others to its beginning, motor_rate_rad_s being the motors' speeds there. torque_nm is what the springs
    exert on the outputs, elastic_nm that without the springs' own loss. deflection_rad is the springs' own,
    output minus motor, without the gear's gap; duty what the bridges apply. The powers say where the
    electrical power went; the rest of it is stored in rotors and springs.
    """

    motor_rad: Array
    motor_rad_s: Array
    torque_nm: Array
    duty: Array
    current_a: Array
    deflection_rad: Array
    elastic_nm: Array
    motor_rate_rad_s: Array
    electrical_w: Array
    output_w: Array
    copper_w: Array
    friction_w: Array
    gear_w: Array
    spring_w: Array


class Motors(NamedTuple):
    """The constants of n modules `MODULE` and of passive joints `PASSIVE`; bus voltage (1,), and step."""

    modules: Records
    passives: Records
    supply_v: Array
    dt_s: float


class Work(NamedTuple):
    """What a step calculates on its way, of m joints or n modules; see `drive`.

    pull, added: a joint's force at qdd = 0, and by how much it falls with qdd, without end stops. force:
    without end stops; whole: with them. momentum, inertia: of a motor over the step. stopped, stiffened: an
    end stop's torque at qdd = 0, and by how much it falls with qdd.
    """

    pull: Array
    added: Array
    qdd: Array
    force: Array
    whole: Array
    momentum: Array
    inertia: Array
    stopped: Array
    stiffened: Array


@compiled
def work_of(m: int, n: int) -> Work:
    """Return the work space for m joints and n modules."""
    return Work(
        np.empty(m),
        np.empty(m),
        np.empty(m),
        np.empty(m),
        np.empty(m),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
    )


# Gains are normalised to 48 V: the duty applied is the firmware's PWM times 48 V / bus voltage.
GAIN_VOLTAGE_V = 48.0
# Rows of the state, as Numba knows them.
MOTOR_RAD, MOTOR_RAD_S, TORQUE_NM, DUTY, CURRENT_A, DEFLECTION_RAD, ELASTIC_NM, RATE_RAD_S = range(8)
ELECTRICAL_W, OUTPUT_W, COPPER_W, FRICTION_W, GEAR_W, SPRING_W = range(8, 14)
ROWS = len(ActuatorState._fields)


@compiled
def _clamp(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


@compiled
def _solve(matrix: Array, x: Array) -> None:
    """Solve a symmetric positive definite system in place, by Cholesky's factors; x becomes the solution.

    The upper triangle alone is read. Inner loops go along rows, and sums are in the order of their terms.
    """
    m = len(x)
    for j in range(m):
        pivot = np.sqrt(matrix[j, j])
        matrix[j, j] = pivot
        for k in range(j + 1, m):
            matrix[j, k] /= pivot
        for i in range(j + 1, m):
            factor = matrix[j, i]
            for k in range(i, m):
                matrix[i, k] -= factor * matrix[j, k]
    for k in range(m):
        x[k] /= matrix[k, k]
        for i in range(k + 1, m):
            x[i] -= matrix[k, i] * x[k]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            x[i] -= matrix[i, k] * x[k]
        x[i] /= matrix[i, i]


@compiled
def _spring(own: Any, stretch: float, rate: float) -> tuple[float, float, float, float]:
    """Return deflection, elastic torque, whole torque, and stiffness; the stiffness is 0 without contact."""
    y = stretch - _clamp(stretch, own.half_gap_rad)
    elastic = (own.linear_nm_rad + own.cubic_nm_rad3 * y * y) * y
    stiffness = own.linear_nm_rad + 3.0 * own.cubic_nm_rad3 * y * y
    push = elastic + own.spring_loss_s * stiffness * rate
    # Flanks of teeth do not pull: contact is lost if the spring relaxes more slowly than the gap opens.
    if own.half_gap_rad > 0.0 and (y == 0.0 or push * y < 0.0):
        return y, elastic, 0.0, 0.0
    return y, elastic, push, stiffness


@compiled
def advance(
    motors: Motors,
    state: Array,
    pwm: Array,
    resistance_factor: Array,
    mass: Array,
    bias: Array,
    q: Array,
    qd: Array,
) -> tuple[Array, Array, Array]:
    """Return the joints' forces (m,) for one step, their accelerations (m,), and the next state (ROWS, n)."""
    m, n = len(q), len(motors.modules)
    work, after = work_of(m, n), np.empty((ROWS, n))
    drive(motors, state, pwm, resistance_factor, mass.copy(), bias, q, qd, work, after)
    return work.whole, work.qdd, after


@compiled
def drive(
    motors: Motors,
    state: Array,
    pwm: Array,
    resistance_factor: Array,
    matrix: Array,
    bias: Array,
    q: Array,
    qd: Array,
    w: Work,
    after: Array,
) -> None:
    """Fill in forces `w.whole`, accelerations `w.qdd`, next state (ROWS, n); the mass matrix is used up."""
    modules, passives, supply_v, dt_s = motors
    voltage_v = supply_v[0]
    pull, added, qdd, force, whole, momentum, inertia, stopped, stiffened = w
    for i in range(len(passives)):
        one = passives[i]
        pull[one.joint] = -(one.stiffness * q[one.joint] + one.damping * qd[one.joint])
        added[one.joint] = one.stiffness * dt_s * dt_s / 4.0 + one.damping * dt_s / 2.0
    for i in range(len(modules)):
        j = modules[i].joint
        after[DUTY, i] = _clamp(pwm[i] * (GAIN_VOLTAGE_V / voltage_v), 1.0)
        drive_v = after[DUTY, i] * voltage_v
        pull[j], added[j], momentum[i], inertia[i], after[CURRENT_A, i] = _pull(
            modules[i], state, i, drive_v, resistance_factor[i], dt_s, q[j], qd[j]
        )
        stopped[i], stiffened[i] = _stop(modules[i], q[j], qd[j], dt_s)
    # (M + diag(added)) qdd = pull - bias follows by eliminating the motors' accelerations and the torques.
    for j in range(len(q)):
        matrix[j, j] += added[j]
        qdd[j] = pull[j] - bias[j]
    for i in range(len(modules)):
        j = modules[i].joint
        matrix[j, j] += stiffened[i]
        qdd[j] += stopped[i]
    _solve(matrix, qdd)
    for j in range(len(q)):
        force[j] = pull[j] - added[j] * qdd[j]
        whole[j] = force[j]
    for i in range(len(modules)):
        own = modules[i]
        j = own.joint
        whole[j] += stopped[i] - stiffened[i] * qdd[j]
        limit = _friction_limit(own, after[CURRENT_A, i])
        free = momentum[i] - force[j]
        friction = _clamp(free, limit)
        after[MOTOR_RAD_S, i] = (free - friction) * dt_s / inertia[i]
        after[MOTOR_RAD, i] = state[MOTOR_RAD, i] + dt_s * after[MOTOR_RAD_S, i]
        after[TORQUE_NM, i] = force[j]
        after[RATE_RAD_S, i] = (state[MOTOR_RAD_S, i] + after[MOTOR_RAD_S, i]) / 2.0
        share = own.coulomb_nm / limit if limit > 0.0 else 0.0
        ohm = own.resistance_ohm * resistance_factor[i]
        stretch, rate = state[MOTOR_RAD, i] - q[j], qd[j] + dt_s / 2.0 * qdd[j]
        _account(own, ohm, voltage_v, friction, share, stretch, rate, after, i)


@compiled
def _stop(own: Any, q: float, qd: float, dt_s: float) -> tuple[float, float]:
    """Return an end stop's torque on the output at qdd = 0, and by how much it falls with qdd."""
    beyond = q - min(max(q, own.min_rad), own.max_rad)
    # Implicit Euler, as the impact of an unloaded output is shorter than a step: with a rule that conserves
    # energy it would bounce for ever.
    push = own.stop_nm_rad * (beyond + (dt_s + own.stop_loss_s) * qd)
    # A stop does not pull.
    if beyond == 0.0 or push * beyond <= 0.0:
        return 0.0, 0.0
    return -push, own.stop_nm_rad * (dt_s + own.stop_loss_s) * dt_s


@compiled
def _friction_limit(own: Any, amps: float) -> float:
    limit: float = own.coulomb_nm + own.loss / 2.0 * own.per_amp_nm * abs(amps)
    return limit


@compiled
def _pull(
    own: Any,
    state: Array,
    i: int,
    drive_v: float,
    resistance_factor: float,
    dt_s: float,
    q: float,
    qd: float,
) -> tuple[float, float, float, float, float]:
    """Return the spring's torque at qdd = 0, by how much it falls with qdd, momentum, inertia and current.

    The momentum is the motor's over the step without friction and spring.
    """
    speed = state[MOTOR_RAD_S, i]
    ohm = own.resistance_ohm * resistance_factor
    mean = (1.0 - own.loss / 2.0) * own.per_amp_nm
    drag = own.viscous_nm_s_rad + mean * own.per_amp_nm / ohm
    inertia = own.rotor_kg_m2 + dt_s / 2.0 * drag
    drive = mean * drive_v / ohm
    # The current of this instant, half a step ahead of the speed, as the last change of speed predicts.
    amps = (drive_v - own.per_amp_nm * (2.0 * speed - state[RATE_RAD_S, i])) / ohm
    momentum = drive + (own.rotor_kg_m2 / dt_s - drag / 2.0) * speed
    # Friction as the last step's torque predicts it; only the spring's second-order term depends on it.
    friction = _clamp(momentum - state[TORQUE_NM, i], _friction_limit(own, amps))
    _, _, push, stiffness = _spring(own, state[MOTOR_RAD, i] - q, speed - qd)
    g = stiffness * (dt_s / 4.0 + own.spring_loss_s / 2.0) * dt_s
    shrink = 1.0 / (1.0 + g / inertia)
    pull = shrink * (push + g / inertia * (drive - drag * speed - friction))
    return pull, shrink * g, momentum, inertia, amps


@compiled
def _account(
    own: Any,
    ohm: float,
    voltage_v: float,
    friction: float,
    coulomb_share: float,
    stretch: float,
    output_rad_s: float,
    after: Array,
    i: int,
) -> None:
    """Fill in the current at the instant itself and all powers; every entry by its own law."""
    rate = after[RATE_RAD_S, i]
    amps = (after[DUTY, i] * voltage_v - own.per_amp_nm * rate) / ohm
    y, elastic, push, _ = _spring(own, stretch, rate - output_rad_s)
    after[CURRENT_A, i], after[DEFLECTION_RAD, i], after[ELASTIC_NM, i] = amps, -y, elastic
    after[ELECTRICAL_W, i] = after[DUTY, i] * voltage_v * amps
    after[OUTPUT_W, i] = after[TORQUE_NM, i] * output_rad_s
    after[COPPER_W, i] = amps * amps * ohm
    after[FRICTION_W, i] = (coulomb_share * friction + own.viscous_nm_s_rad * rate) * rate
    after[GEAR_W, i] = (own.loss / 2.0 * own.per_amp_nm * amps + (1.0 - coulomb_share) * friction) * rate
    after[SPRING_W, i] = (push - elastic) * (rate - output_rad_s)

"""The quiet tick of all modules of a process in one call, compiled: nothing arrives, nothing changes state.

For each module it does what `SampleCheck`, `Firmware`, `Controller`, `MotorGuard` and `FeedbackStream` do in
such a tick, in the same order of operations, so that the results are equal to the bit. Those classes are the
definition; a module whose tick is not quiet is left untouched here, and they run it.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from module_agent.model.compiled import compiled
from module_agent.wire.feedback_rows import ROW

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Records = np.ndarray[Any, np.dtype[np.void]]

# What a tick leaves of a module: it is to be run by Python; nothing; a feedback row.
NOT_QUIET, QUIET, ROW_DUE = 0, 1, 2
# Where the targets come from: as they are; from the motion; the brake, while they stay.
FOLLOW, MOTION, BRAKE = 0, 1, 2

# What only Python changes: settings, and the state of firmware and lease.
MODULE = np.dtype(
    [
        *((name, np.int64) for name in ("ready", "source", "commanded", "in_fault", "fresh_ns")),
        *((name, np.int64) for name in ("lifetime_ns", "lease_until_ns", "status_due_ns")),
        *((name, np.int64) for name in ("motion_start_ns", "motion_end_ns", "motion_id", "state")),
        *((name, np.int64) for name in ("strategy", "follows_motor", "row_period_ns", "half_tick_ns")),
        *((name, np.int64) for name in ("imu_period_ns", "waits_for_imu")),
        ("winding_c", np.float64),
        # As `motor_guard.Bounds` has them.
        *((name, np.int64) for name in ("low", "high")),
        *((name, np.float64) for name in ("low_rad", "high_rad", "margin_rad")),
        *((name, np.float64) for name in ("max_motor_rad_s", "ceiling_c")),
        *((name, np.float64) for name in ("min_rad_s", "max_rad_s", "min_nm", "max_nm")),
        *((name, np.float64) for name in ("min_push", "max_push", "braking_rad_s2", "gear_ratio")),
        *((name, np.float64) for name in ("emf_pwm", "stiff_pwm", "load_pwm")),
    ]
)
# Of each loop (position, velocity, effort).
LOOP = np.dtype(
    [
        *((name, np.float64) for name in ("kp", "ki", "kd", "feed_forward", "dead_zone", "i_clamp", "punch")),
        *((name, np.float64) for name in ("min_target", "max_target", "target_lowpass")),
        *((name, np.float64) for name in ("min_output", "max_output", "output_lowpass", "dt_s")),
        *((name, np.int64) for name in ("d_on_error", "plain")),
    ]
)
# What a quiet tick changes. Of each loop: whether it has a target, a last error and an output, and these.
HAS_TARGET, TARGET, HAS_LAST, LAST_ERROR, LAST_MEASURED, INTEGRAL, HAS_OUTPUT, OUTPUT = range(8)
MEMORY = 8
# Of each module, floats: its targets and its PWM; integers: when a row is due, the last IMU time, whether its
# loops run, what limits the PWM, the time of the last tick, what has limited it since the last status, and by
# how much its clock has fallen behind one that runs at half its rate.
POSITION, VELOCITY, EFFORT, PWM = range(4)
ROW_DUE_NS, LAST_IMU_NS, RUNNING, LIMIT, NOW_NS, LIMITED, BEHIND_NS = range(7)
INTEGERS = 7

# Columns of a reading, in the order of `SensorSample`.
T_NS, IMU_NS = 0, 1
Q, QD, TAU, DEFLECTION, MOTOR_RATE, CURRENT, WINDING, VOLTAGE = range(2, 10)
GYRO, ACCEL, DEFLECTION_RATE = 10, 13, 16
COLUMNS = 17

_VECTORS = ("gyro_rad_s", "accel_m_s2")
_SCALARS = [name for name in ROW.names or () if name not in _VECTORS]
# The record of `ROW` with its vectors element by element.
FLAT_ROW: np.dtype[np.void] = np.dtype(
    {  # type: ignore[call-overload]
        "names": [*_SCALARS, "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"],
        "formats": [*(ROW[name] for name in _SCALARS), *("<f4",) * 6],
        "offsets": [
            *(ROW.fields[name][1] for name in _SCALARS),  # type: ignore[index]
            *(ROW.fields[name][1] + 4 * k for name in _VECTORS for k in range(3)),  # type: ignore[index]
        ],
        "itemsize": ROW.itemsize,
    }
)

# As in `control.controller`, `hardware.motor_guard` and `firmware.firmware`; a test compares them.
# Machine code that is kept does not follow constants of other files.
NOMINAL_VOLTAGE_V = 48.0
DAMPING_LIMIT_PWM = 0.25
STOP, OFF, SPRING = 1, 2, 4
APPROACH_PER_S, RETURN_RAD_S, RELEASE = 5.0, 0.1, 4.0
STEP_NS = 1_000_000
LIMIT_NONE, LIMIT_POSITION, LIMIT_VELOCITY, LIMIT_EFFORT = 0, 1, 2, 4
LIMIT_TEMPERATURE, LIMIT_OVER_TEMPERATURE = 8, 16


@compiled
def tick(
    times: Integers,
    readings: Floats,
    last: Floats,
    modules: Records,
    most: Floats,
    loops: Records,
    memory: Floats,
    motion: Floats,
    floats: Floats,
    integers: Integers,
    rows: Records,
    results: NDArray[np.uint8],
) -> int:
    """Run the quiet ticks of n modules; return how many of them need Python, and say in `results` (n,) which.

    times, readings (n, 17) are one block of memory, the times its first two columns; last (n, 17) are those
    of the last tick. modules (n,) `MODULE`, most (n, 15) the largest readings, loops (n, 3) `LOOP`, memory
    (n, 3, 8), motion (n, 3, samples) targets every millisecond, floats (n, 4), integers (n, 7), rows (n,)
    `FLAT_ROW`.
    """
    others = 0
    for i in range(len(modules)):
        own, now_ns = modules[i], times[i, T_NS]
        results[i] = NOT_QUIET
        imu_ns, before_ns, imu_before_ns = times[i, IMU_NS], integers[i, NOW_NS], integers[i, LAST_IMU_NS]
        is_imu_possible = imu_before_ns <= imu_ns <= now_ns
        behind_ns = max(integers[i, BEHIND_NS] + own.half_tick_ns - (now_ns - before_ns), 0)
        if not (
            own.ready
            and is_imu_possible
            and behind_ns <= own.lifetime_ns
            and _is_quiet(own, now_ns, before_ns, readings[i], most[i])
        ):
            others += 1
            continue
        integers[i, BEHIND_NS] = behind_ns
        integers[i, LIMITED] |= integers[i, LIMIT]
        if own.source == MOTION:
            step = (now_ns - own.motion_start_ns) // STEP_NS
            for k in range(3):
                floats[i, k] = motion[i, k, step]
        pwm = _drive(own, loops[i], memory[i], floats[i], integers[i], readings[i])
        floats[i, PWM] = pwm
        results[i] = QUIET
        if _row_due(own, now_ns, imu_ns, integers[i]):
            _fill(rows[i], own, times[i], readings[i], floats[i])
            results[i] = ROW_DUE
        integers[i, NOW_NS] = now_ns
        for k in range(COLUMNS):
            last[i, k] = readings[i, k]
    return others


@compiled
def _is_quiet(own: Any, now_ns: int, before_ns: int, reading: Floats, most: Floats) -> bool:
    if now_ns <= before_ns or now_ns >= own.lease_until_ns or now_ns >= own.status_due_ns:
        return False
    if own.commanded and (
        now_ns - own.fresh_ns > own.lifetime_ns or 2 * (now_ns - before_ns) > own.lifetime_ns
    ):
        return False
    if own.source == MOTION and now_ns >= own.motion_end_ns:
        return False
    if reading[WINDING] >= own.winding_c and not own.in_fault:
        return False
    if (own.low == OFF or own.high == OFF) and _has_arrived(own, reading):
        return False
    bad = 0
    for k in range(len(most)):
        # A comparison with NaN is false.
        bad += not abs(reading[k + 2]) <= most[k]
    return bad == 0


@compiled
def _drive(
    own: Any, loops: Records, memory: Floats, targets: Floats, integers: Integers, reading: Floats
) -> float:
    position, velocity, effort = targets[POSITION], targets[VELOCITY], targets[EFFORT]
    braked = own.source == BRAKE
    if not braked and (position == position or velocity == velocity or effort == effort):
        integers[RUNNING] = 1
        speed = reading[QD]
        if own.follows_motor:
            speed -= reading[DEFLECTION_RATE]
        pwm = _law(own.strategy, loops, memory, targets, reading[Q], speed, reading[TAU])
        return _limit(own, pwm, integers, reading)
    if integers[RUNNING]:
        integers[RUNNING] = 0
        for k in range(3):
            _reset(memory[k])
    if braked:
        most = -reading[MOTOR_RATE] / own.max_motor_rad_s
        damping = most
        if damping < -DAMPING_LIMIT_PWM:
            damping = -DAMPING_LIMIT_PWM
        if damping > DAMPING_LIMIT_PWM:
            damping = DAMPING_LIMIT_PWM
        damping = _limit(own, damping, integers, reading)
        if most < 0.0:
            return most if damping < most else 0.0 if damping > 0.0 else damping
        return most if damping > most else 0.0 if damping < 0.0 else damping
    integers[LIMIT] = LIMIT_NONE
    return 0.0


@compiled
def _law(
    strategy: int,
    loops: Records,
    memory: Floats,
    targets: Floats,
    q_rad: float,
    qd_rad_s: float,
    effort_nm: float,
) -> float:
    position, velocity, effort = targets[POSITION], targets[VELOCITY], targets[EFFORT]
    if strategy == 0:
        return 0.0
    if strategy == 1:
        return 0.0 if effort != effort else _clip(effort)
    if strategy == 3:
        return _clip(
            _follow(loops[0], memory[0], position, q_rad)
            + _follow(loops[1], memory[1], velocity, qd_rad_s)
            + _follow(loops[2], memory[2], effort, effort_nm)
        )
    if strategy == 2:
        off = position != position and velocity != velocity and effort != effort
        through = _follow(loops[0], memory[0], position, q_rad) + _follow(
            loops[1], memory[1], velocity, qd_rad_s
        )
        if effort == effort:
            through += effort
        return _clip(_follow(loops[2], memory[2], np.nan if off else through, effort_nm))
    off = position != position and effort != effort
    through = _follow(loops[0], memory[0], position, q_rad)
    if effort == effort:
        through += effort
    speed = _follow(loops[1], memory[1], velocity, qd_rad_s)
    return _clip(speed + _follow(loops[2], memory[2], np.nan if off else through, effort_nm))


@compiled
def _clip(pwm: float) -> float:
    if pwm < -1.0:
        return -1.0
    return 1.0 if pwm > 1.0 else pwm


@compiled
def _reset(memory: Floats) -> None:
    for k in range(MEMORY):
        memory[k] = 0.0


@compiled
def _follow(g: Any, memory: Floats, target: float, measured: float) -> float:
    if target != target:
        if memory[HAS_OUTPUT]:
            _reset(memory)
        return 0.0
    if target < g.min_target:
        target = g.min_target
    if target > g.max_target:
        target = g.max_target
    output: float
    if g.plain:
        output = g.kp * (target - measured) + g.feed_forward * target
    else:
        output = _every_term(g, memory, target, measured)
    if output < g.min_output:
        output = g.min_output
    if output > g.max_output:
        output = g.max_output
    if g.output_lowpass < 1.0 and memory[HAS_OUTPUT]:
        output = g.output_lowpass * output + (1.0 - g.output_lowpass) * memory[OUTPUT]
    memory[HAS_OUTPUT], memory[OUTPUT] = 1.0, output
    return output


@compiled
def _every_term(g: Any, memory: Floats, target: float, measured: float) -> float:
    if g.target_lowpass < 1.0 and memory[HAS_TARGET]:
        target = g.target_lowpass * target + (1.0 - g.target_lowpass) * memory[TARGET]
    memory[HAS_TARGET], memory[TARGET] = 1.0, target
    error = target - measured
    if -g.dead_zone < error < g.dead_zone:
        error = 0.0
    output: float = g.kp * error + g.feed_forward * target
    if g.ki != 0.0:
        limit = g.i_clamp
        integral = memory[INTEGRAL] + g.ki * error * g.dt_s
        if -limit > integral:
            integral = -limit
        if limit < integral:
            integral = limit
        memory[INTEGRAL] = integral
        output += integral
    if g.kd != 0.0:
        change = 0.0
        if memory[HAS_LAST]:
            change = error - memory[LAST_ERROR] if g.d_on_error else memory[LAST_MEASURED] - measured
            change = change / g.dt_s
        memory[HAS_LAST], memory[LAST_ERROR], memory[LAST_MEASURED] = 1.0, error, measured
        output += g.kd * change
    if g.punch != 0.0 and error != 0.0:
        output += g.punch if error > 0.0 else -g.punch
    return output


@compiled
def _limit(own: Any, pwm: float, integers: Integers, reading: Floats) -> float:
    integers[LIMIT] = LIMIT_NONE
    if pwm != pwm:
        return 0.0
    position = reading[Q]
    if (own.high == STOP and position > own.high_rad and pwm > 0.0) or (
        own.low == STOP and position < own.low_rad and pwm < 0.0
    ):
        integers[LIMIT] = LIMIT_POSITION
        return 0.0
    pwm = _within_speed(own, pwm, integers, reading)
    pwm = _within_push(own, pwm, integers, reading)
    room_c = own.ceiling_c - reading[WINDING]
    ceiling = 1.0 - 1.0 / room_c if room_c > 1.0 else 0.0
    voltage_v = reading[VOLTAGE] if reading[VOLTAGE] > 0.0 else 0.0
    max_pwm: float = min(ceiling * voltage_v / NOMINAL_VOLTAGE_V, 1.0)
    if -max_pwm <= pwm <= max_pwm:
        return pwm
    integers[LIMIT] |= LIMIT_TEMPERATURE if ceiling != 0.0 else LIMIT_OVER_TEMPERATURE
    return max_pwm if pwm > 0.0 else -max_pwm


@compiled
def _distances(own: Any, reading: Floats) -> tuple[float, float, float]:
    output = reading[Q]
    motor = output - reading[DEFLECTION]
    low = (output if output < motor else motor) - own.low_rad
    high = own.high_rad - (output if output > motor else motor)
    return reading[MOTOR_RATE] / own.gear_ratio, low, high


@compiled
def _has_arrived(own: Any, reading: Floats) -> bool:
    _, low, high = _distances(own, reading)
    if own.high == OFF and high <= 2.0 * own.margin_rad:
        return True
    return bool(own.low == OFF and low <= 2.0 * own.margin_rad)


@compiled
def _within_speed(own: Any, pwm: float, integers: Integers, reading: Floats) -> float:
    speed, low, high = _distances(own, reading)
    load = own.load_pwm * reading[TAU]
    fastest, slowest = own.max_rad_s, own.min_rad_s
    if own.high >= OFF:
        fastest = _allowed(own, high - own.margin_rad, fastest)
    if own.low >= OFF:
        slowest = -_allowed(own, low - own.margin_rad, -slowest)
    held = 0.0 if own.high == SPRING and high < 0.0 else load
    most = own.emf_pwm * fastest + own.stiff_pwm * (fastest - speed) + held
    if pwm > most:
        integers[LIMIT] = LIMIT_VELOCITY if fastest == own.max_rad_s else LIMIT_POSITION
        pwm = most
    held = 0.0 if own.low == SPRING and low < 0.0 else load
    least = own.emf_pwm * slowest + own.stiff_pwm * (slowest - speed) + held
    if pwm < least:
        integers[LIMIT] = LIMIT_VELOCITY if slowest == own.min_rad_s else LIMIT_POSITION
        pwm = least
    return pwm


@compiled
def _allowed(own: Any, distance: float, most: float) -> float:
    knee = own.braking_rad_s2 / (APPROACH_PER_S * APPROACH_PER_S)
    if distance < knee:
        speed = APPROACH_PER_S * distance
        if speed < -RETURN_RAD_S:
            speed = -RETURN_RAD_S
    else:
        speed = math.sqrt(2.0 * own.braking_rad_s2 * (distance - 0.5 * knee))
    return speed if speed < most else most


@compiled
def _within_push(own: Any, pwm: float, integers: Integers, reading: Floats) -> float:
    emf = own.emf_pwm * (reading[MOTOR_RATE] / own.gear_ratio)
    effort = reading[TAU]
    most, least = emf + own.max_push, emf + own.min_push
    if effort > own.max_nm:
        most = own.load_pwm * (own.max_nm - RELEASE * (effort - own.max_nm))
    if effort < own.min_nm:
        least = own.load_pwm * (own.min_nm - RELEASE * (effort - own.min_nm))
    most = most if most > 0.0 else 0.0
    least = least if least < 0.0 else 0.0
    if pwm > most:
        integers[LIMIT] |= LIMIT_EFFORT
        return most
    if pwm < least:
        integers[LIMIT] |= LIMIT_EFFORT
        return least
    return pwm


@compiled
def _row_due(own: Any, now_ns: int, imu_ns: int, integers: Integers) -> bool:
    new_imu = imu_ns != integers[LAST_IMU_NS]
    integers[LAST_IMU_NS] = imu_ns
    due_ns = integers[ROW_DUE_NS]
    if now_ns < due_ns - own.half_tick_ns:
        return False
    if own.waits_for_imu and not new_imu and now_ns < due_ns + own.imu_period_ns:
        return False
    begin_ns = now_ns if own.waits_for_imu and new_imu else max(due_ns, now_ns - own.half_tick_ns)
    integers[ROW_DUE_NS] = begin_ns + own.row_period_ns
    return True


@compiled
def _fill(row: Any, own: Any, times: Integers, reading: Floats, targets: Floats) -> None:
    voltage = reading[VOLTAGE]
    duty = targets[PWM] * NOMINAL_VOLTAGE_V / voltage if voltage != 0.0 else 0.0
    if duty < -1.0:
        duty = -1.0
    if duty > 1.0:
        duty = 1.0
    row.t_ns, row.imu_t_ns, row.motion_id, row.state = times[T_NS], times[IMU_NS], own.motion_id, own.state
    row.position_rad, row.velocity_rad_s, row.effort_nm = reading[Q], reading[QD], reading[TAU]
    row.position_command_rad, row.velocity_command_rad_s = targets[POSITION], targets[VELOCITY]
    row.effort_command_nm, row.pwm = targets[EFFORT], duty
    row.deflection_rad, row.motor_velocity_rad_s = reading[DEFLECTION], reading[MOTOR_RATE]
    row.motor_current_a, row.winding_temperature_c = reading[CURRENT], reading[WINDING]
    row.voltage_v = voltage
    row.gyro_x, row.gyro_y, row.gyro_z = reading[GYRO], reading[GYRO + 1], reading[GYRO + 2]
    row.accel_x, row.accel_y, row.accel_z = reading[ACCEL], reading[ACCEL + 1], reading[ACCEL + 2]

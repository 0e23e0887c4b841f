"""Readings of encoder, speed estimates and torque sensor, from a joint's true motion.

Encoder: whole counts. Velocity: the module's own estimate, a first-order low-pass of the encoder readings'
differences over the nominal tick, so that counts and sampling jitter show in it; the real X5-1's lags its
encoder by 1.3 to 1.7 ms. The deflection's velocity is as late and, an assumption, without noise. The motor's
speed comes from its commutation and is smoothed far more: in the same log it lags by 11 ms. The module's
control does not use it: the recorded PWM shows a velocity loop on velocity less deflection velocity, which is
the motor's speed too (`tests/module_agent/control/test_pid.py`).

Torque: the sensor reads the deflection and multiplies it by a constant stiffness, but part of the torque that
rubber transmits is inner friction, which does not show in the deflection. That part is a Dahl element driven
by the torque,

    dF/dT = (F_c / T_c) (1 - sign(dT) F / F_c),     reading = T - F,

with T the torque that the spring transmits to the body, F_c half the loop's width and T_c the torque over
which a reversal is rounded. The law is rate-independent and is integrated exactly for any monotone change.
Around a closed cycle the loop's area over the stiffness, the integral of F dT / k, is never negative: the
reading lags behind the torque, as if energy had been lost. (P. Dahl, A solid friction model, 1968.)
"""

from collections.abc import Sequence
from math import exp, pi
from typing import NamedTuple

import numpy as np

from module_agent.model.catalogue import ModuleType
from module_agent.model.compiled import compiled
from sim.geometry.pose import Array
from sim.imperfections.module_errors import SensorErrors
from sim.imperfections.noise_profile import NoiseProfile
from sim.imperfections.random_streams import Draws, StandardNormals

# The share of the largest effort over which the torque's hysteresis is rounded (an assumption). With loops of
# up to this width the reading still grows with the torque.
HYSTERESIS_ROUNDING = 0.05
# Columns of `JointArrays.fixed` that change as a module ages.
EFFORT_SCALE, EFFORT_OFFSET, HALF_LOOP = 1, 2, 4

# Tick, encoder step, shares of the low-passes of velocity and motor speed, velocity's white noise, jitter.
_Settings = tuple[float, float, float, float, float, float]


class JointArrays(NamedTuple):
    """What the kernel knows of the joint sensors of n modules.

    fixed (n, 7): stiffness, effort scale and offset, white noise of the effort, half the loop's width and its
    rounding, gear ratio. memory (n, 6): encoder reading, velocity, motor speed, torque, inner friction,
    deflection velocity; NaN before the first reading.
    """

    settings: _Settings
    fixed: Array
    noise: Draws
    jitter: Draws
    memory: Array


class JointSensors:
    """The encoders, speed estimates and torque sensors of n modules; `read_joints` reads them every tick."""

    def __init__(
        self,
        seed: int,
        serials: Sequence[str],
        types: Sequence[ModuleType],
        profile: NoiseProfile,
        errors: SensorErrors,
        tick_s: float,
    ):
        effort = np.array([t.max_effort_nm for t in types])
        fixed = np.column_stack(
            (
                [t.spring_nm_rad for t in types],
                1.0 + errors.effort_scale,
                errors.effort_offset_nm,
                profile.effort_white_fraction * effort,
                profile.effort_hysteresis_fraction / 2.0 * effort,
                HYSTERESIS_ROUNDING * effort,
                [t.gear_ratio for t in types],
            )
        )
        settings: _Settings = (
            tick_s,
            profile.position_step_rad,
            _share(profile.velocity_bandwidth_hz, tick_s),
            _share(profile.motor_velocity_bandwidth_hz, tick_s),
            profile.velocity_white_rad_s,
            profile.sampling_jitter_s,
        )
        self.streams = (
            StandardNormals(seed, serials, "joint", 2),
            StandardNormals(seed, serials, "joint jitter", 1),
        )
        noise, jitter = (stream.draws for stream in self.streams)
        self.arrays = JointArrays(settings, fixed, noise, jitter, np.full((len(types), 6), np.nan))


def _share(bandwidth_hz: float, tick_s: float) -> float:
    """Return the share of a step that a first-order low-pass follows within one tick; 1 without one."""
    return 1.0 - exp(-2.0 * pi * bandwidth_hz * tick_s) if bandwidth_hz else 1.0


@compiled
def _dahl(friction_nm: float, change_nm: float, limit_nm: float, rounding_nm: float) -> float:
    """Return a Dahl element's force after a monotone change of its drive, in closed form."""
    if change_nm == 0.0 or limit_nm == 0.0:
        return friction_nm
    end = limit_nm if change_nm > 0.0 else -limit_nm
    return end + (friction_nm - end) * exp(-abs(change_nm) / rounding_nm)


@compiled
def _settle(own: JointArrays, q: Array, qd: Array, motor: Array, elastic: Array) -> None:
    """Fill in the memory of a steady state of this speed and torque."""
    tick_s, step, memory = own.settings[0], own.settings[1], own.memory
    for i in range(len(q)):
        before = q[i] - qd[i] * tick_s
        memory[i, 0] = np.rint(before / step) * step if step > 0.0 else before
        memory[i, 1], memory[i, 2], memory[i, 3] = qd[i], motor[i], elastic[i]
        memory[i, 4], memory[i, 5] = 0.0, qd[i] - motor[i]


@compiled
def read_joints(own: JointArrays, q: Array, qd: Array, motor: Array, elastic: Array, readings: Array) -> None:
    """Write position, velocity, effort, deflection, motor and deflection velocity into samples (n, 17).

    Arguments are (n,) and true, the motors' speeds seen at the output, elastic the springs' torques on the
    outputs [Nm].
    """
    tick_s, step, velocity_share, motor_share, velocity_white, jitter_s = own.settings
    fixed, memory, noise, jitter = own.fixed, own.memory, own.noise.block, own.jitter.block
    at, jitter_at = own.noise.next[0], own.jitter.next[0]
    own.noise.next[0], own.jitter.next[0] = at + 1, jitter_at + 1
    if memory[0, 0] != memory[0, 0]:
        _settle(own, q, qd, motor, elastic)
    for i in range(len(q)):
        off_s = jitter_s * jitter[jitter_at, i, 0]
        angle = q[i] + qd[i] * off_s
        if step > 0.0:
            angle = np.rint(angle / step) * step
        if velocity_share < 1.0:
            memory[i, 1] += velocity_share * ((angle - memory[i, 0]) / tick_s - memory[i, 1])
            velocity = memory[i, 1]
        else:
            velocity = qd[i] + (qd[i] - memory[i, 1]) * (off_s / tick_s)
            memory[i, 1] = qd[i]
        memory[i, 0] = angle
        if motor_share < 1.0:
            memory[i, 2] += motor_share * (motor[i] - memory[i, 2])
        else:
            memory[i, 2] = motor[i]
        change = elastic[i] - memory[i, 3]
        memory[i, 3] = elastic[i]
        memory[i, 4] = _dahl(memory[i, 4], change, fixed[i, 4], fixed[i, 5])
        torque = elastic[i] + change * (off_s / tick_s) - memory[i, 4]
        effort = fixed[i, 1] * torque + fixed[i, 2] + fixed[i, 3] * noise[at, i, 1]
        readings[i, 2], readings[i, 3] = angle, velocity + velocity_white * noise[at, i, 0]
        readings[i, 4], readings[i, 5] = effort, effort / -fixed[i, 0]
        readings[i, 6] = memory[i, 2] * fixed[i, 6]
        memory[i, 5] += velocity_share * (qd[i] - motor[i] - memory[i, 5])
        readings[i, 16] = memory[i, 5]

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

import numpy as np

from module_agent.model.catalogue import ModuleType
from module_agent.model.compiled import compiled
from sim.geometry.pose import Array
from sim.imperfections.module_errors import SensorErrors
from sim.imperfections.noise_profile import NoiseProfile
from sim.imperfections.random_streams import StandardNormals

# The share of the largest effort over which the torque's hysteresis is rounded (an assumption). With loops of
# up to this width the reading still grows with the torque.
HYSTERESIS_ROUNDING = 0.05

# Tick, encoder step, shares of the low-passes of velocity and motor speed, velocity's white noise, jitter.
_Settings = tuple[float, float, float, float, float, float]


class JointSensors:
    """The encoders, speed estimates and torque sensors of n modules; to be read every tick."""

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
        # Per module: stiffness, effort scale and offset, white noise of the effort, half the loop's width and
        # its rounding.
        self._fixed = np.column_stack(
            (
                [t.spring_nm_rad for t in types],
                1.0 + errors.effort_scale,
                errors.effort_offset_nm,
                profile.effort_white_fraction * effort,
                profile.effort_hysteresis_fraction / 2.0 * effort,
                HYSTERESIS_ROUNDING * effort,
            )
        )
        self._settings: _Settings = (
            tick_s,
            profile.position_step_rad,
            _share(profile.velocity_bandwidth_hz, tick_s),
            _share(profile.motor_velocity_bandwidth_hz, tick_s),
            profile.velocity_white_rad_s,
            profile.sampling_jitter_s,
        )
        self._noise = StandardNormals(seed, serials, "joint", 2)
        self._jitter = StandardNormals(seed, serials, "joint jitter", 1)
        # Columns: encoder reading, velocity, motor speed, torque, inner friction, deflection velocity.
        self._memory = np.zeros((0, 6))

    def read(self, q_rad: Array, qd_rad_s: Array, motor_rad_s: Array, elastic_nm: Array) -> Array:
        """Return a reading (n, 6): position, velocity, effort, deflection, motor speed, deflection velocity.

        The motor's speed is seen at the output. All arguments are (n,) and true; elastic_nm is the springs'
        torque on the outputs.
        """
        if not len(self._memory):
            # The steady state of this speed and torque.
            tick_s, step = self._settings[:2]
            before = q_rad - qd_rad_s * tick_s
            counted = np.rint(before / step) * step if step else before
            still = np.zeros_like(q_rad)
            self._memory = np.column_stack(
                (counted, qd_rad_s, motor_rad_s, elastic_nm, still, qd_rad_s - motor_rad_s)
            )
        return _read(
            self._settings,
            self._fixed,
            self._noise.draw(),
            self._jitter.draw(),
            q_rad,
            qd_rad_s,
            motor_rad_s,
            elastic_nm,
            self._memory,
        )


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
def _read(
    settings: _Settings,
    fixed: Array,
    noise: Array,
    jitter: Array,
    q: Array,
    qd: Array,
    motor: Array,
    elastic: Array,
    memory: Array,
) -> Array:
    """Return `JointSensors.read`; noise and jitter are in standard deviations, `memory` is carried on."""
    tick_s, step, velocity_share, motor_share, velocity_white, jitter_s = settings
    values = np.empty((q.shape[0], 6))
    for i in range(q.shape[0]):
        off_s = jitter_s * jitter[i, 0]
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
        effort = fixed[i, 1] * torque + fixed[i, 2] + fixed[i, 3] * noise[i, 1]
        values[i, 0], values[i, 1] = angle, velocity + velocity_white * noise[i, 0]
        values[i, 2], values[i, 3], values[i, 4] = effort, effort / -fixed[i, 0], memory[i, 2]
        memory[i, 5] += velocity_share * (qd[i] - motor[i] - memory[i, 5])
        values[i, 5] = memory[i, 5]
    return values

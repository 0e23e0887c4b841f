"""The output stage of a module: nothing drives the motor but through `MotorGuard.limit`.

Without a configuration it keeps the duty below the winding's ceiling, the motor below the speed and the
spring below the torque of its type, and never drives out of the type's range. A configuration
(`control.safety`) narrows these bounds, which no gains and no set-point go around, and adds others. Seen at
the output, with the motor's speed w and the torque tau read from the spring, the upper ones are

    position, speed   E w1 + S (w1 - w) + L tau     w1: the highest speed at this distance from the limit
    torque, current   E w + R i                     i: the highest current, L times the torque
    winding           the ceiling 1 - 1 / (T1 + 1 - T)

and lower ones likewise. E is the back-EMF and R the resistance as PWM at 48 V; L tau is what holds the load,
S the stiffness of the bound. Near a limit w1 is proportional to the distance d; farther away the motor stops
within it under the deceleration a: w1^2 = 2 a (d - d0 / 2), with d0 where both have the same slope. d is that
of output or motor, whichever is nearer, less a margin: a motor that has arrived must not wait for its load to
follow on the spring.
"""

import math
from typing import NamedTuple

from module_agent.control.controller import NOMINAL_VOLTAGE_V
from module_agent.control.safety import UNCONFIGURED, LimitAction, Safety
from module_agent.hardware.hardware import LimitState, SensorSample
from module_agent.model.catalogue import ModuleType
from module_agent.wire.messages import Limits

DAMPING_LIMIT_PWM = 0.25
# What a side of the range does: nothing; PWM of zero outward, which is the type's own; and those configured.
FREE, STOP, OFF, HOLD, SPRING = range(5)
_ACTIONS: dict[LimitAction, int] = {"disabled": FREE, "motor_off": OFF, "hold": HOLD, "spring": SPRING}
# Speed per distance next to a limit [1/s]: slower than the spring of any type with its load would ring.
APPROACH_PER_S = 5.0
# The motor aims at this distance before a limit [rad]: what friction and the spring of a loaded joint leave.
# Where it is to be off at the limit, it is off from twice that.
MARGIN_RAD = 0.02
# The stiffness of the bounds over the back-EMF's own.
STIFFNESS = 3.0
# The highest speed of a motor over that of its type. The loops clamp their targets at 1.025 times that speed,
# and overshoot: a healthy joint does not meet this bound.
OVERSPEED = 1.1
# The highest torque of the spring over that of its type, to which the loops clamp their targets: what healthy
# joints overshoot by, and the error of a torque sensor as delivered.
OVERLOAD = 1.2
# How fast a joint that is outside of its range is led back [rad/s].
RETURN_RAD_S = 0.1
# By how much the push is lowered for every Nm over a torque limit [Nm].
RELEASE = 4.0


class Bounds(NamedTuple):
    """What bounds one module's PWM; infinite where nothing does.

    low, high: action and position of both ends. max_motor_rad_s: the speed at which the motor is unloaded.
    """

    low: int
    high: int
    low_rad: float
    high_rad: float
    margin_rad: float
    max_motor_rad_s: float
    ceiling_c: float
    min_rad_s: float
    max_rad_s: float
    min_nm: float
    max_nm: float
    min_push: float
    max_push: float
    braking_rad_s2: float
    gear_ratio: float
    emf_pwm: float
    stiff_pwm: float
    load_pwm: float


def bounds_of(kind: ModuleType, limits: Limits, safety: Safety) -> Bounds:
    """Return the bounds of a type with its own `limits` under a configuration.

    Raises:
        UsageError: no position is within both ranges.
    """
    motor = kind.motor
    tight = safety.tightened(limits)
    low, high = tight.min_position_rad, tight.max_position_rad
    chosen = zip(safety.range_rad, safety.at_limit, strict=True)
    actions = [
        FREE if end is None else _ACTIONS[action] if math.isfinite(asked) else STOP
        for end, (asked, action) in zip((low, high), chosen, strict=True)
    ]
    ohm_pwm = motor.resistance_ohm / NOMINAL_VOLTAGE_V
    load_pwm = ohm_pwm / (motor.torque_constant_nm_a * kind.gear_ratio)
    emf_pwm = kind.gear_ratio * motor.back_emf_v_s_rad / NOMINAL_VOLTAGE_V
    current = safety.current_a * ohm_pwm
    low_rad, high_rad = -math.inf if low is None else low, math.inf if high is None else high
    return Bounds(
        low=actions[0],
        high=actions[1],
        low_rad=low_rad,
        high_rad=high_rad,
        margin_rad=min(MARGIN_RAD, 0.125 * (high_rad - low_rad)),
        max_motor_rad_s=kind.gear_ratio * kind.max_speed_rad_s,
        ceiling_c=safety.winding_c + 1.0,
        min_rad_s=max(safety.velocity_rad_s[0], -OVERSPEED * kind.max_speed_rad_s),
        max_rad_s=min(safety.velocity_rad_s[1], OVERSPEED * kind.max_speed_rad_s),
        min_nm=max(safety.effort_nm[0], -OVERLOAD * kind.max_effort_nm),
        max_nm=min(safety.effort_nm[1], OVERLOAD * kind.max_effort_nm),
        min_push=max(safety.effort_nm[0] * load_pwm, -current),
        max_push=min(safety.effort_nm[1] * load_pwm, current),
        braking_rad_s2=safety.braking_rad_s2,
        gear_ratio=kind.gear_ratio,
        emf_pwm=emf_pwm,
        stiff_pwm=STIFFNESS * emf_pwm,
        load_pwm=load_pwm,
    )


class MotorGuard:
    """Bounds on one module's PWM (at 48 V), and the PWM that brakes.

    `state` is what bounded the last PWM; `fault` why the motor is off, "" while it is not.
    """

    def __init__(self, kind: ModuleType, limits: Limits, safety: Safety = UNCONFIGURED):
        self.bounds = bounds_of(kind, limits, safety)
        self.state = LimitState.NONE
        self.fault = ""

    def watch(self, sample: SensorSample) -> None:
        """Look whether a joint has arrived at a limit at which its motor is off."""
        own = self.bounds
        self.fault = ""
        if OFF not in (own.low, own.high):
            return
        _, low, high = self._distances(sample)
        reached = "position {:.3f} rad: motor off at the limit {:g} rad"
        if own.high == OFF and high <= 2.0 * own.margin_rad:
            self.fault = reached.format(sample.position_rad, own.high_rad)
        if own.low == OFF and low <= 2.0 * own.margin_rad:
            self.fault = reached.format(sample.position_rad, own.low_rad)

    def limit(self, pwm: float, sample: SensorSample) -> float:
        """Return the PWM within all bounds; the highest current and the ceiling come last."""
        self.state = LimitState.NONE
        own = self.bounds
        if pwm != pwm:
            # No law makes a NaN of finite numbers; if one did, it would be no command to a motor.
            return 0.0
        if self.fault:
            self.state = LimitState.POSITION
            return 0.0
        position = sample.position_rad
        if (own.high == STOP and position > own.high_rad and pwm > 0.0) or (
            own.low == STOP and position < own.low_rad and pwm < 0.0
        ):
            self.state = LimitState.POSITION
            return 0.0
        pwm = self._within_speed(pwm, sample)
        pwm = self._within_push(pwm, sample)
        room_c = own.ceiling_c - sample.winding_temperature_c
        ceiling = 1.0 - 1.0 / room_c if room_c > 1.0 else 0.0
        # A voltage below zero is no supply to drive with.
        voltage_v = sample.voltage_v if sample.voltage_v > 0.0 else 0.0
        # Above the nominal voltage, too, a command is at most one.
        max_pwm = min(ceiling * voltage_v / NOMINAL_VOLTAGE_V, 1.0)
        if -max_pwm <= pwm <= max_pwm:
            return pwm
        self.state |= LimitState.TEMPERATURE if ceiling else LimitState.OVER_TEMPERATURE
        return max_pwm if pwm > 0.0 else -max_pwm

    def damping(self, sample: SensorSample) -> float:
        """Return the PWM that brakes.

        It follows the motor's speed and not the output's, which is behind a spring: feeding that back drives
        an oscillation (25 Hz and 2.6 rad/s on an X5-9 with an arm of 0.5 kg).
        """
        most = -sample.motor_velocity_rad_s / self.bounds.max_motor_rad_s
        pwm = self.limit(min(max(most, -DAMPING_LIMIT_PWM), DAMPING_LIMIT_PWM), sample)
        # Before a limit it brakes harder; beyond one it does not drive back: it only ever opposes the motion.
        if most < 0.0:
            return most if pwm < most else 0.0 if pwm > 0.0 else pwm
        return most if pwm > most else 0.0 if pwm < 0.0 else pwm

    def _distances(self, sample: SensorSample) -> tuple[float, float, float]:
        """Return the motor's speed at the output, and the distances to the lower and the upper limit."""
        own = self.bounds
        output = sample.position_rad
        motor = output - sample.deflection_rad
        low = (output if output < motor else motor) - own.low_rad
        high = own.high_rad - (output if output > motor else motor)
        return sample.motor_velocity_rad_s / own.gear_ratio, low, high

    def _within_speed(self, pwm: float, sample: SensorSample) -> float:
        own = self.bounds
        speed, low, high = self._distances(sample)
        load = own.load_pwm * sample.effort_nm
        fastest, slowest = own.max_rad_s, own.min_rad_s
        if own.high >= OFF:
            fastest = _allowed(own, high - own.margin_rad, fastest)
        if own.low >= OFF:
            slowest = -_allowed(own, low - own.margin_rad, -slowest)
        held = 0.0 if own.high == SPRING and high < 0.0 else load
        most = own.emf_pwm * fastest + own.stiff_pwm * (fastest - speed) + held
        if pwm > most:
            self.state = LimitState.VELOCITY if fastest == own.max_rad_s else LimitState.POSITION
            pwm = most
        held = 0.0 if own.low == SPRING and low < 0.0 else load
        least = own.emf_pwm * slowest + own.stiff_pwm * (slowest - speed) + held
        if pwm < least:
            self.state = LimitState.VELOCITY if slowest == own.min_rad_s else LimitState.POSITION
            pwm = least
        return pwm

    def _within_push(self, pwm: float, sample: SensorSample) -> float:
        """Return the PWM with no more than the highest torque and current; 0 is always possible."""
        own = self.bounds
        emf = own.emf_pwm * (sample.motor_velocity_rad_s / own.gear_ratio)
        effort = sample.effort_nm
        most, least = emf + own.max_push, emf + own.min_push
        if effort > own.max_nm:
            most = own.load_pwm * (own.max_nm - RELEASE * (effort - own.max_nm))
        if effort < own.min_nm:
            least = own.load_pwm * (own.min_nm - RELEASE * (effort - own.min_nm))
        most = most if most > 0.0 else 0.0
        least = least if least < 0.0 else 0.0
        if pwm > most:
            self.state |= LimitState.EFFORT
            return most
        if pwm < least:
            self.state |= LimitState.EFFORT
            return least
        return pwm


def _allowed(own: Bounds, distance: float, most: float) -> float:
    """Return the highest speed towards a limit at a distance from it, at most `most`."""
    knee = own.braking_rad_s2 / (APPROACH_PER_S * APPROACH_PER_S)
    if distance < knee:
        speed = max(APPROACH_PER_S * distance, -RETURN_RAD_S)
    else:
        speed = math.sqrt(2.0 * own.braking_rad_s2 * (distance - 0.5 * knee))
    return min(speed, most)

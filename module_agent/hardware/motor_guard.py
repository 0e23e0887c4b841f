"""The output stage of a module: limits of temperature and position, and the brake."""

import math

from module_agent.control.controller import NOMINAL_VOLTAGE_V
from module_agent.hardware.hardware import LimitState, SensorSample
from module_agent.model.catalogue import ModuleType
from module_agent.wire.messages import Limits

# The manufacturer's PWM ceiling is 1 - 1/(155 - T), which has fallen to zero at 154 C.
CEILING_LIMIT_C = 155.0
DAMPING_LIMIT_PWM = 0.25


class MotorGuard:
    """Bounds on one module's PWM (at 48 V), and the PWM that brakes; `state` is what bounded the last PWM."""

    def __init__(self, kind: ModuleType, limits: Limits):
        self._low_rad = limits.min_position_rad
        self._high_rad = limits.max_position_rad
        self._max_motor_rad_s = kind.gear_ratio * kind.max_speed_rad_s
        self.state = LimitState.NONE

    @property
    def bounds(self) -> tuple[float, float, float]:
        """The lowest and highest position, infinite without, and the speed at which the motor is unloaded."""
        low = -math.inf if self._low_rad is None else self._low_rad
        high = math.inf if self._high_rad is None else self._high_rad
        return low, high, self._max_motor_rad_s

    def limit(self, pwm: float, sample: SensorSample) -> float:
        """Keep the duty below the winding's ceiling 1 - 1/(155 - T), and never drive out of the range."""
        self.state = LimitState.NONE
        low, high, position = self._low_rad, self._high_rad, sample.position_rad
        if (high is not None and position > high and pwm > 0.0) or (
            low is not None and position < low and pwm < 0.0
        ):
            self.state = LimitState.POSITION
            return 0.0
        room_c = CEILING_LIMIT_C - sample.winding_temperature_c
        ceiling = 1.0 - 1.0 / room_c if room_c > 1.0 else 0.0
        max_pwm = ceiling * sample.voltage_v / NOMINAL_VOLTAGE_V
        if -max_pwm <= pwm <= max_pwm:
            return pwm
        if pwm != pwm:
            # No law makes a NaN of finite numbers; if one did, it would be no command to a motor.
            return 0.0
        self.state = LimitState.TEMPERATURE if ceiling else LimitState.OVER_TEMPERATURE
        return max_pwm if pwm > 0.0 else -max_pwm

    def damping(self, sample: SensorSample) -> float:
        """Return the PWM that brakes.

        It follows the motor's speed and not the output's, which is behind a spring: feeding that back drives
        an oscillation (25 Hz and 2.6 rad/s on an X5-9 with an arm of 0.5 kg).
        """
        pwm = -sample.motor_velocity_rad_s / self._max_motor_rad_s
        return self.limit(min(max(pwm, -DAMPING_LIMIT_PWM), DAMPING_LIMIT_PWM), sample)

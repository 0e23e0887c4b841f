"""What a motor is kept from, whatever commands it: heat, the ends of its range, and its own momentum."""

from module_agent.control.controller import NOMINAL_VOLTAGE_V
from module_agent.firmware.config import FirmwareConfig
from module_agent.hardware.hardware import SensorSample

# Above this the manufacturer's PWM ceiling 1 - 1/(155 - T) has fallen to zero.
WINDING_LIMIT_C = 154.0
WINDING_REARM_C = 140.0
DAMPING_LIMIT_PWM = 0.25


class MotorGuard:
    """The output stage of one module: bounds on the PWM (at 48 V), and the PWM that brakes."""

    def __init__(self, config: FirmwareConfig):
        self._low_rad = config.limits.min_position_rad
        self._high_rad = config.limits.max_position_rad
        self._top_motor_rad_s = config.kind.gear_ratio * config.kind.max_speed_rad_s

    def limit(self, pwm: float, sample: SensorSample) -> float:
        """Keep the duty below the winding's ceiling 1 - 1/(155 - T), and never drive out of the range."""
        low, high, position = self._low_rad, self._high_rad, sample.position_rad
        if high is not None and position > high and pwm > 0.0:
            return 0.0
        if low is not None and position < low and pwm < 0.0:
            return 0.0
        room_c = 155.0 - sample.winding_temperature_c
        ceiling = 1.0 - 1.0 / room_c if room_c > 1.0 else 0.0
        most = ceiling * sample.voltage_v / NOMINAL_VOLTAGE_V
        if pwm > most:
            return most
        return -most if pwm < -most else pwm

    def damping(self, sample: SensorSample) -> float:
        """Return the PWM that brakes.

        By the motor's speed and not the output's, which follows through a spring: fed back, that is driven
        into an oscillation (25 Hz and 2.6 rad/s on an X5-9 with an arm of 0.5 kg).
        """
        pwm = -sample.motor_velocity_rad_s / self._top_motor_rad_s
        return self.limit(min(max(pwm, -DAMPING_LIMIT_PWM), DAMPING_LIMIT_PWM), sample)

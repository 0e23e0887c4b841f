"""The contract between the firmware and whatever turns the motor and reads the sensors.

One `Hardware` serves one agent process, which may host several modules. The physics bus client and the
in-process world of the simulator implement it; a driver for real modules will.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol


class SensorSample(NamedTuple):
    """One tick of one module, in the module's own clock and frames.

    The accelerometer reads specific force (+g on the axis that points up at rest). Gyro and accelerometer
    are in the IMU frame. Effort is the torque that the output exerts on what it is mounted to, read from
    the spring. Position, velocity and effort are those of the output relative to the housing about the
    module's +z.
    """

    t_ns: int
    imu_t_ns: int
    position_rad: float
    velocity_rad_s: float
    effort_nm: float
    deflection_rad: float
    motor_velocity_rad_s: float
    motor_current_a: float
    winding_temperature_c: float
    voltage_v: float
    gyro_x_rad_s: float
    gyro_y_rad_s: float
    gyro_z_rad_s: float
    accel_x_m_s2: float
    accel_y_m_s2: float
    accel_z_m_s2: float


class HardwareModule(NamedTuple):
    """What the hardware says of one module before its first tick. Periods in the module's own clock."""

    serial: str
    module_type: str
    tick_ns: int
    imu_period_ns: int


class HardwareLost(ConnectionError):
    """The hardware is gone (closed bus, dead world); the agent must end its processes cleanly."""


class Hardware(Protocol):
    """The wires inside the modules of one agent process."""

    @property
    def modules(self) -> Sequence[HardwareModule]:
        """The modules served, in the order of `exchange`."""
        ...

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        """Hand over one PWM per module, wait for the next tick, return one sample per module.

        A PWM is in [-1, 1] and normalised to 48 V, as the gains are: the motor sees the duty
        `clip(pwm * 48 / voltage_v, -1, 1)` of the bus voltage.

        Raises:
            HardwareLost: no further tick will come.
        """
        ...

    def close(self) -> None:
        """Let go of the hardware; its motors then get zero PWM. May be called twice."""
        ...

"""The contract between the firmware and the modules whose motors it commands and whose sensors it reads.

The firmware hands over targets (`Command`), and the module closes its loops inside: real modules behind an
Ethernet port, simulated ones in `loop_inside`. In the firmware is what depends on the lease, on the freshness
of commands and on motions; in the module are loops and gains, limits of position and temperature, the brake,
and a watchdog that turns the motor off when no commands come.
"""

from collections.abc import Sequence
from enum import IntFlag
from typing import NamedTuple, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from module_agent.control.controller import Command
from module_agent.control.safety import UNCONFIGURED, Safety
from module_agent.model.errors import LostError
from module_agent.wire.messages import GainSet, Limits


class SensorSample(NamedTuple):
    """The sensor readings of one tick of one module, in the module's own clock and frames.

    The accelerometer reads specific force (+g on the axis that points up at rest). Gyro and accelerometer are
    in the IMU frame. Position, velocity and effort are those of the output relative to the housing about the
    module's +z; effort is the torque that the output exerts on what it is mounted to, read from the spring.
    deflection_velocity_rad_s is the output's speed less the motor's seen at the output; only loops that are
    closed outside the module need it.
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
    deflection_velocity_rad_s: float = 0.0


class Readings(Sequence[SensorSample]):
    """The newest samples of n modules as one block of memory, which the next tick overwrites.

    floats and integers (n, 17) are the same memory in the order of `SensorSample`; times are in the first two
    columns of `integers`, all else in the others of `floats`. `block` is that memory as bytes. As a sequence
    it has the sample of each module, 136 bytes each. `memory` is that of these floats, if it exists already.
    """

    def __init__(self, modules: int, memory: NDArray[np.float64] | None = None):
        columns = len(SensorSample._fields)
        self.floats = np.zeros((modules, columns)) if memory is None else memory.reshape(modules, columns)
        self.integers = self.floats.view(np.int64)
        self.block = self.floats.data.cast("B")

    @classmethod
    def of(cls, samples: "Sequence[SensorSample]") -> "Readings":
        """Return readings that hold these samples."""
        readings = cls(len(samples))
        for index, sample in enumerate(samples):
            readings.integers[index, :2] = sample[:2]
            readings.floats[index, 2:] = sample[2:]
        return readings

    def __len__(self) -> int:
        return len(self.floats)

    @overload
    def __getitem__(self, index: int) -> SensorSample: ...

    @overload
    def __getitem__(self, index: slice) -> list[SensorSample]: ...

    def __getitem__(self, index: int | slice) -> SensorSample | list[SensorSample]:
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        # As SensorSample(...), at half the time.
        values = (*self.integers[index, :2].tolist(), *self.floats[index, 2:].tolist())
        return tuple.__new__(SensorSample, values)


class LimitState(IntFlag):
    """The limits that act on a module; no flag is set while it follows its commands as they are."""

    NONE = 0
    POSITION = 1
    VELOCITY = 2
    EFFORT = 4
    TEMPERATURE = 8  # the PWM is kept below the winding's ceiling
    OVER_TEMPERATURE = 16  # the output is off


class ModuleSample(NamedTuple):
    """One feedback of one module: its sensors, and what its drive does.

    pwm is the PWM in [-1, 1] at 48 V that was in force when the sensors were read, `limits` what acted on it.
    sequence counts the module's samples: a gap is a loss. m_stop: the emergency stop holds the motor off.
    fault says which sensor cannot be believed, "" for none; a value of `sensors` is then its last good one.
    """

    sensors: SensorSample
    pwm: float
    sequence: int
    limits: LimitState
    m_stop: bool
    fault: str = ""


class ModuleInformation(NamedTuple):
    """The description of one module; periods in its own clock, gains and limits as they are in force.

    serial is unique and never changes; its user gives it a name, and the same family to all of one robot.
    limits are those of the type, tightened by the configuration `safety`.
    """

    serial: str
    name: str
    family: str
    module_type: str
    gains: GainSet
    limits: Limits
    tick_ns: int
    imu_period_ns: int
    safety: Safety = UNCONFIGURED


class HardwareLost(LostError):
    """The hardware is gone (closed bus, dead world); the agent must end its processes cleanly."""


class Modules(Protocol):
    """The modules of one agent process. A tick is one `receive` and then one `send`.

    `LoopInside` implements it for simulated modules; `tests/module_agent/hardware` has what every
    implementation must fulfil. Each method below says what it means for a real HEBI module.
    """

    @property
    def information(self) -> Sequence[ModuleInformation]:
        """The modules, in the order in which all else counts them.

        HEBI: a lookup of the serials and `request_info`; the tick is the period of feedback that the driver
        has set, the clock `hardware_transmit_time`.
        """

    def receive(self) -> Sequence[ModuleSample]:
        """Wait for the next tick and return one sample per module.

        Modules that are sent no command between two of these go on under their last one for their lifetime.
        What a working module cannot read never comes out of here: see `sample_check`.

        HEBI: `get_next_feedback`. Specific force is what an accelerometer reads: the driver checks that
        `accel_includes_gravity` is set.

        Raises:
            HardwareLost: no further tick will come.
        """

    def send(self, commands: Sequence[Command]) -> Sequence[float]:
        """Hand over one command per module; return the PWM of each, as the module's feedback would show it.

        A target of NaN switches its loop off, three of them the motor; `Command.brake` damps it.

        HEBI: `send_command`, where a target is left out for NaN; nothing before a first target. No answer
        comes at once: the PWM is that of the last feedback.

        Raises:
            ValueError: not one command per module, or there was no sample yet.
        """

    def set_gains(self, index: int, gains: GainSet) -> None:
        """Replace the gains and the control strategy of a module; its loops forget their past.

        HEBI: a command with gains; they are not saved, so that a power cycle brings back the owner's. One
        that has not followed a target yet, or has switched its motor off by itself, gets them with its first
        target: given before, they would end the latch of its M-stop.
        """

    def set_lifetime(self, index: int, lifetime_ns: int) -> None:
        """Set how long a module follows a command when no other comes: then its motor is off.

        It guards against an agent that has died. Against a coordinator that has died the firmware has a
        lifetime of its own, with an expiry action.

        HEBI: `command_lifetime`. While a command lives the module refuses other senders.

        Raises:
            ValueError: a lifetime that is not positive.
        """

    def identify(self, index: int, on: bool) -> None:
        """Show on a module which one it is, or show it no longer. HEBI: the colour of its LED."""

    def close(self) -> None:
        """Release the modules; their motors then are off. May be called twice.

        HEBI: a last command without targets, if the module may follow one.
        """


class WiredModule(NamedTuple):
    """The description of one simulated module before its first tick. Periods in the module's own clock."""

    serial: str
    module_type: str
    tick_ns: int
    imu_period_ns: int


class Wires(Protocol):
    """The wires inside simulated modules: PWM to the motors, readings of the sensors.

    The client of the physics bus implements it, and the world of the simulator for its own process.
    """

    @property
    def modules(self) -> Sequence[WiredModule]:
        """The modules served, in the order of `exchange`."""

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        """Hand over one PWM per module, wait for the next tick, return one sample per module.

        They may be `Readings`, which the next call overwrites.

        A PWM is in [-1, 1] and normalised to 48 V, as the gains are: the motor sees the duty
        `clip(pwm * 48 / voltage_v, -1, 1)` of the bus voltage.

        Raises:
            HardwareLost: no further tick will come.
            ValueError: not one PWM per module.
        """

    def close(self) -> None:
        """Release the modules; their motors then get zero PWM. May be called twice."""

"""Simulated modules behind the contract of real ones: the loops that a real module closes inside.

Loops, gains, motor guard, brake and watchdog are here, as they depend on nothing but the module; `hardware`
says what is in the firmware instead.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from module_agent.control.controller import MOTOR_OFF, Command, Controller
from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.control.safety import UNCONFIGURED, Safety
from module_agent.hardware.bus_client import BusClient
from module_agent.hardware.hardware import (
    LimitState,
    ModuleInformation,
    ModuleSample,
    Readings,
    SensorSample,
    WiredModule,
    Wires,
)
from module_agent.hardware.motor_guard import Bounds, MotorGuard
from module_agent.hardware.sample_check import SampleCheck
from module_agent.model.catalogue import module_type
from module_agent.wire.messages import GainSet

DEFAULT_LIFETIME_NS = 250_000_000
DEFAULT_STRATEGY = 3
FAMILY = "simulated"


class DriveState(NamedTuple):
    """What a quiet tick needs of a drive; `clean` is whether its last sample was good."""

    controller: Controller
    clean: bool
    running: bool
    limit: int
    pwm: float
    bounds: Bounds


class _Drive:
    """Loops, guard and watchdog of one module."""

    def __init__(self, module: WiredModule, safety: Safety):
        self._kind = module_type(module.module_type)
        self._dt_s = module.tick_ns / 1e9
        self.running = False
        self.module = module
        self.check = SampleCheck(self._kind)
        self.safety = safety
        self.guard = MotorGuard(self._kind, catalogue_limits(self._kind), safety)
        self.lifetime_ns = DEFAULT_LIFETIME_NS
        self.identified = False
        self.set_gains(default_gains(self._kind, DEFAULT_STRATEGY))

    @property
    def information(self) -> ModuleInformation:
        serial, kind, tick_ns, imu_period_ns = self.module
        gains, limits = self.controller.gains, self.safety.tightened(catalogue_limits(self._kind))
        return ModuleInformation(
            serial, serial, FAMILY, kind, gains, limits, tick_ns, imu_period_ns, self.safety
        )

    def set_gains(self, gains: GainSet) -> None:
        self.controller = Controller(self._kind, gains, self._dt_s)

    def run(self, command: Command, sensors: SensorSample) -> float:
        """Return the PWM of one tick; a motor that is off or brakes lets its loops forget their past."""
        position, velocity, effort, brake = command
        if not brake and (position == position or velocity == velocity or effort == effort):
            self.running = True
            speed = sensors.velocity_rad_s
            if self.controller.follows_motor:
                speed -= sensors.deflection_velocity_rad_s
            pwm = self.controller.update(command, sensors.position_rad, speed, sensors.effort_nm)
            return self.guard.limit(pwm, sensors)
        if self.running:
            self.running = False
            self.controller.reset()
        if brake:
            return self.guard.damping(sensors)
        self.guard.state = LimitState.NONE
        return 0.0


class LoopInside:
    """`Modules` whose loops run here, once a tick, on wires to simulated motors and sensors.

    Args:
        wires: to the modules; closed with this.
        safety: their limits by serial; those that it does not have keep to their type's.

    Raises:
        UnknownModuleType: the catalogue does not have the type of a module.
        UsageError: the limits leave a module no position.
    """

    def __init__(self, wires: Wires, safety: Mapping[str, Safety] = MappingProxyType({})):
        self._wires = wires
        self._drives = [_Drive(module, safety.get(module.serial, UNCONFIGURED)) for module in wires.modules]
        self.pwm = [0.0] * len(self._drives)
        self._sensors: list[SensorSample | None] = [None] * len(self._drives)
        self._commands = [MOTOR_OFF] * len(self._drives)
        # When the last commands were given, and whether that was in this tick.
        self._commanded_ns: list[int | None] = [None] * len(self._drives)
        self._answered = True
        self._sequence = 0

    @property
    def bus(self) -> BusClient | None:
        """The physics bus that the wires are, if they are one."""
        return self._wires if isinstance(self._wires, BusClient) else None

    @property
    def information(self) -> Sequence[ModuleInformation]:
        """The modules, named like their serials, with the limits of the catalogue and the gains in force."""
        return tuple(drive.information for drive in self._drives)

    @property
    def identified(self) -> tuple[str, ...]:
        """The serials of the marked modules."""
        return tuple(drive.module.serial for drive in self._drives if drive.identified)

    def receive(self) -> list[ModuleSample]:
        """Hand the PWM to the motors, wait for the next tick, return one sample per module.

        Raises:
            HardwareLost: no further tick will come.
        """
        if not self._answered:
            self._go_on()
        readings = self._wires.exchange(self.pwm)
        self._answered = False
        self._sequence += 1
        return [self.take(index, sensors) for index, sensors in enumerate(readings)]

    def send(self, commands: Sequence[Command]) -> list[float]:
        """Run the loops of all modules on one command each; return their PWM, in force from now on.

        Raises:
            ValueError: not one command per module, or there was no sample yet.
        """
        if len(commands) != len(self._drives) or None in self._sensors:
            read = sum(sensors is not None for sensors in self._sensors)
            raise ValueError(
                f"{len(commands)} commands for {len(self._drives)} modules, {read} of them have been "
                "read: receive a sample first, then send one command per module"
            )
        self._answered = True
        return [self.run(index, command) for index, command in enumerate(commands)]

    def exchange(self, pwm: Sequence[float]) -> Readings:
        """Hand these PWM to the motors, wait for the next tick, return its readings; for `QuietTicks`.

        Raises:
            HardwareLost: no further tick will come.
        """
        self.count(1)
        read = self._wires.exchange(pwm)
        return read if isinstance(read, Readings) else Readings.of(read)

    def count(self, ticks: int) -> None:
        """Count ticks whose readings a kernel has exchanged."""
        self._sequence += ticks

    def take(self, index: int, read: SensorSample) -> ModuleSample:
        """Check what one module has read; return its sample."""
        drive = self._drives[index]
        sensors = self._sensors[index] = drive.check.checked(read)
        drive.guard.watch(sensors)
        fault = drive.check.fault or drive.guard.fault
        return ModuleSample(sensors, self.pwm[index], self._sequence, drive.guard.state, False, fault)

    def run(self, index: int, command: Command) -> float:
        """Run the loops of one module, which has been read, on a command; return its PWM."""
        sensors = self._sensors[index]
        assert sensors is not None
        self._commands[index], self._commanded_ns[index] = command, sensors.t_ns
        pwm = self.pwm[index] = self._drives[index].run(command, sensors)
        return pwm

    def _go_on(self) -> None:
        """Run the loops on their last commands, or none where the lifetime is over."""
        for index, (drive, sensors) in enumerate(zip(self._drives, self._sensors, strict=True)):
            assert sensors is not None
            since_ns = self._commanded_ns[index]
            age_ns = 0 if since_ns is None else sensors.t_ns - since_ns
            alive = 0 <= age_ns <= drive.lifetime_ns
            self.pwm[index] = drive.run(self._commands[index] if alive else MOTOR_OFF, sensors)

    def quiet_state(self, index: int) -> DriveState:
        """Return what quiet ticks after this one need of a module."""
        drive = self._drives[index]
        return DriveState(
            drive.controller,
            drive.check.is_clean,
            drive.running,
            int(drive.guard.state),
            self.pwm[index],
            drive.guard.bounds,
        )

    def most(self, index: int) -> tuple[float, ...]:
        """Return the largest readings of a working module, from the position on in the order of a sample."""
        return self._drives[index].check.most

    def go_on(
        self,
        index: int,
        last: SensorSample,
        pwm: float,
        running: bool,
        limit: int,
        memory: Sequence[Sequence[float]],
    ) -> None:
        """Go on from what a quiet tick has left of a module: its sample, PWM, and the memory of its loops."""
        drive = self._drives[index]
        drive.check.go_on(last)
        drive.running, drive.guard.state = running, LimitState(limit)
        self.pwm[index] = pwm
        for loop, own in zip(drive.controller.loops, memory, strict=True):
            loop.remember(own)

    def set_gains(self, index: int, gains: GainSet) -> None:
        """Replace the gains of a module from the next `send` on; its loops forget their past."""
        self._drives[index].set_gains(gains)

    def set_lifetime(self, index: int, lifetime_ns: int) -> None:
        """Set how long a command is followed without another [ns of the module's clock].

        Raises:
            ValueError: a lifetime that is not positive.
        """
        if lifetime_ns <= 0:
            raise ValueError(f"lifetime {lifetime_ns / 1e6:g} ms: it must be over 0")
        self._drives[index].lifetime_ns = lifetime_ns

    def identify(self, index: int, on: bool) -> None:
        """Set or clear the mark of a module, see `identified`; a simulated module has no LED."""
        self._drives[index].identified = on

    def close(self) -> None:
        """Close the wires: the motors get zero PWM. May be called twice."""
        self._wires.close()

"""Simulated modules behind the contract of real ones: the loops that a real module closes inside.

Loops, gains, motor guard, brake and watchdog are here, as they depend on nothing but the module; `hardware`
says what is in the firmware instead.
"""

from collections.abc import Sequence

from module_agent.control.controller import MOTOR_OFF, Command, Controller
from module_agent.control.gains import catalogue_limits, default_gains
from module_agent.hardware.hardware import (
    LimitState,
    ModuleInformation,
    ModuleSample,
    SensorSample,
    WiredModule,
    Wires,
)
from module_agent.hardware.motor_guard import MotorGuard
from module_agent.hardware.sample_check import SampleCheck
from module_agent.model.catalogue import module_type
from module_agent.wire.messages import GainSet

DEFAULT_LIFETIME_NS = 250_000_000
DEFAULT_STRATEGY = 3
FAMILY = "simulated"


class _Drive:
    """Loops, guard and watchdog of one module."""

    def __init__(self, module: WiredModule):
        self._kind = module_type(module.module_type)
        self._dt_s = module.tick_ns / 1e9
        self._running = False
        self.module = module
        self.check = SampleCheck(self._kind)
        self.guard = MotorGuard(self._kind, catalogue_limits(self._kind))
        self.lifetime_ns = DEFAULT_LIFETIME_NS
        self.identified = False
        self.set_gains(default_gains(self._kind, DEFAULT_STRATEGY))

    @property
    def information(self) -> ModuleInformation:
        serial, kind, tick_ns, imu_period_ns = self.module
        gains, limits = self.controller.gains, catalogue_limits(self._kind)
        return ModuleInformation(serial, serial, FAMILY, kind, gains, limits, tick_ns, imu_period_ns)

    def set_gains(self, gains: GainSet) -> None:
        self.controller = Controller(self._kind, gains, self._dt_s)

    def run(self, command: Command, sensors: SensorSample) -> float:
        """Return the PWM of one tick; a motor that is off or brakes lets its loops forget their past."""
        position, velocity, effort, brake = command
        if not brake and (position == position or velocity == velocity or effort == effort):
            self._running = True
            speed = sensors.velocity_rad_s
            if self.controller.follows_motor:
                speed -= sensors.deflection_velocity_rad_s
            pwm = self.controller.update(command, sensors.position_rad, speed, sensors.effort_nm)
            return self.guard.limit(pwm, sensors)
        if self._running:
            self._running = False
            self.controller.reset()
        if brake:
            return self.guard.damping(sensors)
        self.guard.state = LimitState.NONE
        return 0.0


class LoopInside:
    """`Modules` whose loops run here, once a tick, on wires to simulated motors and sensors.

    Args:
        wires: to the modules; closed with this.

    Raises:
        UnknownModuleType: the catalogue does not have the type of a module.
    """

    def __init__(self, wires: Wires):
        self._wires = wires
        self._drives = [_Drive(module) for module in wires.modules]
        self.pwm = [0.0] * len(self._drives)
        self._sensors: Sequence[SensorSample] = ()
        self._commands: Sequence[Command] = [MOTOR_OFF] * len(self._drives)
        # The samples that the last commands answered.
        self._answered: Sequence[SensorSample] = ()
        self._sequence = 0

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
        if self._answered is not self._sensors:
            self._go_on()
        pwm, read = self.pwm, self._wires.exchange(self.pwm)
        self._sensors = [
            drive.check.checked(sensors) for drive, sensors in zip(self._drives, read, strict=True)
        ]
        self._sequence += 1
        return [
            ModuleSample(sensors, u, self._sequence, drive.guard.state, False, drive.check.fault)
            for drive, sensors, u in zip(self._drives, self._sensors, pwm, strict=True)
        ]

    def send(self, commands: Sequence[Command]) -> list[float]:
        """Run the loops of all modules on one command each; return their PWM, in force from now on.

        Raises:
            ValueError: not one command per module, or there was no sample yet.
        """
        sensors = self._sensors
        if not len(commands) == len(self._drives) == len(sensors):
            raise ValueError(
                f"{len(commands)} commands for {len(self._drives)} modules, {len(sensors)} of them have been "
                "read: receive a sample first, then send one command per module"
            )
        self._commands, self._answered = commands, sensors
        self.pwm = list(map(_Drive.run, self._drives, commands, sensors))
        return self.pwm

    def _go_on(self) -> None:
        """Run the loops on their last commands, or none where the lifetime is over."""
        answered = self._answered or self._sensors
        each = zip(self._drives, self._commands, self._sensors, answered, strict=True)
        self.pwm = [
            drive.run(command if 0 <= sensors.t_ns - last.t_ns <= drive.lifetime_ns else MOTOR_OFF, sensors)
            for drive, command, sensors, last in each
        ]

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

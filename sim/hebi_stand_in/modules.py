"""Simulated modules on HEBI's network: they tick by themselves and keep their last command alive."""

import math
from collections.abc import Sequence
from typing import Any

from module_agent.control.controller import MOTOR_OFF, NOMINAL_VOLTAGE_V, Command
from module_agent.control.gains import default_gains, for_message, from_message
from module_agent.control.safety import UNCONFIGURED, Safety
from module_agent.hardware.hardware import (
    LimitState,
    ModuleSample,
    Readings,
    SensorSample,
    WiredModule,
)
from module_agent.hardware.hebi_modules import FIELDS
from module_agent.hardware.hebi_network import AT_LIMIT, AT_M_STOP
from module_agent.hardware.loop_inside import LoopInside
from module_agent.model.catalogue import AMBIENT_C, GRAVITY_M_S2, module_type
from module_agent.wire.messages import GainSet, PidGains
from sim.hebi_stand_in.messages import LOOPS, Color, GroupCommand, GroupFeedback, GroupInfo

FAMILY = "simulated"
_LIMITS = {"position": "position_rad", "velocity": "velocity_rad_s", "effort": "effort_nm"}
_SAFETY = [
    *(f"{name}_limit_{side}" for name in _LIMITS for side in ("min", "max")),
    *("min_position_limit_strategy", "max_position_limit_strategy", "mstop_strategy"),
]
UNLOCKED, LOCKED_BY_OTHER, LOCKED_BY_SENDER = 0, 1, 2
_AT_LOWER, _INSIDE, _AT_UPPER = 1, 2, 3
_AT_LIMIT = {value: action for action, value in AT_LIMIT.items()}
_AT_M_STOP = {value: action for action, value in AT_M_STOP.items()}
# Readings before the first tick: at rest, with z up.
_NOTHING = SensorSample(0, 0, 0, 0, 0, 0, 0, 0, AMBIENT_C, 24.0, 0, 0, 0, 0, 0, GRAVITY_M_S2)


class _Wires:
    """The wires inside one module; the tick has passed already when its loops ask for it."""

    def __init__(self, module: WiredModule):
        self.modules: Sequence[WiredModule] = (module,)
        self.reading = _NOTHING

    def exchange(self, pwm: Sequence[float]) -> Sequence[SensorSample]:
        return (self.reading,)

    def close(self) -> None:
        """Do nothing: the wires are inside."""


class NetworkModule:
    """One simulated module with its settings, and the sender that commands it.

    m_stop: its emergency stop is pressed. silent: it hears and says nothing, as with its cable pulled out.
    """

    def __init__(self, module: WiredModule):
        self._wires = _Wires(module)
        self._safety = UNCONFIGURED.model_copy(update={"m_stop": "motor_off"})
        self._loops = LoopInside(self._wires)
        self._kind = module_type(module.module_type)
        self.serial = self.name = module.serial
        self.family = FAMILY
        self.type = module.module_type
        self.accel_includes_gravity = True
        self.m_stop = self.silent = False
        # Whether the motor was held off by the module itself in the last tick.
        self._is_stopped = False
        self.led: Color | None = None
        self.sample = self._loops.take(0, _NOTHING)
        self._targets: Command | None = None
        self._held: Command | None = None
        self._sender: object = None
        self._until_ns: float = 0

    @property
    def gains(self) -> GainSet:
        """The gains in force."""
        return self._loops.information[0].gains

    def tick(self, reading: SensorSample) -> float:
        """Run the loops on what is read; return the PWM."""
        self._wires.reading = reading
        (self.sample,) = self._loops.receive()
        was_stopped = self._is_stopped
        self._is_stopped = (self.m_stop and self._safety.m_stop == "motor_off") or self._is_off_at_limit
        if self._is_stopped and not was_stopped:
            # HEBI's MotorOff: strategy 0, which stays until the user sets another one.
            self._loops.set_gains(0, default_gains(self._kind, 0))
            self._targets = MOTOR_OFF
        if self.m_stop and self._safety.m_stop == "hold":
            self._targets = self._held = self._held or Command(reading.position_rad, math.nan, math.nan)
        else:
            self._held = None
        if self.sample.sensors.t_ns > self._until_ns and self._sender is not None:
            self._sender, self._targets = None, MOTOR_OFF
        if self._targets is not None:
            # A command lives on by HEBI's lifetime, not by that of the loops.
            self._loops.send([self._targets])
        return self._loops.pwm[0]

    @property
    def _is_off_at_limit(self) -> bool:
        return "motor off at the limit" in self.sample.fault

    def command(self, sender: object, lifetime_ms: int, command: GroupCommand, index: int) -> bool:
        """Take one module's part of a command; return whether the module heard it."""
        if self.silent:
            return False
        now_ns = self.sample.sensors.t_ns
        if self._sender not in (None, sender):
            return True
        self._sender = sender
        self._until_ns = now_ns + 1e6 * lifetime_ms if lifetime_ms else math.inf
        position, velocity, effort = (float(getattr(command, name)[index]) for name in LOOPS)
        self._targets = Command(position, velocity, effort)
        self._settings(command, index)
        return True

    def _settings(self, command: GroupCommand, index: int) -> None:
        written = {each[0] for each in command.written if isinstance(each, tuple) and each[1] == index}
        if "control_strategy" in written:
            own = self.gains.model_dump()
            for loop in LOOPS:
                names = [name for name in PidGains.model_fields if f"{loop}_{name}" in written]
                told = {name: getattr(command, f"{loop}_{name}")[index].item() for name in names}
                own[loop] |= {k: v if isinstance(v, bool) else for_message(v) for k, v in told.items()}
            own["strategy"] = int(command.control_strategy[index])
            self._loops.set_gains(0, GainSet.model_validate(own))
        if safety := {name: getattr(command, name)[index].item() for name in _SAFETY if name in written}:
            self._restrict(safety)
        if "accel_includes_gravity" in command.written:
            self.accel_includes_gravity = bool(command.accel_includes_gravity[index])
        if (color := command.leds[index].color) is not None:
            self.led = color if color.a else None

    def _restrict(self, written: dict[str, Any]) -> None:
        """Take limits by HEBI's names."""
        own = self._safety.model_dump()
        for place, side in enumerate(("min", "max")):
            for name, ours in _LIMITS.items():
                if (limit := written.get(f"{name}_limit_{side}")) is not None:
                    own[ours] = [limit if k == place else value for k, value in enumerate(own[ours])]
            if (action := written.get(f"{side}_position_limit_strategy")) is not None:
                own["at_limit"] = [
                    _AT_LIMIT[action] if k == place else v for k, v in enumerate(own["at_limit"])
                ]
        if (action := written.get("mstop_strategy")) is not None:
            own["m_stop"] = _AT_M_STOP[action]
        gains, self._safety = self.gains, Safety.model_validate(own)
        self._loops = LoopInside(self._wires, {self.serial: self._safety})
        self._loops.set_gains(0, gains)
        self.sample = self._loops.take(0, self.sample.sensors)

    def write_feedback(self, sender: object, feedback: GroupFeedback, index: int) -> None:
        """Write this module's part of a feedback for a sender."""
        sensors = self.sample.sensors
        for ours, name in FIELDS.items():
            getattr(feedback, name)[index] = getattr(sensors, ours)
        feedback.gyro[index] = sensors.gyro_x_rad_s, sensors.gyro_y_rad_s, sensors.gyro_z_rad_s
        feedback.accelerometer[index] = sensors.accel_x_m_s2, sensors.accel_y_m_s2, sensors.accel_z_m_s2
        if not self.accel_includes_gravity:
            feedback.accelerometer[index, 2] -= GRAVITY_M_S2
        feedback.pwm_command[index] = self.sample.pwm * NOMINAL_VOLTAGE_V / sensors.voltage_v
        feedback.hardware_transmit_time_us[index] = sensors.t_ns // 1000
        feedback.mstop_state[index] = not self.m_stop
        locked = UNLOCKED if self._sender is None else LOCKED_BY_OTHER
        feedback.command_lifetime_state[index] = LOCKED_BY_SENDER if self._sender is sender else locked
        self._write_limits(self.sample, feedback, index)

    def _write_limits(self, sample: ModuleSample, feedback: GroupFeedback, index: int) -> None:
        acting = sample.limits
        feedback.temperature_state[index] = (
            2 if LimitState.OVER_TEMPERATURE in acting else int(LimitState.TEMPERATURE in acting)
        )
        low, high = self._safety.range_rad
        position_rad = sample.sensors.position_rad
        at = _AT_LOWER if position_rad - low < high - position_rad else _AT_UPPER
        if self._safety.at_limit[at == _AT_UPPER] == "motor_off":
            # Before this limit the motor is slowed down, which HEBI's modules do not say.
            acting &= ~LimitState.POSITION
            acting |= LimitState.POSITION if self._is_off_at_limit else LimitState.NONE
        for name in LOOPS:
            flag = LimitState[name.upper()]
            getattr(feedback, f"{name}_limit_state")[index] = at if flag in acting else _INSIDE

    def write_info(self, info: GroupInfo, index: int) -> None:
        """Write what this module tells of itself."""
        info.name[index], info.family[index], info.serial[index] = self.name, self.family, self.serial
        info.mechanical_type[index], info.firmware_revision[index] = self.type, "stand-in"
        info.accel_includes_gravity[index] = self.accel_includes_gravity
        info.control_strategy[index] = self.gains.strategy
        for loop in LOOPS:
            own: PidGains = getattr(self.gains, loop)
            for name in PidGains.model_fields:
                getattr(info, f"{loop}_{name}")[index] = from_message(getattr(own, name))
        safety, limits = self._safety, self._loops.information[0].limits
        told = limits.min_position_rad, limits.max_position_rad
        for side, value, action in zip(("min", "max"), told, safety.at_limit, strict=True):
            getattr(info, f"position_limit_{side}")[index] = math.nan if value is None else value
            action = "disabled" if value is None else action
            getattr(info, f"{side}_position_limit_strategy")[index] = AT_LIMIT[action]
        for name, ours in _LIMITS.items():
            for side, value in zip(("min", "max"), getattr(safety, ours), strict=True):
                if name != "position" and math.isfinite(value):
                    getattr(info, f"{name}_limit_{side}")[index] = value
        info.mstop_strategy[index] = AT_M_STOP[safety.m_stop or "motor_off"]


class ModuleNetwork:
    """All simulated modules of a network; `tick` is called once a millisecond of theirs."""

    def __init__(self, modules: Sequence[WiredModule]):
        self.all = [NetworkModule(module) for module in modules]

    def tick(self, readings: Readings) -> list[float]:
        """Run the loops of all modules; return the PWM of each."""
        return [module.tick(reading) for module, reading in zip(self.all, readings, strict=True)]

    def named(self, family: str, names: Sequence[str] | None = None) -> list[NetworkModule] | None:
        """Return the modules of a family, in the order of `names` if given; None if one is missing."""
        family_of = {module.name: module for module in self.all if module.family == family}
        if names is None:
            return list(family_of.values()) or None
        return [family_of[name] for name in names] if set(names) <= set(family_of) else None


def entry_of(module: NetworkModule) -> Any:
    """Return a module's entry in a lookup."""
    return Entry(module.name, module.family)


class Entry:
    """A module that a lookup has seen; simulated ones have no address of their own."""

    mac_address = "00:00:00:00:00:00"
    ip_address = "127.0.0.1"

    def __init__(self, name: str, family: str):
        self.name, self.family = name, family

"""Real HEBI modules behind the contract of `Modules`, through hebi-py.

The loops run in the modules, which keep a command for HEBI's command lifetime: an agent that dies lets its
modules expire by themselves. The driver paces itself: a tick is a feedback request, its answer and a command.
What the modules send is checked as every sample is.

A module is sent nothing until it is first to follow a target, which only the acquisition of its lease makes
it. So it is again after it has switched its motor off by itself, at its M-stop or at a limit: HEBI's modules
then keep strategy 0 until they are given another, which must be no side effect of the end of a lease.

Gains are written whenever a module begins to follow: another program may have had it meanwhile. A brake is a
velocity of 0 under the factory's gains, since those of a holder may drive the motor. Before the driver falls
silent it writes the gains that the modules came with, so that neither other programs nor the next agent take
those of a holder for the owner's; an agent that is killed cannot do so, nor is it done to a module that has
switched its motor off: it keeps HEBI's strategy 0, and gets its owner's gains after its next lease.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from module_agent.control.controller import NOMINAL_VOLTAGE_V, Command
from module_agent.control.gains import default_gains, from_message
from module_agent.hardware.hardware import (
    HardwareLost,
    LimitState,
    ModuleInformation,
    ModuleSample,
    SensorSample,
)
from module_agent.hardware.hebi_library import Group, Library, told_states
from module_agent.hardware.loop_inside import DEFAULT_STRATEGY
from module_agent.hardware.sample_check import MAX_HELD, SampleCheck
from module_agent.model.catalogue import module_type
from module_agent.wire.messages import GainSet

# A round trip takes 0.7 ms, 1.6 at most (measured on a real X5-1).
FEEDBACK_TIMEOUT_MS = 20
LOST_AFTER_S = 1.0
# A module's clock begins anew when it boots; feedback that was overtaken is younger.
RESTARTED_NS = 1_000_000_000
_CONFIRM_MS, _CONFIRM_TRIES = 50, 3
# Of the gains to brake with, which are sent until they are confirmed, while other modules have their ticks.
_BRAKE_CONFIRM_MS, _BRAKE_AGAIN_TICKS = 5, 10
_OFF_LED, _ON_LED = (0, 0, 0, 0), (255, 0, 255, 255)

# HEBI's name of every reading of a sample from the position on, but for the two vectors.
FIELDS = {
    "position_rad": "position",
    "velocity_rad_s": "velocity",
    "effort_nm": "effort",
    "deflection_rad": "deflection",
    "motor_velocity_rad_s": "motor_velocity",
    "motor_current_a": "motor_winding_current",
    "winding_temperature_c": "motor_winding_temperature",
    "voltage_v": "voltage",
    "deflection_velocity_rad_s": "deflection_velocity",
}
_COLUMNS = [(SensorSample._fields.index(ours), hebi) for ours, hebi in FIELDS.items()]
_GYRO = SensorSample._fields.index("gyro_x_rad_s")
_ACCEL = SensorSample._fields.index("accel_x_m_s2")
_IMU = slice(_GYRO, _ACCEL + 3)
_POSITION, _VOLTAGE = (SensorSample._fields.index(name) for name in ("position_rad", "voltage_v"))

# HEBI's values of the states of a module.
_M_STOP_PRESSED, _M_STOP_RELEASED = 0, 1
_BELOW, _AT_LOWER, _INSIDE, _AT_UPPER, _ABOVE = range(5)
_TEMPERATURES = {1: LimitState.TEMPERATURE, 2: LimitState.OVER_TEMPERATURE, 3: LimitState.OVER_TEMPERATURE}
_LIMIT_FIELDS = {
    "position_limit_state": LimitState.POSITION,
    "velocity_limit_state": LimitState.VELOCITY,
    "effort_limit_state": LimitState.EFFORT,
}
_LOCKED_BY_OTHER = 1
HELD_BY_OTHER = "another program commands this module (command_lifetime_state: LockedByOther): end it first"


class HebiModules:
    """`Modules` over a HEBI group.

    Nothing is sent before a module is to follow a target, and while all motors are off for longer than a
    lifetime, so that other programs can command the modules.

    Args:
        library: hebi-py, or what stands in for it.
        group: the modules; its own feedback thread is turned off.
        information: of the modules, see `hebi_network.describe`.
        wait: returns when the next tick is due.
        stamp: a clock [ns] in place of the modules', for a group whose feedback has no times.
    """

    def __init__(
        self,
        library: Library,
        group: Group,
        information: Sequence[ModuleInformation],
        wait: Callable[[], None],
        stamp: Callable[[], int] | None = None,
    ):
        self._library, self._group = library, group
        self._information = list(information)
        self._wait, self._stamp = wait, stamp
        self._links = [_Link(one) for one in information]
        self._own_gains = [one.gains for one in information]
        count = len(self._links)
        self._feedback = library.GroupFeedback(count)
        self._command = library.GroupCommand(count)
        self._targets = np.full((count, 3), math.nan)
        self._lifetimes_ns = [250_000_000] * count
        self._readings = np.full((count, len(SensorSample._fields)), math.nan)
        self._told = told_states(self._feedback)
        self._ticks = self._missed = self._unsent = 0
        # Since when all motors are off; before the first command there is nothing to repeat.
        self._off_ticks: float = math.inf
        self._closed = False
        group.feedback_frequency = 0.0
        self._apply_lifetime()

    @property
    def information(self) -> Sequence[ModuleInformation]:
        """The modules, in the order of the group, with the gains in force."""
        return tuple(self._information)

    def receive(self) -> list[ModuleSample]:
        """Wait until the next tick is due, ask the modules for their feedback, return one sample per module.

        A module that does not answer keeps its last sample, whose time all but stands still; a few times in a
        row are a fault.

        Raises:
            HardwareLost: no module has answered for `LOST_AFTER_S`, or this is closed.
        """
        if self._closed:
            raise HardwareLost("the modules are released")
        self._wait()
        self._ticks += 1
        self._group.send_feedback_request()
        answer = self._group.get_next_feedback(timeout_ms=FEEDBACK_TIMEOUT_MS, reuse_fbk=self._feedback)
        if answer is None:
            self._missed += 1
            alone = len(self._links) == 1
            if self._missed * FEEDBACK_TIMEOUT_MS >= 1e3 * LOST_AFTER_S:
                raise HardwareLost(
                    f"{self._names} has not answered for {LOST_AFTER_S:g} s"
                    if alone
                    else f"{self._names} have not all answered for {LOST_AFTER_S:g} s; one that is silent is "
                    "enough, as hebi-py gives the feedback of a group whole or not at all: x5-agent --hebi "
                    "--list shows which answer"
                )
            return [link.without_feedback(of_group=not alone) for link in self._links]
        self._missed = 0
        return self._samples(answer)

    def send(self, commands: Sequence[Command]) -> list[float]:
        """Send one command per module; return the PWM of the last feedback.

        Raises:
            ValueError: not one command per module, or there was no sample yet.
            HardwareLost: commands cannot be sent for `LOST_AFTER_S`, or new gains are not confirmed.
        """
        if len(commands) != len(self._links) or not self._ticks:
            raise ValueError(
                f"{len(commands)} commands for {len(self._links)} modules, {self._ticks} ticks have been "
                "read: receive a sample first, then send one command per module"
            )
        heard = self._may_follow
        due = [index for index, command in enumerate(commands) if self._take(index, command)]
        active = bool(np.isfinite(self._targets).any())
        self._off_ticks = 0 if active else self._off_ticks + 1
        brakes = [index for index in due if commands[index].brake]
        begin = [index for index in due if index not in brakes]
        # No target without the gains that it is for: when these are sent anew they bring it along.
        without = [index for index in begin if self._links[index].awaits_gains]
        is_confirmed = not begin or self._try_gains(begin)
        if not is_confirmed:
            self._targets[without] = math.nan
        if brakes:
            self._try_brake_gains(brakes)
        # That the motors are off may be lost on the way: it is repeated until the modules' own lifetime ends.
        if active or self._may_follow:
            if is_confirmed:
                self._send_targets()
        elif heard and self._lent:
            self._hand_back()
        return [link.pwm for link in self._links]

    def set_gains(self, index: int, gains: GainSet) -> None:
        """Replace the gains of a module while it is commanded, with the next command that is sent.

        HEBI's messages have gains and targets together: sent now they would repeat targets that have expired.
        A module that is sent nothing gets them with its first target.
        """
        self._information[index] = self._information[index]._replace(gains=gains)

    def set_lifetime(self, index: int, lifetime_ns: int) -> None:
        """Set HEBI's command lifetime, in whole milliseconds; a group has one, the shortest of its modules.

        Raises:
            ValueError: a lifetime that is not positive.
        """
        if lifetime_ns <= 0:
            raise ValueError(f"lifetime {lifetime_ns / 1e6:g} ms: it must be over 0")
        self._lifetimes_ns[index] = lifetime_ns
        self._apply_lifetime()

    def identify(self, index: int, on: bool) -> None:
        """Light a module's LED, or give it back to the module."""
        command = self._settings()
        command[index].led.color = self._library.Color(*(_ON_LED if on else _OFF_LED))
        self._group.send_command(command)

    def close(self) -> None:
        """Send a last command, without targets, to modules that may follow one. May be called twice."""
        if self._closed:
            return
        self._closed = True
        if self._may_follow:
            self._targets[:] = math.nan
            self._hand_back()

    @property
    def _names(self) -> str:
        return ", ".join(link.serial for link in self._links)

    @property
    def _may_follow(self) -> bool:
        """Whether the lifetime of the last target that was sent is not over."""
        return self._off_ticks * self._information[0].tick_ns <= min(self._lifetimes_ns)

    def _samples(self, answer: Any) -> list[ModuleSample]:
        readings = self._readings
        for column, name in _COLUMNS:
            readings[:, column] = getattr(answer, name)
        readings[:, _GYRO : _GYRO + 3] = answer.gyro
        readings[:, _ACCEL : _ACCEL + 3] = answer.accelerometer
        pwm = np.nan_to_num(answer.pwm_command * readings[:, _VOLTAGE] / NOMINAL_VOLTAGE_V)
        times_us = answer.hardware_transmit_time_us.tolist()
        positions = self._states(answer, "position_limit_state", unset=_INSIDE).tolist()
        limits = [_TEMPERATURES.get(state, LimitState.NONE) for state in answer.temperature_state.tolist()]
        for name, flag in _LIMIT_FIELDS.items():
            for index in np.flatnonzero(self._states(answer, name, unset=_INSIDE) != _INSIDE).tolist():
                limits[index] |= flag
        pressed = (self._states(answer, "mstop_state", unset=_M_STOP_RELEASED) == _M_STOP_PRESSED).tolist()
        locked = (answer.command_lifetime_state == _LOCKED_BY_OTHER).tolist()
        stamped_ns = None if self._stamp is None else self._stamp()
        samples = []
        for index, (link, row) in enumerate(zip(self._links, readings.tolist(), strict=True)):
            t_ns = 1000 * int(times_us[index]) if stamped_ns is None else stamped_ns
            if t_ns == 0 or t_ns == link.feedback_ns:
                samples.append(link.without_feedback())
                continue
            link.pwm = min(max(float(pwm[index]), -1.0), 1.0)
            link.limits, link.m_stop = limits[index], pressed[index]
            off = _off_at_limit(self._information[index], positions[index], row[_POSITION])
            link.stays_off = bool(off) or (link.m_stop and link.m_stop_latches)
            link.is_withheld |= link.stays_off
            fault = off or (HELD_BY_OTHER if locked[index] else "")
            samples.append(link.with_feedback(t_ns, row, self._ticks, fault))
        return samples

    def _states(self, answer: Any, name: str, unset: int) -> NDArray[np.int32]:
        """Return a state of all modules; `unset` for those that do not send it, which hebi-py reads as 0."""
        states: NDArray[np.int32] = getattr(answer, name)
        # Only a 0 may stand for what is not there.
        return states if states.all() else np.where(self._told(answer, name), states, unset)

    def _take(self, index: int, command: Command) -> bool:
        """Keep the target of a module, or none while it is sent nothing; return whether its gains are due.

        A target that is no brake comes from a lease that was acquired since the module switched itself off:
        until then the firmware lets it rest, or brakes. The module gets its strategy back with its gains.
        """
        link, follows = self._links[index], any(map(math.isfinite, command[:3]))
        if follows and not (command.brake or link.stays_off):
            link.is_withheld = False
        begins, link.follows = follows and not link.follows, follows and not link.is_withheld
        self._targets[index] = math.nan if link.is_withheld else command[:3]
        if begins or link.is_withheld or not self._may_follow:
            link.given = None
        if begins:
            link.tries, link.awaits_gains = 0, True
        if not link.follows and link.given is None:
            return False
        link.wanted = link.brake_gains if command.brake else self._information[index].gains
        is_due = link.wanted is not link.given
        return is_due and not (command.brake and self._ticks < link.brake_tick)

    def _try_gains(self, indices: Sequence[int]) -> bool:
        """Send gains and all targets once; return whether they are confirmed, or else are due again.

        One try a tick: while one module's answer is lost, a stop of the others waits for no more than that.
        """
        links = [self._links[index] for index in indices]
        is_confirmed = self._group.send_command_with_acknowledgement(
            self._with_gains(indices), timeout_ms=_CONFIRM_MS
        )
        for link in links:
            # Those that are not confirmed may have arrived.
            link.given = link.wanted if is_confirmed else None
            link.tries = 0 if is_confirmed else link.tries + 1
            link.awaits_gains &= not is_confirmed
        if max(link.tries for link in links) >= _CONFIRM_TRIES:
            names = ", ".join(link.serial for link in links)
            raise HardwareLost(
                f"the gains of {names} are not confirmed in {_CONFIRM_TRIES} tries of {_CONFIRM_MS} ms"
            )
        return is_confirmed

    def _try_brake_gains(self, indices: Sequence[int]) -> None:
        """Send the gains to brake with once, and again after a while if they are not confirmed.

        A stop must end no agent, whose motors would be off then, nor wait for an answer that is lost: the
        brake's target is sent in every tick, under whatever gains there are.
        """
        is_confirmed = self._group.send_command_with_acknowledgement(
            self._with_gains(indices), timeout_ms=_BRAKE_CONFIRM_MS
        )
        for index in indices:
            link = self._links[index]
            link.given, link.tries = (link.wanted if is_confirmed else None), 0
            link.brake_tick = 0 if is_confirmed else self._ticks + _BRAKE_AGAIN_TICKS

    def _with_gains(self, indices: Sequence[int]) -> Any:
        """Return a command with the targets of the last one, and the gains that modules are to have."""
        command = self._settings()
        for index in indices:
            link = self._links[index]
            write_gains(command[index], link.wanted)
            link.is_lent |= link.wanted is not self._own_gains[index]
        return command

    @property
    def _lent(self) -> list[int]:
        """The modules that may have other gains than those that they came with, by this driver.

        One that is withheld is none: gains would set its strategy, and it would follow again.
        """
        return [index for index, link in enumerate(self._links) if link.is_lent and not link.is_withheld]

    def _hand_back(self) -> None:
        """Give the modules the gains that they came with, as far as they confirm it; none has a target."""
        command = self._settings()
        for index in self._lent:
            write_gains(command[index], self._own_gains[index])
            self._links[index].is_lent = False
        for link in self._links:
            link.given = None
        for _ in range(_CONFIRM_TRIES):
            if self._group.send_command_with_acknowledgement(command, timeout_ms=_CONFIRM_MS):
                return

    def _send_targets(self) -> None:
        self._write_targets(self._command)
        self._unsent = 0 if self._group.send_command(self._command) else self._unsent + 1
        if self._unsent * self._information[0].tick_ns > 1e9 * LOST_AFTER_S:
            raise HardwareLost(f"commands to {self._names} cannot be sent for {LOST_AFTER_S:g} s")

    def _write_targets(self, command: Any) -> None:
        # A NaN is sent as a target that is not set.
        command.position, command.velocity, command.effort = self._targets.T

    def _settings(self) -> Any:
        """Return a command with the targets of the last one, to which settings are added.

        Targets that are left out would switch the loops off.
        """
        command = self._library.GroupCommand(len(self._links))
        self._write_targets(command)
        return command

    def _apply_lifetime(self) -> None:
        # For HEBI, 0 is for ever.
        self._group.command_lifetime = max(1, min(self._lifetimes_ns) // 1_000_000)


class _Link:
    """What the driver remembers of one module: its last sample, and what it last told of its drive.

    stays_off: it holds its motor off by itself, at its M-stop or at a limit. is_withheld: it is sent neither
    targets nor gains until it is to follow a target. m_stop_latches: the M-stop leaves its motor off.
    follows: its last target was one. given: the gains that were written last, None where another program may
    have written others since; wanted: those that are to be. tries: how often these were not confirmed.
    awaits_gains: whether none were confirmed since it began to follow.
    brake_tick: when those to brake with are due. is_lent: whether others than those that it came with were
    sent since these were handed back, confirmed or not.
    """

    def __init__(self, information: ModuleInformation):
        self.serial = information.serial
        self.feedback_ns = 0
        self.pwm = 0.0
        self.limits = LimitState.NONE
        self.m_stop = False
        self.m_stop_latches = information.safety.m_stop not in ("hold", "disabled")
        self.stays_off = False
        self.is_withheld = True
        self.follows = False
        self.given: GainSet | None = None
        self.wanted = information.gains
        self.tries = 0
        self.awaits_gains = False
        self.is_lent = False
        self.brake_tick = 0
        self.brake_gains = default_gains(module_type(information.module_type), DEFAULT_STRATEGY)
        self._check = SampleCheck(module_type(information.module_type))
        self._sequence = 0
        self._misses = 0
        self._imu: list[float] = []
        self._last = self._check.checked(_sensors(0, 0, [math.nan] * len(SensorSample._fields)))
        self._fault = "no feedback yet"
        self._restarted = ""

    def with_feedback(self, t_ns: int, row: list[float], tick: int, fault: str) -> ModuleSample:
        """Return the sample of a feedback; `row` is in the order of a sample."""
        # Feedback does not say when the IMU was read: no later than when its values were first seen.
        if self.feedback_ns - t_ns > RESTARTED_NS:
            # What was set until its next power cycle is lost: limits, gains, gravity in the accelerometer.
            self._restarted = (
                f"{self.serial} has restarted without its limits and settings: start its agent anew"
            )
        fresh, self._imu = row[_IMU] != self._imu, row[_IMU]
        imu_t_ns = t_ns if fresh else min(self._last.imu_t_ns, t_ns)
        self.feedback_ns, self._sequence, self._misses = t_ns, tick, 0
        self._last = self._check.checked(_sensors(t_ns, imu_t_ns, row))
        self._fault = self._restarted or self._check.fault or fault
        return self._sample(self._fault)

    def without_feedback(self, of_group: bool = False) -> ModuleSample:
        """Return the sample of a tick without feedback: the last one, later by next to nothing.

        A time that overtook the module's clock would let that go back with the next feedback.
        """
        self._misses += 1
        self._last = self._last._replace(t_ns=self._last.t_ns + 1)
        whose = " of the whole group, in which one module may be silent" if of_group else ""
        return self._sample(
            f"no feedback in {self._misses} ticks{whose}" if self._misses > MAX_HELD else self._fault
        )

    def _sample(self, fault: str) -> ModuleSample:
        return ModuleSample(self._last, self.pwm, self._sequence, self.limits, self.m_stop, fault)


def _sensors(t_ns: int, imu_t_ns: int, row: list[float]) -> SensorSample:
    return SensorSample(t_ns, imu_t_ns, *row[2:])


def _off_at_limit(module: ModuleInformation, state: int, position_rad: float) -> str:
    """Return at which limit of position a module has switched its motor off, "" if at none."""
    sides = (_BELOW, _AT_LOWER), (_AT_UPPER, _ABOVE)
    limits = module.limits.min_position_rad, module.limits.max_position_rad
    for side, limit, action in zip(sides, limits, module.safety.at_limit, strict=True):
        if action == "motor_off" and state in side:
            return f"position {position_rad:.3f} rad: motor off at the limit {limit:g} rad"
    return ""


def write_gains(command: Any, gains: GainSet) -> None:
    """Write gains into one module's part of a command."""
    command.control_strategy = gains.strategy
    for loop in ("position", "velocity", "effort"):
        for name, value in getattr(gains, loop):
            own = value if isinstance(value, bool) else from_message(value)
            setattr(command, f"{loop}_{name}", own)

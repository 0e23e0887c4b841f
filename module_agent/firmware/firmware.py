"""The firmware of one module: `step` and then `publish` are called once a tick.

`step` takes a sample of the module and what has arrived from the network, and returns a command for the
module; `publish` takes the PWM that the module makes of it, and returns what to send. There is no clock, no
socket, no file and no randomness in here. The firmware decides by the lease, by how fresh commands are and by
its motions; what a module does by itself is behind `Modules`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from module_agent.control.controller import BRAKE, MOTOR_OFF, Command
from module_agent.control.gains import check_gains, default_gains
from module_agent.control.motion import Motion, check_duration, check_motion, check_setpoint
from module_agent.firmware.admission import Admission, Lease
from module_agent.firmware.config import FirmwareConfig, check_config
from module_agent.firmware.feedback import STATE_INDEX, FeedbackStream
from module_agent.firmware.state import COMMANDED, TRANSITIONS, Trigger
from module_agent.firmware.tick_kernel import BRAKE as BRAKE_MOTOR
from module_agent.firmware.tick_kernel import FOLLOW, MOTION
from module_agent.hardware.hardware import LimitState, Modules, ModuleSample
from module_agent.wire.codec import encode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import (
    EXPLORATION_KINDS,
    Ack,
    Ask,
    Feedback,
    GainsCommand,
    GainSet,
    HistoryRequest,
    Identify,
    Info,
    LeaseRequest,
    Message,
    MotionCommand,
    MotionRecord,
    Setpoint,
    State,
    Status,
    Stop,
    cut,
)
from module_agent.wire.refusal import Refusal, WireError

M_STOP = "M-stop pressed"
FIRMWARE_NAME = "x5-agent 0.1"
MAX_ROWS_PER_ANSWER = 256
STATUS_PERIOD_NS = 400_000_000
# How long after its end a motion is announced to the other modules: a network may lose ten of them in turn.
ANNOUNCED_NS = 5_000_000_000
# A winding that has reached its limit is a fault, and the module is armed again when it has cooled by this.
WINDING_REARM_K = 14.0


class Incoming(NamedTuple):
    """Bytes that arrived for a module; `request` names the question to answer, None for a publication.

    message: what `Admission.read` has made of them, if they were read already.
    """

    leaf: Leaf
    payload: bytes
    request: int | None
    message: Message | None = None


class Publication(NamedTuple):
    """Bytes to publish on one of the module's own keys."""

    leaf: Leaf
    payload: bytes


class Answer(NamedTuple):
    """Bytes that answer the question `request`."""

    request: int
    payload: bytes


Outgoing = Publication | Answer


class QuietState(NamedTuple):
    """What a quiet tick needs of a firmware, see `tick_kernel`; `targets` are those of the last command."""

    source: int
    commanded: bool
    in_fault: bool
    fresh_ns: int
    lifetime_ns: int
    lease_until_ns: int
    status_due_ns: int
    motion: Motion | None
    motion_id: int
    state_number: int
    now_ns: int
    targets: tuple[float, ...]
    limited: int
    behind_ns: int
    winding_c: float
    row_times: tuple[int, int]
    row_periods: tuple[int, int, int, bool]


class Firmware:
    """One module. Times are the module's own nanoseconds, taken from its samples.

    Args:
        config: the settings.
        modules: the modules of this process; the lifetime is set on construction, and gains if configured.
        index: which of them this is the firmware of.

    Raises:
        ValueError: a setting out of its range.
    """

    def __init__(self, config: FirmwareConfig, modules: Modules, index: int = 0):
        self.config = check_config(config)
        self._modules, self._index = modules, index
        self.lease = Lease()
        self._rows = FeedbackStream(config)
        self.history = self._rows.history
        self.admission = Admission(config.serial, config.boot, config.lifetime_ns)
        self.state: State = "idle"
        self.dropped_events = 0
        self._commands = self._command_of_state()
        self._motion: Motion | None = None
        self._record: MotionRecord | None = None
        self.last_rest: MotionRecord | None = None
        self._command: Command = MOTOR_OFF
        self._setpoint: Command = MOTOR_OFF
        self._fresh_ns = 0
        self._stopped_ns = 0
        self._announced_until_ns = 0
        # Whether the motor is off while stopped, and which limits have acted since the last status.
        self._stopped_off = False
        self._hot = False
        self._limited = 0
        self._expiries = 0
        self._seq = 0
        self._now_ns = 0
        self._sample: ModuleSample | None = None
        self._out: list[Outgoing] = []
        self._status_due_ns = 0
        # By how much the clock has fallen behind one that runs at half its rate.
        self._behind_ns = 0
        self._note = ""
        modules.set_lifetime(index, config.lifetime_ns)
        self._gains = self._kept_gains = modules.information[index].gains
        if config.strategy is not None:
            self._kept_gains = default_gains(config.kind, config.strategy)
            self._apply_gains(self._kept_gains)

    def step(self, sample: ModuleSample, inbox: Sequence[Incoming]) -> Command:
        """Begin a tick: expire what is stale, read the inbox; return the command for the module."""
        is_first, self._sample = self._sample is None, sample
        self._limited |= sample.limits
        sensors = sample.sensors
        # No message can carry a time before the clock's zero: until then the module is in fault, at 0.
        now_ns, before_ns = max(sensors.t_ns, 0), self._now_ns
        self._now_ns = now_ns
        # Only a clock that runs slower than at half its rate falls behind for long. Once it runs again, it is
        # well after two lifetimes.
        behind_ns = self._behind_ns + self.config.tick_ns // 2 - max(now_ns - before_ns, 0)
        self._behind_ns = min(max(behind_ns, 0), 2 * self.config.lifetime_ns)
        if now_ns <= before_ns and not is_first:
            self._begin_time_anew(before_ns)
        elif self.state in COMMANDED and 2 * (now_ns - before_ns) > self.config.lifetime_ns:
            self._expire()
            self._note = (
                f"no tick for {(now_ns - before_ns) / 1e6:.0f} ms: the clock jumped, or the module hung"
            )
        if self.state in COMMANDED and now_ns - self._fresh_ns > self.config.lifetime_ns:
            self._expire()
        if self.lease.lapsed(now_ns):
            self._end_lease()
        for incoming in inbox:
            self._receive(incoming)
        if sensors.winding_temperature_c >= self.config.safety.winding_c and self.state != "fault":
            self._finish_motion("fault")
            self._enter("fault", f"winding at {sensors.winding_temperature_c:.0f} C")
            self._hot = True
        if (fault := self._fault(sample)) and self.state != "fault":
            self._finish_motion("fault")
            self._enter("fault", fault)
        if sample.m_stop:
            self._obey_m_stop()
        return self._commands[self.state]()

    def publish(self, pwm: float) -> list[Outgoing]:
        """End a tick with the PWM (at 48 V) that the module makes of its command; return what to send."""
        assert self._sample is not None
        sensors, out, self._out = self._sample.sensors, self._out, []
        if self._rows.due(self._now_ns, sensors.imu_t_ns):
            motion_id = self._record.motion_id if self._motion and self._record else 0
            batch = self._rows.append(sensors, motion_id, self.state, self._command, pwm)
            if batch is not None:
                out.append(Publication(Leaf.FEEDBACK, encode(self._feedback(*batch))))
        if self._now_ns >= self._status_due_ns:
            self._status_due_ns = self._now_ns + STATUS_PERIOD_NS
            status = encode(self._status(re=0))
            out.append(Publication(Leaf.STATUS, status))
            if self._announces_motion():
                out.append(Publication(Leaf.MOTION, status))
        return out

    def _announces_motion(self) -> bool:
        explores = self._record is not None and self._record.pattern.kind in EXPLORATION_KINDS
        return explores and (self._motion is not None or self._now_ns < self._announced_until_ns)

    def quiet_state(self) -> QuietState:
        """Return what quiet ticks after this one need."""
        state = self.state
        braking = (state == "stopped" and not self._stopped_off) or (
            state == "expired" and self.config.expiry_action == "damping"
        )
        motion = self._motion
        return QuietState(
            source=BRAKE_MOTOR if braking else FOLLOW if motion is None else MOTION,
            commanded=state in COMMANDED,
            in_fault=state == "fault",
            fresh_ns=self._fresh_ns,
            lifetime_ns=self.config.lifetime_ns,
            lease_until_ns=self.lease.until_ns,
            status_due_ns=self._status_due_ns,
            motion=motion,
            motion_id=self._record.motion_id if motion and self._record else 0,
            state_number=STATE_INDEX[state],
            now_ns=self._now_ns,
            targets=self._command[:3],
            limited=int(self._limited),
            behind_ns=self._behind_ns,
            winding_c=self.config.safety.winding_c,
            row_times=self._rows.times_ns,
            row_periods=self._rows.periods,
        )

    def go_on(
        self,
        now_ns: int,
        targets: Sequence[float],
        due_ns: int,
        imu_ns: int,
        limited: int,
        behind_ns: int,
    ) -> None:
        """Go on from the time, the targets, the rows, the limits and the clock's lag of a quiet tick."""
        self._now_ns, self._limited, self._behind_ns = now_ns, limited, behind_ns
        position_rad, velocity_rad_s, effort_nm = targets
        self._command = Command(position_rad, velocity_rad_s, effort_nm)
        self._rows.go_on(due_ns, imu_ns)

    def read_renewals(self, now_ns: int, renewals: Sequence[Incoming]) -> list[Outgoing]:
        """Read renewals of the lease after a tick that was quiet without them; return the answers.

        A tick reads them after it has looked for what is over, and they change nothing that it does then.
        """
        self._now_ns = now_ns
        for incoming in renewals:
            self._receive(incoming)
        out, self._out = self._out, []
        return out

    @property
    def validity_ns(self) -> tuple[int, int]:
        """From which time of its feedback on the lifetime of commands counts, and when the lease lapses."""
        return self._fresh_ns, self.lease.until_ns

    @property
    def rows_to_batch(self) -> int:
        """How many feedback rows of quiet ticks complete the next batch to be sent."""
        return self._rows.rows_to_batch

    def keep_rows(self, rows: memoryview) -> list[Outgoing]:
        """Keep feedback rows of quiet ticks, at most `rows_to_batch`; return what to send."""
        batch = self._rows.keep(rows)
        return [] if batch is None else [Publication(Leaf.FEEDBACK, encode(self._feedback(*batch)))]

    def _command_of_state(self) -> dict[State, Callable[[], Command]]:
        # While braking, feedback rows go on showing the last targets.
        on_expiry = {"motor_off": self._rest, "hold": self._follow, "damping": lambda: BRAKE}
        return {
            "idle": self._rest,
            "armed": self._follow,
            "moving": self._follow_motion,
            "streaming": self._follow_setpoint,
            "expired": on_expiry[self.config.expiry_action],
            "stopped": lambda: self._rest() if self._stopped_off else BRAKE,
            "fault": self._rest,
        }

    def _follow(self) -> Command:
        return self._command

    def _rest(self) -> Command:
        self._command = MOTOR_OFF
        return self._command

    def _follow_setpoint(self) -> Command:
        self._command = self._setpoint
        return self._command

    def _follow_motion(self) -> Command:
        assert self._motion is not None
        command = self._motion.command(self._now_ns)
        if command is None:
            self._finish_motion("done")
            self._enter("motion_done")
        else:
            self._command = command
        return self._command

    def _enter(self, trigger: Trigger, note: str = "") -> None:
        target = TRANSITIONS[self.state].get(trigger)
        if target is None:
            why = f" ({self._note})" if self.state == "fault" else ""
            raise WireError(
                Refusal.NOT_ARMED, f"{trigger} is not possible while {self.state}{why}: acquire first"
            )
        # What led to a state stays its reason: a release, or a stop of a module in fault, tells less.
        if target != self.state or not (trigger == "release" or target == "fault"):
            self._note = note
        self.state = target
        self._status_due_ns = 0

    def _apply_gains(self, gains: GainSet) -> None:
        self._gains = gains
        self._modules.set_gains(self._index, gains)

    def _end_lease(self) -> None:
        """End the lease and with it the gains of its holder: the next one shall not inherit them."""
        self.lease.release()
        self._apply_gains(self._kept_gains)
        self._status_due_ns = 0

    def _stop(self, note: str) -> None:
        self._finish_motion("stopped")
        self._enter("stop", note)
        self._stopped_ns, self._stopped_off = self._now_ns, False

    def _obey_m_stop(self) -> None:
        action = self.config.safety.m_stop
        if action == "hold":
            if self.state in ("moving", "streaming"):
                self._finish_motion("stopped")
                self._hold()
                self._enter("hold", M_STOP)
        elif action != "disabled" and self.state != "fault":
            if self.state != "stopped":
                self._stop(M_STOP)
            self._stopped_off = action == "motor_off"

    def _check_m_stop(self) -> None:
        if self._sample is not None and self._sample.m_stop and self.config.safety.m_stop != "disabled":
            raise WireError(Refusal.NOT_ARMED, "the M-stop is pressed: release it first")

    def _expire(self) -> None:
        self._expiries += 1
        self._finish_motion("expired")
        self._hold()
        # Loops that hold begin anew: what they have summed up belongs to the motion.
        self._apply_gains(self._gains)
        self._enter("expire", f"no fresh command for {self.config.lifetime_ns / 1e6:.0f} ms")

    def _hold(self) -> None:
        assert self._sample is not None
        self._command = Command(self._sample.sensors.position_rad, 0.0, math.nan)

    def _begin_time_anew(self, before_ns: int) -> None:
        """Let nothing that was granted by the clock before it stood or went back be valid: command, lease."""
        back_ns = before_ns - self._now_ns
        if self.state in COMMANDED:
            self._expire()
            how = f"went back by {back_ns / 1e6:.0f} ms" if back_ns else "stands"
            self._note = f"the module's clock {how}"
        # While it stands there is nothing to end in every tick.
        if self.lease.holder:
            self._end_lease()
        self._fresh_ns = self._stopped_ns = 0
        if back_ns:
            self._rows.begin_anew()
            self._status_due_ns = 0

    def _fault(self, sample: ModuleSample) -> str:
        """Return what the module reports to be wrong with it, or what is wrong with its clock."""
        if sample.fault:
            return sample.fault
        t_ns = sample.sensors.t_ns
        if t_ns < 0:
            return f"the module's clock reads {t_ns} ns, before its zero"
        is_behind = self._behind_ns > self.config.lifetime_ns
        return "the module's clock stands, or runs slower than at half its rate" if is_behind else ""

    def _finish_motion(self, outcome: str) -> None:
        if self._motion is None or self._record is None:
            return
        self._record = self._record.model_copy(update={"outcome": outcome, "end_row": self.history.next_row})
        # An interrupted motion holds its last commanded position and not its end; the effort that was fed
        # forward to move the joint is not the one that holds it.
        self._command = Command(self._command.position_rad, 0.0, math.nan)
        if outcome == "done":
            self._command = Command(self._motion.last_position_rad, 0.0, self._motion.last_effort_nm)
            if self._record.pattern.kind == "rest":
                self.last_rest = self._record
        self._motion = None
        self._announced_until_ns = self._now_ns + ANNOUNCED_NS

    def _receive(self, incoming: Incoming) -> None:
        try:
            answer = self._dispatch(incoming)
        except WireError as error:
            self.admission.count(error.reason)
            answer = encode(self._ack(0, error))
        if incoming.request is not None:
            self._out.append(Answer(incoming.request, answer))

    def _dispatch(self, incoming: Incoming) -> bytes:
        message = incoming.message or self.admission.read(incoming.leaf, incoming.payload)
        if isinstance(message, LeaseRequest | MotionCommand | Setpoint | GainsCommand):
            self.admission.check_command(message, incoming.payload, self.lease, self._now_ns)
        match message:
            case Ask() if incoming.leaf is Leaf.INFO:
                return encode(self._info())
            case Ask():
                return encode(self._status(message.seq))
            case HistoryRequest():
                end = min(message.end_row, message.first_row + MAX_ROWS_PER_ANSWER)
                return encode(self._feedback(message.first_row, end))
            case Stop():
                self._stop(f"stopped by {message.sender}: {message.why}")
            case LeaseRequest():
                self._act_lease(message)
            case MotionCommand():
                self._start_motion(message)
            case Setpoint():
                self._stream(message)
            case GainsCommand():
                self._set_gains(message)
            case Identify():
                self._modules.identify(self._index, message.on)
            case _:
                raise WireError(Refusal.MALFORMED, f"{incoming.leaf.value} is not answered by the firmware")
        return encode(self._ack(message.seq))

    def _act_lease(self, request: LeaseRequest) -> None:
        if request.action == "renew":
            self.lease.extend(request.duration_ns, self._now_ns)
            self._refresh(request.echo_ns)
            return
        if request.action == "release":
            self._finish_motion("superseded")
            self._end_lease()
            self._enter("release")
            return
        assert self._sample is not None
        winding_c = self._sample.sensors.winding_temperature_c
        cool_c = self.config.safety.winding_c - WINDING_REARM_K
        # One that was too hot cools down first; others are armed up to the limit.
        self._hot = winding_c > cool_c if self._hot else winding_c >= self.config.safety.winding_c
        if self._hot:
            raise WireError(Refusal.NOT_ARMED, f"winding at {winding_c:.0f} C, re-arms below {cool_c:.0f} C")
        if fault := self._fault(self._sample):
            raise WireError(Refusal.NOT_ARMED, fault)
        self._check_m_stop()
        if self.state == "stopped" and request.echo_ns <= self._stopped_ns:
            raise WireError(Refusal.STALE, "sent before the stop: its sender cannot have known of it")
        if not self.lease.acquire(request, self._now_ns):
            return
        self._finish_motion("superseded")
        if self.state not in ("armed", "moving"):
            self._hold()
        self._enter("acquire")
        self._refresh(request.echo_ns)

    def _refresh(self, echo_ns: int) -> None:
        """Count the lifetime from the newest feedback that the sender had, not from the command's arrival.

        A command that was long on the way must not keep a motor running after its sender has died.
        """
        self._fresh_ns = max(self._fresh_ns, echo_ns)

    def _start_motion(self, command: MotionCommand) -> None:
        record = self._record
        if record is not None and record.motion_id == command.motion_id:
            if record.outcome not in ("running", "done"):
                raise WireError(
                    Refusal.SEQUENCE, f"motion {command.motion_id} was {record.outcome}: use a new number"
                )
            self._refresh(command.echo_ns)
            return
        if self.state == "moving":
            raise WireError(Refusal.BUSY, f"motion {record.motion_id if record else '?'} is running")
        self._check_m_stop()
        assert self._sample is not None
        held = self._command.position_rad
        origin = self._sample.sensors.position_rad if math.isnan(held) else held
        check_duration(command.pattern, origin)
        motion = Motion(command.pattern, origin, self._now_ns, command.effort)
        check_motion(motion, self.config.limits)
        self._enter("motion")
        self._motion = motion
        self._refresh(command.echo_ns)
        self._record = MotionRecord(
            motion_id=command.motion_id,
            pattern=command.pattern,
            outcome="running",
            start_ns=self._now_ns,
            start_row=self.history.next_row,
            end_row=None,
            origin_rad=origin,
        )

    def _stream(self, setpoint: Setpoint) -> None:
        if self.state == "moving":
            raise WireError(Refusal.BUSY, "a motion is running; setpoints are taken when it has ended")
        self._check_m_stop()
        assert self._sample is not None
        check_setpoint(setpoint, self._sample.sensors.position_rad, self.config.limits)
        if self.state != "streaming":
            self._enter("setpoint")
        targets = (setpoint.position_rad, setpoint.velocity_rad_s, setpoint.effort_nm)
        position, velocity, effort = (math.nan if target is None else target for target in targets)
        self._setpoint = Command(position, velocity, effort)
        self._refresh(setpoint.echo_ns)

    def _set_gains(self, command: GainsCommand) -> None:
        if self.state == "moving":
            raise WireError(Refusal.BUSY, "gains are taken when no motion is running")
        check_gains(command.gains)
        if command.keep:
            self._kept_gains = command.gains
        self._apply_gains(command.gains)
        self._refresh(command.echo_ns)

    def _head(self) -> dict[str, Any]:
        """Return what every message begins with."""
        self._seq += 1
        return {"serial": self.config.serial, "boot": self.config.boot, "seq": self._seq}

    def _feedback(self, first: int, end: int) -> Feedback:
        rows = self.history.block(first, end)
        return Feedback(**self._head(), first_row=first, count=end - first, rows=rows)

    def _ack(self, re: int, refused: WireError | None = None) -> Ack:
        return acknowledgement(self._head(), self.lease, self._now_ns, re, refused)

    def _status(self, re: int) -> Status:
        limits = tuple(flag.name.lower() for flag in LimitState(self._limited) if flag.name)
        if re == 0:
            self._limited = 0
        return Status(
            **self._head(),
            **self.lease.state(self._now_ns),
            re=re,
            t_ns=self._now_ns,
            state=self.state,
            next_row=self.history.next_row,
            motion=self._record,
            refusals=dict(self.admission.refusals),
            expiries=self._expiries,
            dropped_events=self.dropped_events,
            limits=limits,
            note=cut(self._note),
        )

    def _info(self) -> Info:
        # Of the settings a message takes the fields that it has.
        return Info(
            **self.config._asdict() | self._head(),
            module_type=self.config.kind.name,
            firmware=FIRMWARE_NAME,
            history_rows=self.config.history_rows,
            gains=self._gains,
            t_ns=self._now_ns,
        )


def acknowledgement(
    head: dict[str, Any], lease: Lease, now_ns: int, re: int, refused: WireError | None
) -> Ack:
    """Return the answer to command number `re`; `head` is what every message begins with."""
    reason, detail = ("", "") if refused is None else (refused.reason.value, cut(refused.detail))
    accepted = refused is None
    return Ack(
        **head, **lease.state(now_ns), re=re, accepted=accepted, reason=reason, detail=detail, t_ns=now_ns
    )

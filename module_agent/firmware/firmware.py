"""The firmware of one module: `step` is called once a tick, with the time, a sample and what has arrived.

It is pure: no clock, no socket, no file, no randomness. Each step expires what is stale, reads the inbox,
runs the control law, and publishes feedback rows and status.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from module_agent.control.controller import UNSET, Command, Controller
from module_agent.control.gains import default_gains
from module_agent.control.motion import Motion, check_duration, check_motion, check_setpoint
from module_agent.firmware.admission import Admission
from module_agent.firmware.config import FirmwareConfig, check_config, describe
from module_agent.firmware.feedback import MAX_ROWS_PER_ANSWER, Batch, FeedbackStream
from module_agent.firmware.lease import Lease
from module_agent.firmware.motor_guard import WINDING_LIMIT_C, WINDING_REARM_C, MotorGuard
from module_agent.firmware.state import COMMANDED, TRANSITIONS, Trigger
from module_agent.hardware.hardware import SensorSample
from module_agent.wire.codec import encode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import (
    Ack,
    Ask,
    Feedback,
    GainsCommand,
    HistoryRequest,
    Info,
    LeaseRequest,
    MotionCommand,
    MotionRecord,
    Setpoint,
    State,
    Status,
    Stop,
)
from module_agent.wire.refusal import Refusal, WireError

STATUS_PERIOD_NS = 400_000_000


class Incoming(NamedTuple):
    """Bytes that arrived for a module; `request` names the question to answer, None for a publication."""

    leaf: Leaf
    payload: bytes
    request: int | None


class Publication(NamedTuple):
    """Bytes to publish on one of the module's own keys."""

    leaf: Leaf
    payload: bytes


class Answer(NamedTuple):
    """Bytes that answer the question `request`."""

    request: int
    payload: bytes


Outgoing = Publication | Answer


class Firmware:
    """One module. Times are the module's own nanoseconds, taken from its samples."""

    def __init__(self, config: FirmwareConfig):
        self.config = check_config(config)
        self.lease = Lease()
        self._rows = FeedbackStream(config)
        self.history = self._rows.history
        self.admission = Admission(config.serial, config.boot, config.lifetime_ns)
        self.state: State = "idle"
        self.dropped_events = 0
        self._controller = self._own_controller()
        self._guard = MotorGuard(config)
        self._drives = self._drive_of_state()
        self._motion: Motion | None = None
        self._record: MotionRecord | None = None
        self.last_rest: MotionRecord | None = None
        self._command: Command = UNSET
        self._setpoint: Command = UNSET
        self._fresh_ns = 0
        self._stopped_ns = 0
        self._expiries = 0
        self._seq = 0
        self._now_ns = 0
        self._sample: SensorSample | None = None
        self._status_due_ns = 0
        self._note = ""

    # ------------------------------------------------------------------ the tick

    def step(
        self, now_ns: int, sample: SensorSample, inbox: Sequence[Incoming]
    ) -> tuple[float, list[Outgoing]]:
        """Run one tick; return the PWM for the motor (at 48 V) and what to publish and answer."""
        self._now_ns = now_ns
        self._sample = sample
        out: list[Outgoing] = []
        if self.state in COMMANDED and now_ns - self._fresh_ns > self.config.lifetime_ns:
            self._expire()
        if self.lease.lapsed(now_ns):
            self._end_lease()
        for incoming in inbox:
            self._receive(incoming, out)
        if sample.winding_temperature_c >= WINDING_LIMIT_C and self.state != "fault":
            self._finish_motion("fault")
            self._enter("fault", f"winding at {sample.winding_temperature_c:.0f} C")
        pwm = self._drives[self.state](sample)
        if self._rows.due(now_ns, sample.imu_t_ns):
            self._append_row(sample, pwm, out)
        if now_ns >= self._status_due_ns:
            self._status_due_ns = now_ns + STATUS_PERIOD_NS
            out.append(Publication(Leaf.STATUS, encode(self._status(re=0))))
        return pwm, out

    # ------------------------------------------------------------------ what drives the motor

    def _drive_of_state(self) -> dict[State, Callable[[SensorSample], float]]:
        on_expiry = {"motor_off": self._rest, "hold": self._follow, "damping": self._guard.damping}
        return {
            "idle": self._rest,
            "armed": self._follow,
            "moving": self._follow_motion,
            "streaming": self._follow_setpoint,
            "expired": on_expiry[self.config.expiry_action],
            "stopped": self._guard.damping,
            "fault": self._rest,
        }

    def _rest(self, sample: SensorSample) -> float:
        self._command = UNSET
        return 0.0

    def _follow(self, sample: SensorSample) -> float:
        pwm = self._controller.update(
            self._command, sample.position_rad, sample.velocity_rad_s, sample.effort_nm
        )
        return self._guard.limit(pwm, sample)

    def _follow_setpoint(self, sample: SensorSample) -> float:
        self._command = self._setpoint
        return self._follow(sample)

    def _follow_motion(self, sample: SensorSample) -> float:
        assert self._motion is not None
        command = self._motion.command(self._now_ns)
        if command is None:
            self._finish_motion("done")
            self._enter("motion_done")
        else:
            self._command = command
        return self._follow(sample)

    # ------------------------------------------------------------------ states

    def _enter(self, trigger: Trigger, note: str = "") -> None:
        target = TRANSITIONS.get((self.state, trigger))
        if target is None:
            raise WireError(Refusal.NOT_ARMED, f"{trigger} is not possible while {self.state}: acquire first")
        if target != self.state and target not in COMMANDED:
            self._controller.reset()
        self.state = target
        self._status_due_ns = 0
        self._note = note

    def _own_controller(self) -> Controller:
        gains = default_gains(self.config.kind, self.config.strategy)
        return Controller(self.config.kind, gains, self.config.tick_ns / 1e9)

    def _end_lease(self) -> None:
        """Let go of the holder, and of the gains that it has set: the next one shall not inherit them."""
        self.lease.release()
        self._controller = self._own_controller()
        self._status_due_ns = 0

    def _expire(self) -> None:
        self._expiries += 1
        self._finish_motion("expired")
        self._hold()
        self._enter("expire", f"no fresh command for {self.config.lifetime_ns / 1e6:.0f} ms")

    def _hold(self) -> None:
        assert self._sample is not None
        self._command = Command(self._sample.position_rad, 0.0, None)

    def _finish_motion(self, outcome: str) -> None:
        if self._motion is None or self._record is None:
            return
        self._record = self._record.model_copy(update={"outcome": outcome, "end_row": self.history.next_row})
        if outcome == "done" and self._record.pattern.kind == "rest":
            self.last_rest = self._record
        # A motion that is broken off holds where it was then, not where it would have ended; and the effort
        # that moved it there is not the one that holds it.
        if outcome == "done":
            self._command = Command(self._motion.last_position_rad, 0.0, self._motion.last_effort_nm)
        else:
            self._command = Command(self._command.position_rad, 0.0, None)
        self._motion = None
        self._status_due_ns = 0

    # ------------------------------------------------------------------ inbox

    def _receive(self, incoming: Incoming, out: list[Outgoing]) -> None:
        try:
            answer = self._dispatch(incoming)
        except WireError as error:
            self.admission.count(error.reason)
            answer = encode(self._ack(False, 0, error.reason.value, error.detail))
        if incoming.request is not None:
            out.append(Answer(incoming.request, answer))

    def _dispatch(self, incoming: Incoming) -> bytes:
        message = self.admission.read(incoming.leaf, incoming.payload)
        if isinstance(message, LeaseRequest | MotionCommand | Setpoint | GainsCommand):
            self.admission.check_command(message, self.lease, self._now_ns)
        match message:
            case Ask() if incoming.leaf is Leaf.INFO:
                return encode(self._info())
            case Ask():
                return encode(self._status(message.seq))
            case HistoryRequest():
                return self._answer_history(message)
            case Stop():
                self._finish_motion("stopped")
                self._enter("stop", f"stopped by {message.sender}: {message.why}"[:512])
                self._stopped_ns = self._now_ns
            case LeaseRequest():
                self._act_lease(message)
            case MotionCommand():
                self._start_motion(message)
            case Setpoint():
                self._stream(message)
            case GainsCommand():
                self._set_gains(message)
            case _:
                raise WireError(Refusal.MALFORMED, f"{incoming.leaf.value} is not answered by the firmware")
        return encode(self._ack(True, message.seq))

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
        if self.state == "fault" and self._sample.winding_temperature_c > WINDING_REARM_C:
            raise WireError(
                Refusal.NOT_ARMED,
                f"winding at {self._sample.winding_temperature_c:.0f} C, "
                f"re-arms below {WINDING_REARM_C:.0f} C",
            )
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
        """Count the lifetime from what the sender had seen of this module, not from when its command came:
        a command that was long on the way must not let a motor outlive its commander.
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
        assert self._sample is not None
        held = self._command.position_rad
        origin = held if held is not None else self._sample.position_rad
        check_duration(command.pattern, origin)
        motion = Motion(command.pattern, origin, self._now_ns, self.config.tick_ns, command.effort)
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
        check_setpoint(setpoint, self.config.limits)
        if self.state != "streaming":
            self._enter("setpoint")
        self._setpoint = Command(setpoint.position_rad, setpoint.velocity_rad_s, setpoint.effort_nm)
        self._refresh(setpoint.echo_ns)

    def _set_gains(self, command: GainsCommand) -> None:
        if self.state == "moving":
            raise WireError(Refusal.BUSY, "gains are taken when no motion is running")
        self._controller = Controller(self.config.kind, command.gains, self.config.tick_ns / 1e9)
        self._refresh(command.echo_ns)

    def _answer_history(self, request: HistoryRequest) -> bytes:
        end = min(request.end_row, request.first_row + MAX_ROWS_PER_ANSWER)
        block = self.history.block(request.first_row, end)
        return encode(self._feedback(Batch(request.first_row, end, block)))

    # ------------------------------------------------------------------ what it publishes

    def _append_row(self, sample: SensorSample, pwm: float, out: list[Outgoing]) -> None:
        motion = self._record.motion_id if self._motion is not None and self._record is not None else 0
        batch = self._rows.append(sample, motion, self.state, self._command, pwm)
        if batch is not None:
            out.append(Publication(Leaf.FEEDBACK, encode(self._feedback(batch))))

    def _next_seq(self) -> int:
        self._seq += 1
        return self._seq

    def _feedback(self, batch: Batch) -> Feedback:
        return Feedback(
            serial=self.config.serial,
            boot=self.config.boot,
            seq=self._next_seq(),
            first_row=batch.first_row,
            count=batch.end_row - batch.first_row,
            rows=batch.block,
        )

    def _ack(self, accepted: bool, re: int, reason: str = "", detail: str = "") -> Ack:
        return Ack(
            serial=self.config.serial,
            boot=self.config.boot,
            seq=self._next_seq(),
            re=re,
            accepted=accepted,
            reason=reason,
            detail=detail[:512],
            t_ns=self._now_ns,
            holder=self.lease.holder,
            lease_left_ns=self.lease.left_ns(self._now_ns),
            token=self.lease.token,
        )

    def _status(self, re: int) -> Status:
        return Status(
            serial=self.config.serial,
            boot=self.config.boot,
            seq=self._next_seq(),
            re=re,
            t_ns=self._now_ns,
            state=self.state,
            holder=self.lease.holder,
            lease_left_ns=self.lease.left_ns(self._now_ns),
            token=self.lease.token,
            next_row=self.history.next_row,
            motion=self._record,
            refusals=dict(self.admission.refusals),
            expiries=self._expiries,
            dropped_events=self.dropped_events,
            note=self._note[:512],
        )

    def _info(self) -> Info:
        return describe(self.config, self._controller.gains, self._next_seq(), self._now_ns)

"""The firmware of one module: `step` is called once a tick, with the time, a sample and what has arrived.

It is pure: no clock, no socket, no file, no randomness. Each step expires what is stale, reads the inbox,
runs the control law, and publishes feedback rows and status.
"""

from collections.abc import Sequence
from typing import NamedTuple

from module_agent.firmware.admission import Admission
from module_agent.firmware.config import FIRMWARE_NAME, FirmwareConfig, check_config
from module_agent.firmware.controller import NOMINAL_VOLTAGE_V, UNSET, Command, Controller
from module_agent.firmware.gains import default_gains
from module_agent.firmware.history import MAX_ROWS_PER_ANSWER, History
from module_agent.firmware.lease import Lease
from module_agent.firmware.motion import Motion, check_duration, check_motion, check_speed
from module_agent.firmware.state import COMMANDED, TRANSITIONS, Trigger
from module_agent.hardware import SensorSample
from module_agent.wire.codec import encode
from module_agent.wire.feedback_rows import STATE_NAMES
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
# Above this the manufacturer's PWM ceiling 1 - 1/(155 - T) has fallen to zero.
WINDING_LIMIT_C = 154.0
WINDING_REARM_C = 140.0
DAMPING_LIMIT_PWM = 0.25
_NAN = float("nan")


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
        self.history = History(int(config.history_s * config.feedback_rate_hz))
        self.admission = Admission(config.serial, config.boot, config.lifetime_ns)
        self.state: State = "idle"
        self.dropped_events = 0
        self._controller = self._own_controller()
        self._period_ns = round(1e9 / config.feedback_rate_hz)
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
        self._row_due_ns = 0
        self._last_imu_ns = -1
        self._sent_row = 0
        self._status_ns = -STATUS_PERIOD_NS
        self._status_due = True
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
        pwm = self._drive(sample)
        self._append_row(sample, pwm, out)
        if self._status_due or now_ns - self._status_ns >= STATUS_PERIOD_NS:
            self._status_due, self._status_ns = False, now_ns
            out.append(Publication(Leaf.STATUS, encode(self._status(re=0))))
        return pwm, out

    def _drive(self, sample: SensorSample) -> float:
        state = self.state
        action = self.config.expiry_action if state == "expired" else None
        if state == "stopped" or action == "damping":
            return self._limit(self._damping(sample), sample)
        if state == "idle" or state == "fault" or action == "motor_off":
            self._command = UNSET
            return 0.0
        if state == "moving":
            self._command = self._follow_motion()
        elif state == "streaming":
            self._command = self._setpoint
        pwm = self._controller.update(
            self._command, sample.position_rad, sample.velocity_rad_s, sample.effort_nm
        )
        return self._limit(pwm, sample)

    def _follow_motion(self) -> Command:
        motion = self._motion
        assert motion is not None
        command = motion.command(self._now_ns)
        if command is None:
            self._finish_motion("done")
            self._enter("motion_done")
            return self._command
        return command

    def _damping(self, sample: SensorSample) -> float:
        # By the motor's speed and not the output's, which follows through a spring: fed back, that is driven
        # into an oscillation (25 Hz and 2.6 rad/s on an X5-9 with an arm of 0.5 kg).
        kind = self.config.kind
        pwm = -sample.motor_velocity_rad_s / (kind.gear_ratio * kind.max_speed_rad_s)
        return min(max(pwm, -DAMPING_LIMIT_PWM), DAMPING_LIMIT_PWM)

    def _limit(self, pwm: float, sample: SensorSample) -> float:
        """Keep the duty below the winding's ceiling 1 - 1/(155 - T), and never drive out of the range."""
        low, high = self.config.limits.min_position_rad, self.config.limits.max_position_rad
        if (high is not None and sample.position_rad > high and pwm > 0.0) or (
            low is not None and sample.position_rad < low and pwm < 0.0
        ):
            return 0.0
        ceiling = max(0.0, 1.0 - 1.0 / max(155.0 - sample.winding_temperature_c, 1.0))
        most = ceiling * sample.voltage_v / NOMINAL_VOLTAGE_V
        return min(max(pwm, -most), most)

    # ------------------------------------------------------------------ states

    def _enter(self, trigger: Trigger, note: str = "") -> None:
        target = TRANSITIONS.get((self.state, trigger))
        if target is None:
            raise WireError(Refusal.NOT_ARMED, f"{trigger} is not possible while {self.state}: acquire first")
        if target != self.state and target not in COMMANDED:
            self._controller.reset()
        self.state = target
        self._status_due = True
        self._note = note

    def _own_controller(self) -> Controller:
        gains = default_gains(self.config.kind, self.config.strategy)
        return Controller(self.config.kind, gains, self.config.tick_ns / 1e9)

    def _end_lease(self) -> None:
        """Let go of the holder, and of the gains that it has set: the next one shall not inherit them."""
        self.lease.release()
        self._controller = self._own_controller()
        self._status_due = True

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
        # A motion that is broken off holds where it was then, not where it would have ended.
        end = self._motion.last_position_rad if outcome == "done" else self._command.position_rad
        self._command = Command(end, 0.0, None)
        self._motion = None
        self._status_due = True

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
        leaf, payload, read = incoming.leaf, incoming.payload, self.admission.read
        match leaf:
            case Leaf.INFO:
                return encode(self._info(read(Ask, payload, any_boot=True)))
            case Leaf.STATUS:
                return encode(self._status(read(Ask, payload, any_boot=True).seq))
            case Leaf.HISTORY:
                return self._answer_history(read(HistoryRequest, payload))
            case Leaf.STOP:
                stop = read(Stop, payload, any_boot=True)
                self._finish_motion("stopped")
                self._enter("stop", f"stopped by {stop.sender}: {stop.why}"[:512])
                self._stopped_ns = self._now_ns
                return encode(self._ack(True, stop.seq))
            case Leaf.LEASE:
                request = read(LeaseRequest, payload, any_boot=False)
                self.admission.check_command(request, self.lease, self._now_ns)
                self._act_lease(request)
                return encode(self._ack(True, request.seq))
            case Leaf.MOTION:
                motion = read(MotionCommand, payload)
                self.admission.check_command(motion, self.lease, self._now_ns)
                self._start_motion(motion)
                return encode(self._ack(True, motion.seq))
            case Leaf.SETPOINT:
                setpoint = read(Setpoint, payload)
                self.admission.check_command(setpoint, self.lease, self._now_ns)
                self._stream(setpoint)
                return encode(self._ack(True, setpoint.seq))
            case Leaf.GAINS:
                gains = read(GainsCommand, payload)
                self.admission.check_command(gains, self.lease, self._now_ns)
                self._set_gains(gains)
                return encode(self._ack(True, gains.seq))
            case _:
                raise WireError(Refusal.MALFORMED, f"{leaf.value} takes no message")

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
        motion = Motion(command.pattern, origin, self._now_ns, self.config.tick_ns)
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
        limits = self.config.limits
        check_speed(abs(setpoint.velocity_rad_s or 0.0), limits)
        position = setpoint.position_rad
        if position is not None and (
            (limits.min_position_rad is not None and position < limits.min_position_rad)
            or (limits.max_position_rad is not None and position > limits.max_position_rad)
        ):
            raise WireError(
                Refusal.LIMIT,
                f"position {position:.3f} rad is outside "
                f"{limits.min_position_rad} .. {limits.max_position_rad} rad",
            )
        if self.state != "streaming":
            self._enter("setpoint")
        self._setpoint = Command(position, setpoint.velocity_rad_s, setpoint.effort_nm)
        self._refresh(setpoint.echo_ns)

    def _set_gains(self, command: GainsCommand) -> None:
        if self.state == "moving":
            raise WireError(Refusal.BUSY, "gains are taken when no motion is running")
        self._controller = Controller(self.config.kind, command.gains, self.config.tick_ns / 1e9)
        self._refresh(command.echo_ns)

    def _answer_history(self, request: HistoryRequest) -> bytes:
        end = min(request.end_row, request.first_row + MAX_ROWS_PER_ANSWER)
        rows = self.history.rows(request.first_row, end)
        return encode(self._feedback(request.first_row, len(rows), rows.tobytes()))

    # ------------------------------------------------------------------ what it publishes

    def _append_row(self, sample: SensorSample, pwm: float, out: list[Outgoing]) -> None:
        now_ns, half_tick = self._now_ns, self.config.tick_ns // 2
        new_imu = sample.imu_t_ns != self._last_imu_ns
        self._last_imu_ns = sample.imu_t_ns
        if now_ns < self._row_due_ns - half_tick:
            return
        # Rows no faster than the IMU wait for its next sample, so that every row holds a new one.
        slow = self._period_ns >= self.config.imu_period_ns
        if slow and not new_imu and now_ns < self._row_due_ns + self.config.imu_period_ns:
            return
        self._row_due_ns = max(self._row_due_ns, now_ns - half_tick) + self._period_ns
        if slow and new_imu:
            self._row_due_ns = now_ns + self._period_ns
        self.history.append(self._row(sample, pwm))
        if self.history.next_row - self._sent_row >= self.config.batch_rows:
            first, end = self._sent_row, self.history.next_row
            self._sent_row = end
            block = self.history.rows(first, end).tobytes()
            out.append(Publication(Leaf.FEEDBACK, encode(self._feedback(first, end - first, block))))

    def _row(self, sample: SensorSample, pwm: float) -> tuple[object, ...]:
        position, velocity, effort = self._command
        motion = self._record.motion_id if self._motion is not None and self._record is not None else 0
        return (
            sample.t_ns,
            sample.imu_t_ns,
            motion,
            STATE_NAMES.index(self.state),
            sample.position_rad,
            sample.velocity_rad_s,
            sample.effort_nm,
            _NAN if position is None else position,
            _NAN if velocity is None else velocity,
            _NAN if effort is None else effort,
            min(max(pwm * NOMINAL_VOLTAGE_V / sample.voltage_v, -1.0), 1.0) if sample.voltage_v else 0.0,
            sample.deflection_rad,
            sample.motor_velocity_rad_s,
            sample.motor_current_a,
            sample.winding_temperature_c,
            sample.voltage_v,
            sample[10:13],
            sample[13:16],
        )

    def _next_seq(self) -> int:
        self._seq += 1
        return self._seq

    def _feedback(self, first: int, count: int, rows: bytes) -> Feedback:
        # Built from trusted values: validation would only cost time here.
        return Feedback.model_construct(
            v=1,
            serial=self.config.serial,
            boot=self.config.boot,
            seq=self._next_seq(),
            first_row=first,
            count=count,
            rows=rows,
        )

    def _ack(self, accepted: bool, re: int, reason: str = "", detail: str = "") -> Ack:
        return Ack.model_construct(
            v=1,
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

    def _info(self, ask: Ask) -> Info:
        config = self.config
        return Info(
            serial=config.serial,
            boot=config.boot,
            seq=self._next_seq(),
            module_type=config.kind.name,
            firmware=FIRMWARE_NAME,
            feedback_rate_hz=config.feedback_rate_hz,
            batch_rows=config.batch_rows,
            history_rows=self.history.capacity,
            tick_ns=config.tick_ns,
            imu_period_ns=config.imu_period_ns,
            lifetime_ns=config.lifetime_ns,
            expiry_action=config.expiry_action,
            limits=config.limits,
            gains=self._controller.gains,
            t_ns=self._now_ns,
        )

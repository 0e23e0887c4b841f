"""The firmware of one module under command: a lease held, gains set and motions started, with no network.

All messages go through the firmware's inbox, encoded, as they would come from a network.
"""

from collections.abc import Sequence
from typing import Any

from module_agent.control.controller import Command
from module_agent.firmware.firmware import Answer, Firmware, Incoming, Outgoing, Publication
from module_agent.hardware.hardware import ModuleSample
from module_agent.model.errors import RobotError
from module_agent.wire.codec import decode, encode
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import (
    Ack,
    EffortProfile,
    GainsCommand,
    GainSet,
    LeaseRequest,
    MotionCommand,
    MotionRecord,
    Pattern,
    Setpoint,
    Status,
)

SENDER = "experiment"
# As often as the coordinator does; a lease without it lapses.
KEEP_ALIVE_NS = 60_000_000
_ASKED = 1


class ExperimentFailed(RobotError):
    """A module refused a command or interrupted a motion; the message names the module and the reason."""


class ModuleBench:
    """A module under command from its first tick to its last."""

    def __init__(self, firmware: Firmware, keep_alive_ns: int = KEEP_ALIVE_NS):
        self.firmware = firmware
        self.serial = firmware.config.serial
        self.now_ns = 0
        self._keep_alive_ns = keep_alive_ns
        self.published_rows = False
        self.winding_c = 0.0
        self._record: MotionRecord | None = None
        self._waiting: list[Incoming] = []
        self._motions = 0
        self._seq = 0
        self._renewed_ns: int | None = None

    def step(self, sample: ModuleSample, arrived: Sequence[Incoming] = ()) -> Command:
        """Begin one tick of the firmware and return its command; `arrived` has come from elsewhere."""
        self.now_ns, self.winding_c = sample.sensors.t_ns, sample.sensors.winding_temperature_c
        self._keep_alive()
        waiting, self._waiting = self._waiting, []
        return self.firmware.step(sample, [*waiting, *arrived])

    @property
    def has_mail(self) -> bool:
        """Whether something waits for the next tick."""
        return bool(self._waiting)

    def publish(self, pwm: float) -> list[Outgoing]:
        """End the tick with the module's PWM; return what it sends.

        `published_rows` says afterwards whether feedback went out.

        Raises:
            ExperimentFailed: the module refused a command that was sent since the last tick.
        """
        out = self.firmware.publish(pwm)
        self.published_rows = any(isinstance(one, Publication) and one.leaf is Leaf.FEEDBACK for one in out)
        for outgoing in out:
            self._note(outgoing)
        return out

    def start(self, pattern: Pattern, effort: EffortProfile | None = None) -> None:
        """Start a motion in the next tick, with feed-forward efforts if given."""
        self._motions += 1
        command = MotionCommand(**self._head(), motion_id=self._motions, pattern=pattern, effort=effort)
        self._record = None
        self._waiting.append(Incoming(Leaf.MOTION, encode(command), _ASKED))

    def set_gains(self, gains: GainSet) -> None:
        """Replace the gains in the next tick."""
        self._waiting.append(Incoming(Leaf.GAINS, encode(GainsCommand(**self._head(), gains=gains)), _ASKED))

    def setpoint(
        self, position_rad: float | None, velocity_rad_s: float | None, effort_nm: float | None, echo_ns: int
    ) -> Incoming:
        """Return a set-point to hand to `step` when it arrives; `echo_ns` is the feedback its sender has."""
        message = Setpoint(
            **self._head() | {"echo_ns": echo_ns},
            position_rad=position_rad,
            velocity_rad_s=velocity_rad_s,
            effort_nm=effort_nm,
        )
        return Incoming(Leaf.SETPOINT, encode(message), None)

    def finished(self) -> MotionRecord | None:
        """Return the record of the last motion that was started, None while it runs.

        Raises:
            ExperimentFailed: the motion was interrupted.
        """
        record = self._record
        if record is None or record.outcome == "running":
            return None
        if record.outcome != "done":
            raise ExperimentFailed(f"a motion of module {self.serial} was interrupted: {record.outcome}")
        return record

    def rows(self, first: int, end: int) -> Rows:
        """Return feedback rows."""
        return self.firmware.history.rows(first, end)

    def _keep_alive(self) -> None:
        first = self._renewed_ns is None
        if self._renewed_ns is None or self.now_ns - self._renewed_ns >= self._keep_alive_ns:
            lease = LeaseRequest(**self._head(), action="acquire" if first else "renew")
            self._waiting.append(Incoming(Leaf.LEASE, encode(lease), _ASKED if first else None))
            self._renewed_ns = self.now_ns

    def _head(self) -> dict[str, Any]:
        """Return the fields that every command has."""
        self._seq += 1
        return {
            "serial": self.serial,
            "boot": self.firmware.config.boot,
            "seq": self._seq,
            "sender": SENDER,
            "token": self.firmware.lease.token,
            "echo_ns": self.now_ns,
        }

    def _note(self, outgoing: Outgoing) -> None:
        if isinstance(outgoing, Answer):
            ack = decode(Ack, outgoing.payload)
            if not ack.accepted:
                raise ExperimentFailed(f"module {self.serial} refused: {ack.reason}: {ack.detail}")
        elif outgoing.leaf is Leaf.STATUS:
            record = decode(Status, outgoing.payload).motion
            if record is not None and record.motion_id == self._motions:
                self._record = record

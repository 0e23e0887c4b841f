"""One module's firmware and who commands it: a lease held and motions started, with no network in between.

All that is sent goes through the firmware's inbox, encoded, as it would come from a network.
"""

from typing import Literal

from module_agent.firmware.firmware import Answer, Firmware, Incoming, Outgoing
from module_agent.hardware import SensorSample
from module_agent.wire.codec import decode, encode
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Ack, LeaseRequest, MotionCommand, MotionRecord, Pattern, Status

SENDER = "experiment"
# As often as the coordinator does; a lease without it lapses.
_KEEP_ALIVE_NS = 60_000_000
_ASKED = 1


class ExperimentFailed(RuntimeError):
    """A module refused a command or broke a motion off; the message says which module, and why."""


class ModuleBench:
    """A module under command from its first tick to its last."""

    def __init__(self, firmware: Firmware):
        self.firmware = firmware
        self.serial = firmware.config.serial
        self.now_ns = 0
        self._record: MotionRecord | None = None
        self._waiting: list[Incoming] = []
        self._motions = 0
        self._seq = 0
        self._renewed_ns: int | None = None

    def step(self, sample: SensorSample) -> float:
        """Run one tick of the firmware and return its PWM.

        Raises:
            ExperimentFailed: the module refused what it was told since the last tick.
        """
        self.now_ns = sample.t_ns
        self._keep_alive()
        waiting, self._waiting = self._waiting, []
        pwm, out = self.firmware.step(sample.t_ns, sample, waiting)
        for outgoing in out:
            self._hear(outgoing)
        return pwm

    def start(self, pattern: Pattern) -> None:
        """Start a motion in the next tick."""
        self._motions += 1
        self._seq += 1
        command = MotionCommand(
            serial=self.serial,
            boot=self.firmware.config.boot,
            seq=self._seq,
            sender=SENDER,
            token=self.firmware.lease.token,
            echo_ns=self.now_ns,
            motion_id=self._motions,
            pattern=pattern,
        )
        self._record = None
        self._waiting.append(Incoming(Leaf.MOTION, encode(command), _ASKED))

    def finished(self) -> MotionRecord | None:
        """Return the record of the last motion that was started, None while it runs.

        Raises:
            ExperimentFailed: the motion was broken off.
        """
        record = self._record
        if record is None or record.outcome == "running":
            return None
        if record.outcome != "done":
            raise ExperimentFailed(f"a motion of module {self.serial} was broken off: {record.outcome}")
        return record

    def rows(self, first: int, end: int) -> Rows:
        """Return feedback rows."""
        return self.firmware.history.rows(first, end)

    def _keep_alive(self) -> None:
        if self._renewed_ns is None:
            self._send_lease("acquire", _ASKED)
        elif self.now_ns - self._renewed_ns >= _KEEP_ALIVE_NS:
            self._send_lease("renew", None)

    def _send_lease(self, action: Literal["acquire", "renew"], request: int | None) -> None:
        self._seq += 1
        lease = LeaseRequest(
            serial=self.serial,
            boot=self.firmware.config.boot,
            seq=self._seq,
            sender=SENDER,
            action=action,
            token=self.firmware.lease.token,
            echo_ns=self.now_ns,
        )
        self._waiting.append(Incoming(Leaf.LEASE, encode(lease), request))
        self._renewed_ns = self.now_ns

    def _hear(self, outgoing: Outgoing) -> None:
        if isinstance(outgoing, Answer):
            ack = decode(Ack, outgoing.payload)
            if not ack.accepted:
                raise ExperimentFailed(f"module {self.serial} refused: {ack.reason}: {ack.detail}")
        elif outgoing.leaf is Leaf.STATUS:
            record = decode(Status, outgoing.payload).motion
            if record is not None and record.motion_id == self._motions:
                self._record = record

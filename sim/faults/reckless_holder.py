"""A program that holds a module's lease by right, and drives its motor as no program should.

It has the coordinator's name and secret, as a coordinator with a defect would, and commands a joint that runs
no motion: full PWM, a swing at twice the speed of the type, or position control at the ends of the range with
gains a hundred times the factory's. None of that is refused: the module's limits keep the joint in its range.
After a stop, and where the coordinator has gone, it acquires the lease again.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

from coordinator.live_robot.messenger import Sender
from module_agent.control.gains import default_gains
from module_agent.model.catalogue import ModuleType
from module_agent.transport.transport import Event, Sample, Transport
from module_agent.wire.codec import MAX_MESSAGE_BYTES, decode, encode
from module_agent.wire.feedback_rows import unpack
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import (
    Feedback,
    GainsCommand,
    GainSet,
    LeaseRequest,
    Message,
    Setpoint,
    Status,
)
from module_agent.wire.proof import proven, secret_for
from module_agent.wire.refusal import WireError

# The coordinator has numbered less: a copy of its commands and these are told apart.
_FIRST_SEQ = 1_000_000
GAIN_FACTOR, MAX_KP, SPEED_FACTOR = 100.0, 1000.0, 2.0
# Gains are sent with every fifth set-point: loops that get new ones begin anew.
_STRIKES_A_SETTING = 5
_LEASE_NS = 1_000_000_000


class Target(NamedTuple):
    """The module that is commanded: its robot, serial, type, and the limits of its position [rad]."""

    robot: str
    serial: str
    kind: ModuleType
    range_rad: tuple[float, float]


class RecklessHolder:
    """Commands one module recklessly, and turns it one way; `size` in [0, 1) says how and which way.

    period_s: how often it is to strike.
    """

    period_s = 0.01

    def __init__(self, transport: Transport, target: Target, sender: Sender, size: float):
        self._transport = transport
        self._target = target
        self._sender = sender
        self._secret = secret_for(target.serial, sender.secret)
        manner, part = divmod(size * len(MANNERS), 1.0)
        self._manner = MANNERS[int(manner)]
        self._turn = 1.0 if part < 0.5 else -1.0
        self._status: Status | None = None
        self._newest_ns = -1
        self._seq = _FIRST_SEQ
        transport.subscribe(key(target.robot, target.serial, Leaf.STATUS), self._hear_status)
        transport.subscribe(key(target.robot, target.serial, Leaf.FEEDBACK), self._hear_feedback)

    def strike(self) -> None:
        """Send the gains and the set-point of one moment, once the module has been heard."""
        if self._status is not None and self._newest_ns >= 0:
            if self._status.state not in ("armed", "moving", "streaming"):
                self._acquire(self._status)
            self._manner(self, self._turn)

    def close(self) -> None:
        """Leave the network."""
        self._transport.close()

    def _hear_status(self, event: Event) -> None:
        if isinstance(event, Sample):
            with suppress(WireError):
                self._status = decode(Status, event.payload, MAX_MESSAGE_BYTES)

    def _hear_feedback(self, event: Event) -> None:
        if isinstance(event, Sample):
            with suppress(WireError):
                rows = unpack(decode(Feedback, event.payload, MAX_MESSAGE_BYTES))
                self._newest_ns = max([self._newest_ns, *rows["t_ns"].tolist()])

    def full_pwm(self, turn: float) -> None:
        """Drive the motor by its whole voltage."""
        self._command(default_gains(self._target.kind, 1), None, None, turn)

    def swing(self, turn: float) -> None:
        """Ask for twice the speed of the type."""
        speed = SPEED_FACTOR * self._target.kind.max_speed_rad_s
        self._command(default_gains(self._target.kind, 3), None, turn * speed, None)

    def stiff(self, turn: float) -> None:
        """Control the position at an end of the range with gains that make any joint unstable."""
        own = default_gains(self._target.kind, 3)
        position = own.position.model_copy(update={"kp": min(GAIN_FACTOR * own.position.kp, MAX_KP)})
        low, high = self._target.range_rad
        self._command(own.model_copy(update={"position": position}), high if turn > 0.0 else low, None, None)

    def _acquire(self, status: Status) -> None:
        request = LeaseRequest(
            serial=self._target.serial,
            boot=status.boot,
            seq=self._seq,
            sender=self._sender.name,
            token=status.token,
            echo_ns=self._newest_ns,
            action="acquire",
            duration_ns=_LEASE_NS,
            secret=self._secret,
        )
        at = key(self._target.robot, self._target.serial, Leaf.LEASE)
        self._transport.query(at, encode(request), 0.5, lambda event: None, self._seq)

    def _command(
        self,
        gains: GainSet,
        position_rad: float | None,
        velocity_rad_s: float | None,
        effort_nm: float | None,
    ) -> None:
        status, target = self._status, self._target
        assert status is not None
        head: dict[str, Any] = {
            "serial": target.serial,
            "boot": status.boot,
            "sender": self._sender.name,
            "token": status.token,
            "echo_ns": self._newest_ns,
        }
        if self._seq % _STRIKES_A_SETTING == 0:
            setting = GainsCommand(**head, seq=self._seq, gains=gains)
            at = key(target.robot, target.serial, Leaf.GAINS)
            self._transport.query(at, self._proven(setting), 0.5, lambda event: None, self._seq)
        aims: dict[str, Any] = {
            "position_rad": position_rad,
            "velocity_rad_s": velocity_rad_s,
            "effort_nm": effort_nm,
        }
        point = Setpoint(**head, seq=self._seq, **aims)
        self._transport.publish(key(target.robot, target.serial, Leaf.SETPOINT), self._proven(point))
        self._seq += 1

    def _proven(self, command: Message) -> bytes:
        return proven(encode(command), self._secret)


MANNERS: tuple[Callable[[RecklessHolder, float], None], ...] = (
    RecklessHolder.full_pwm,
    RecklessHolder.swing,
    RecklessHolder.stiff,
)

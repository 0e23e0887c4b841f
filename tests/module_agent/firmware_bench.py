"""A firmware on a bench: its sensors and its clock are what the test says."""

from typing import Any

from module_agent.control.gains import catalogue_limits
from module_agent.control.safety import UNCONFIGURED
from module_agent.firmware.config import FirmwareConfig
from module_agent.firmware.firmware import Answer, Incoming, Publication
from module_agent.hardware.hardware import SensorSample
from module_agent.model.catalogue import CATALOGUE
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import (
    Ack,
    Ask,
    GainSet,
    LeaseRequest,
    Message,
    MotionCommand,
    Setpoint,
    Status,
    WindowedSine,
)
from module_agent.wire.refusal import Refusal
from tests.module_agent.wired_firmware import WiredFirmware

MS = 1_000_000
BOOT = 77


class Bench:
    """One module on a bench: its position is what the test sets, its clock what the test lets pass."""

    def __init__(self, kind: str = "X5-9", **settings: Any) -> None:
        module = CATALOGUE[kind]  # type: ignore[index]
        limits = settings.get("safety", UNCONFIGURED).tightened(catalogue_limits(module))
        self._wired = WiredFirmware(FirmwareConfig("A", module, BOOT, limits, **settings))
        self.firmware = self._wired.firmware
        self.m_stop = False
        self.now = 5_000 * MS
        self.position = 0.2
        self.winding_c = 40.0
        self.pwm = 0.0
        # What sensors read instead of what they should.
        self.wrong: dict[str, float] = {}
        self.seq = 0
        self.published: list[Publication] = []
        self.tick()

    def tick(self, *incoming: Incoming) -> list[bytes]:
        self.now += MS
        imu = self.now // (4 * MS) * 4 * MS
        sample = SensorSample(
            self.now, imu, self.position, 0.0, 0.5, 0.0, 0.0, 0.1, self.winding_c, 24.0, 0, 0, 0, 0, 0, 9.8
        )
        sample = sample._replace(**self.wrong)  # type: ignore[arg-type]
        self.pwm, out = self._wired.tick(sample, incoming, self.m_stop)
        self.published += [o for o in out if isinstance(o, Publication)]
        return [o.payload for o in out if isinstance(o, Answer)]

    @property
    def identified(self) -> tuple[str, ...]:
        return self._wired.modules.identified

    @property
    def gains(self) -> GainSet:
        return self._wired.modules.information[0].gains

    def ticks(self, count: int) -> None:
        for _ in range(count):
            self.tick()

    def head(self, **changes: Any) -> dict[str, Any]:
        self.seq += 1
        head = {
            "serial": "A",
            "boot": BOOT,
            "seq": self.seq,
            "sender": "me",
            "token": self.firmware.lease.token,
            "echo_ns": self.now,
        }
        return {**head, **changes}

    def ask(self, leaf: Leaf, message: Message | bytes) -> Ack:
        payload = message if isinstance(message, bytes) else encode(message)
        (answer,) = self.tick(Incoming(leaf, payload, 1))
        return decode(Ack, answer)

    def acquire(self, **changes: Any) -> Ack:
        return self.ask(Leaf.LEASE, LeaseRequest(**self.head(action="acquire", **changes)))

    def renew(self, **changes: Any) -> Ack:
        return self.ask(Leaf.LEASE, LeaseRequest(**self.head(action="renew", **changes)))

    def move(self, number: int = 1, pattern: Any = None, **changes: Any) -> Ack:
        pattern = pattern or WindowedSine(amplitude=0.1)
        return self.ask(Leaf.MOTION, MotionCommand(**self.head(motion_id=number, pattern=pattern, **changes)))

    def setpoint(self, position: float | None = 0.3, **changes: Any) -> Ack:
        values = {"position_rad": position, "velocity_rad_s": None, "effort_nm": None}
        return self.ask(Leaf.SETPOINT, Setpoint(**self.head(**{**values, **changes})))

    def status(self) -> Status:
        payload = encode(Ask(serial="A", boot=0, seq=9, sender="me"))
        (answer,) = self.tick(Incoming(Leaf.STATUS, payload, 1))
        return decode(Status, answer)


def refused(ack: Ack, reason: Refusal) -> bool:
    return not ack.accepted and ack.reason == reason.value

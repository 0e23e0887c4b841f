"""The frames of the physics bus: what goes over the Unix SEQPACKET socket between an agent and the world.

One packet is one frame, little-endian:

=========  =================  =====================================================================
frame      direction          contents
=========  =================  =====================================================================
hello      agent to world     msgpack {"v": 2, "serials": [...]}
welcome    world to agent     msgpack {"v": 2, "tick": n, "modules": [[serial, type, tick_ns,
                              imu_period_ns], ...]}, or {"v": 2, "error": text} and the socket closes
pwm        agent to world     u64 tick number, one f64 per module: the answer to that tick
samples    world to agent     u64 tick number, per module 2 i64 and 15 f64 in the order of
                              `SensorSample`
=========  =================  =====================================================================

Each side waits for the other: a welcome or samples frame is answered by one pwm frame with its tick number.
"""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgpack

from module_agent.hardware.hardware import Readings, SensorSample, WiredModule
from module_agent.model.errors import RobotError

BUS_VERSION = 2
MAX_HANDSHAKE_BYTES = 64 * 1024
_TICK = struct.Struct("<Q")
SAMPLE_BYTES = 8 * len(SensorSample._fields)


class FrameError(RobotError):
    """A packet that is not the frame that is due."""


class TickFrames(NamedTuple):
    """The layouts of both tick frames for an agent with a given number of modules."""

    samples_bytes: int
    pwm: struct.Struct

    @classmethod
    def of(cls, modules: int) -> "TickFrames":
        """Return the layouts for `modules` modules."""
        return cls(_TICK.size + modules * SAMPLE_BYTES, struct.Struct(f"<Q{modules}d"))

    def pack_samples(self, tick: int, readings: Readings, slots: Sequence[int]) -> bytes:
        """Return the samples frame of a tick, with the readings of the modules in these slots."""
        size = SAMPLE_BYTES
        parts = (readings.block[slot * size : (slot + 1) * size] for slot in slots)
        return b"".join((_TICK.pack(tick), *parts))

    def unpack_samples(self, frame: bytes, readings: Readings) -> int:
        """Write the samples of a frame into `readings`; return its tick number.

        Raises:
            FrameError: the frame has another length.
        """
        if len(frame) != self.samples_bytes:
            raise FrameError(f"a samples frame has {self.samples_bytes} bytes, this one {len(frame)}")
        readings.block[:] = frame[_TICK.size :]
        (tick,) = _TICK.unpack_from(frame)
        return int(tick)

    def pack_pwm(self, tick: int, pwm: Sequence[float]) -> bytes:
        """Return the pwm frame that answers a tick."""
        return self.pwm.pack(tick, *pwm)

    def unpack_pwm(self, frame: bytes) -> tuple[int, tuple[float, ...]]:
        """Return the tick number that is answered and one PWM per module.

        Raises:
            FrameError: the frame has another length, or a PWM is outside [-1, 1] or no number.
        """
        if len(frame) != self.pwm.size:
            raise FrameError(f"a pwm frame has {self.pwm.size} bytes, this one {len(frame)}")
        values = self.pwm.unpack(frame)
        for pwm in values[1:]:
            if not -1.0 <= pwm <= 1.0:
                raise FrameError(f"a PWM is within [-1, 1], this one is {pwm}")
        return values[0], values[1:]


class Welcome(NamedTuple):
    """The world's answer to a hello: the tick number to answer first, and the modules in the order asked."""

    tick: int
    modules: tuple[WiredModule, ...]


def pack_hello(serials: Sequence[str]) -> bytes:
    """Return the hello of an agent that hosts these modules."""
    return _pack({"v": BUS_VERSION, "serials": list(serials)})


def unpack_hello(frame: bytes) -> tuple[str, ...]:
    """Return the serials that an agent asks for.

    Raises:
        FrameError: not a hello of this version, or no, doubled or malformed serials.
    """
    serials = _unpack(frame, "hello").get("serials")
    if not isinstance(serials, list) or not all(isinstance(s, str) for s in serials) or not serials:
        raise FrameError("a hello names at least one serial")
    if len(set(serials)) != len(serials):
        raise FrameError(f"a serial is named twice in {', '.join(serials)}")
    return tuple(serials)


def pack_welcome(welcome: Welcome) -> bytes:
    """Return the frame of a welcome."""
    return _pack({"v": BUS_VERSION, "tick": welcome.tick, "modules": [list(m) for m in welcome.modules]})


def pack_refusal(why: str) -> bytes:
    """Return the frame that tells an agent why it is not welcome."""
    return _pack({"v": BUS_VERSION, "error": why})


def unpack_welcome(frame: bytes) -> Welcome | str:
    """Return the welcome, or the reason of a refusal.

    Raises:
        FrameError: not a welcome of this version.
    """
    value = _unpack(frame, "welcome")
    error = value.get("error")
    if isinstance(error, str):
        return error
    try:
        modules = tuple(WiredModule(str(s), str(t), int(a), int(b)) for s, t, a, b in value["modules"])
        return Welcome(int(value["tick"]), modules)
    except (KeyError, TypeError, ValueError) as broken:
        raise FrameError(f"not a welcome: {broken!r}") from broken


def _pack(value: dict[str, Any]) -> bytes:
    return bytes(msgpack.packb(value))


def _unpack(frame: bytes, what: str) -> dict[str, Any]:
    try:
        value = msgpack.unpackb(frame)
    except (ValueError, msgpack.UnpackException) as error:
        raise FrameError(f"not a {what}: {error or type(error).__name__}") from error
    if not isinstance(value, dict):
        raise FrameError(f"not a {what}: a msgpack map is due, this is {type(value).__name__}")
    if value.get("v") != BUS_VERSION:
        raise FrameError(f"the other side speaks bus v{value.get('v')}, v{BUS_VERSION} is spoken here")
    return value

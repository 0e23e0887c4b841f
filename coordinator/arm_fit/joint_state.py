"""Recordings of ROS: `sensor_msgs/JointState` in MCAP files, as CDR of ROS 2 or as JSON."""

import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Message

from module_agent.model.errors import UsageError

_SCHEMAS = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
_NS = 1e-9
_Message = tuple[float, list[str], list[float], list[float], list[float]]


class JointState(NamedTuple):
    """One message: time [s], and by joint position, velocity and effort, empty where they are not given."""

    t_s: float
    position: dict[str, float]
    velocity: dict[str, float]
    effort: dict[str, float]


def joint_states(path: Path) -> Iterator[JointState]:
    """Yield the messages of all topics of JointState in the order of the file.

    Raises:
        UsageError: no MCAP, or messages that are neither CDR nor JSON.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        try:
            for schema, channel, message in make_reader(file).iter_messages():
                if schema is None or schema.name not in _SCHEMAS:
                    continue
                if channel.message_encoding not in _DECODERS:
                    raise UsageError(
                        f"topic {channel.topic} is encoded as {channel.message_encoding!r}; "
                        f"{' and '.join(_DECODERS)} are read"
                    )
                stamp, *values = _decoded(channel.topic, channel.message_encoding, message)
                yield JointState(stamp or message.log_time * _NS, *values)
        except McapError as error:
            raise UsageError(f"not an MCAP file: {error}") from error


def _decoded(
    topic: str, encoding: str, message: Message
) -> tuple[float, dict[str, float], dict[str, float], dict[str, float]]:
    """Return time [s], position, velocity and effort by joint of one message.

    Raises:
        UsageError: it is damaged, or no JointState.
    """
    try:
        stamp, names, *signals = _DECODERS[encoding](message.data)
        position, velocity, effort = (
            # JSON has no NaN: encoders write null.
            {
                name: np.nan if value is None else float(value)
                for name, value in zip(names, signal, strict=False)
            }
            for signal in signals
        )
        return float(stamp), position, velocity, effort
    except (ValueError, TypeError, AttributeError, ArithmeticError, LookupError, struct.error) as error:
        at_s = _NS * message.log_time
        raise UsageError(
            f"topic {topic}: the message of {at_s:.3f} s is damaged, or no JointState as {encoding}: {error}"
        ) from error


def _json(data: bytes) -> _Message:
    message = json.loads(data)
    stamp = message.get("header", {}).get("stamp", {})
    name, position, velocity, effort = (
        message.get(key, []) for key in ("name", "position", "velocity", "effort")
    )
    nanoseconds = stamp.get("nanosec", stamp.get("nsec", 0))
    return stamp.get("sec", 0) + _NS * nanoseconds, name, position, velocity, effort


def _cdr(data: bytes) -> _Message:
    """Decode Common Data Representation: four bytes of header, numbers aligned to their size behind it."""
    order, body, at = "<" if data[1] & 1 else ">", data[4:], 0
    integer = struct.Struct(order + "I")

    def number() -> int:
        nonlocal at
        at = -(-at // 4) * 4 + 4
        return int(integer.unpack_from(body, at - 4)[0])

    def text() -> str:
        nonlocal at
        size = number()
        at += size
        return body[at - size : at - 1].decode()

    def numbers() -> list[float]:
        nonlocal at
        count = number()
        if count:
            at = -(-at // 8) * 8 + 8 * count
        start = at - 8 * count
        return [float(value) for value in np.frombuffer(body[start:at], order + "f8")]

    stamp = number() + _NS * number()
    text()
    names = [text() for _ in range(number())]
    return stamp, names, numbers(), numbers(), numbers()


_DECODERS: dict[str, Callable[[bytes], _Message]] = {"cdr": _cdr, "json": _json}

"""A run as an MCAP file of JSON messages with Foxglove's schemas, and ours where it has none.

Names and fields are those that Foxglove publishes (foxglove/foxglove-sdk, schemas/jsonschema), by which its
panels recognise messages.

| topic | schema | content |
|---|---|---|
| `/robot_description` | foxglove.RobotDescription | the URDF, once |
| `/joint_states` | foxglove.JointStates | position, velocity, effort; names as in the URDF |
| `/tf` | foxglove.FrameTransforms | the frames of the URDF |
| `/imu/SERIAL` | x5.Imu | gyro and accelerometer in the frame `imu_SERIAL` |
| `/module/SERIAL` | x5.Module | everything else, with units in the names |

Messages with numbers that are not finite have no place for them in JSON: those fields are null.
"""

import base64
import json
import math
from collections.abc import Sequence
from types import TracebackType
from typing import IO, Any, Self

from mcap.writer import CompressionType, Writer

from coordinator.description.urdf_reader import URDF_IMU, URDF_JOINT
from coordinator.export.messages import OTHER_SIGNALS, JointSample, Vector
from coordinator.export.transforms import Transform

_Schema = dict[str, Any]
_NUMBER: _Schema = {"type": "number"}
_TEXT: _Schema = {"type": "string"}
_UNSET: _Schema = {"type": ["number", "null"]}


def _object(title: str, optional: Sequence[str] = (), **properties: _Schema) -> _Schema:
    required = [name for name in properties if name not in optional]
    return {"title": title, "type": "object", "properties": properties, "required": required}


def _list(items: _Schema) -> _Schema:
    return {"type": "array", "items": items}


_NANOSECONDS: _Schema = {"type": "integer", "minimum": 0, "maximum": 999_999_999}
_TIME = _object("time", sec={"type": "integer", "minimum": 0}, nsec=_NANOSECONDS)
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_SCHEMAS = {
    schema["title"]: schema
    for schema in (
        _object(
            "foxglove.RobotDescription",
            url=_TEXT,
            format=_TEXT,
            data={"type": "string", "contentEncoding": "base64"},
        ),
        _object(
            "foxglove.JointStates",
            timestamp=_TIME,
            joints=_list(
                _object(
                    "foxglove.JointState",
                    ("position", "velocity", "effort"),
                    name=_TEXT,
                    position=_NUMBER,
                    velocity=_NUMBER,
                    effort=_NUMBER,
                )
            ),
        ),
        _object(
            "foxglove.FrameTransforms",
            transforms=_list(
                _object(
                    "foxglove.FrameTransform",
                    timestamp=_TIME,
                    parent_frame_id=_TEXT,
                    child_frame_id=_TEXT,
                    translation=_VECTOR,
                    rotation=_QUATERNION,
                )
            ),
        ),
        _object("x5.Imu", timestamp=_TIME, frame_id=_TEXT, gyro_rad_s=_VECTOR, accel_m_s2=_VECTOR),
        _object("x5.Module", (), timestamp=_TIME, **dict.fromkeys(OTHER_SIGNALS, _UNSET)),
    )
}


class FoxgloveWriter:
    """Writes messages for Foxglove; a `MessageWriter`, to be used in a `with` block."""

    def __init__(self, file: IO[bytes], about: dict[str, str]):
        self._writer = Writer(file, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="x5-coordinator")
        self._writer.add_metadata("x5", about)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]

    def describe(self, stamp_ns: int, urdf: str) -> None:
        """Write the robot description."""
        message = {"url": "", "format": "urdf", "data": base64.b64encode(urdf.encode()).decode()}
        self._write("/robot_description", "foxglove.RobotDescription", stamp_ns, message)

    def joint_states(self, stamp_ns: int, joints: Sequence[JointSample]) -> None:
        """Write states of joints at one time."""
        states = [
            {"name": URDF_JOINT + serial, "position": position, "velocity": velocity, "effort": effort}
            for serial, position, velocity, effort in joints
        ]
        message = {"timestamp": _time(stamp_ns), "joints": states}
        self._write("/joint_states", "foxglove.JointStates", stamp_ns, message)

    def imu(self, stamp_ns: int, serial: str, gyro_rad_s: Vector, accel_m_s2: Vector) -> None:
        """Write the reading of a module's IMU."""
        message = {
            "timestamp": _time(stamp_ns),
            "frame_id": URDF_IMU + serial,
            "gyro_rad_s": dict(zip("xyz", gyro_rad_s, strict=True)),
            "accel_m_s2": dict(zip("xyz", accel_m_s2, strict=True)),
        }
        self._write(f"/imu/{serial}", "x5.Imu", stamp_ns, message)

    def others(self, stamp_ns: int, serial: str, values: Sequence[float]) -> None:
        """Write what Foxglove has no schema for."""
        known = (value if math.isfinite(value) else None for value in values)
        message = {"timestamp": _time(stamp_ns), **dict(zip(OTHER_SIGNALS, known, strict=True))}
        self._write(f"/module/{serial}", "x5.Module", stamp_ns, message)

    def transforms(self, stamp_ns: int, transforms: Sequence[Transform], fixed: bool) -> None:
        """Write transforms; those that do not move are written once."""
        messages = [
            {
                "timestamp": _time(stamp_ns),
                "parent_frame_id": one.parent,
                "child_frame_id": one.child,
                "translation": dict(zip("xyz", one.translation_m, strict=True)),
                "rotation": dict(zip("xyzw", one.rotation, strict=True)),
            }
            for one in transforms
        ]
        self._write("/tf", "foxglove.FrameTransforms", stamp_ns, {"transforms": messages})

    def _write(self, topic: str, schema: str, stamp_ns: int, message: object) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            if schema not in self._schemas:
                text = json.dumps(_SCHEMAS[schema]).encode()
                self._schemas[schema] = self._writer.register_schema(schema, "jsonschema", text)
            channel = self._writer.register_channel(topic, "json", self._schemas[schema])
            self._channels[topic] = channel
        data = json.dumps(message, allow_nan=False).encode()
        self._writer.add_message(channel, log_time=stamp_ns, publish_time=stamp_ns, data=data)


def _time(stamp_ns: int) -> dict[str, int]:
    sec, nsec = divmod(stamp_ns, 1_000_000_000)
    return {"sec": sec, "nsec": nsec}

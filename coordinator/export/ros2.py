"""A run as an MCAP file of ROS 2: standard messages in CDR, as `ros2 bag` records them.

| topic | message | content |
|---|---|---|
| `/robot_description` | std_msgs/String | the URDF, once |
| `/joint_states` | sensor_msgs/JointState | position, velocity, effort; names as in the URDF |
| `/imu/SERIAL` | sensor_msgs/Imu | gyro and accelerometer in the frame `imu_SERIAL`; no orientation |
| `/tf`, `/tf_static` | tf2_msgs/TFMessage | the frames of the URDF |
| `/dynamic_joint_states` | control_msgs/DynamicJointState | everything else, with units in the names |
"""

from collections.abc import Sequence
from itertools import chain, count
from types import TracebackType
from typing import IO, Any, Self

from mcap_ros2.writer import Writer

from coordinator.description.urdf_reader import URDF_IMU, URDF_JOINT
from coordinator.export.messages import OTHER_SIGNALS, JointSample, Vector
from coordinator.export.transforms import Transform

_TYPES = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/String": "string data\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header\n"
        "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
    ),
    "control_msgs/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    "control_msgs/DynamicJointState": (
        "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values\n"
    ),
}
_SEPARATOR = "=" * 80
# By sensor_msgs/Imu: no estimate of the orientation; the covariance of the others is not known.
_NO_ORIENTATION, _UNKNOWN = [-1.0] + 8 * [0.0], 9 * [0.0]


class Ros2Writer:
    """Writes messages of ROS 2; a `MessageWriter`, to be used in a `with` block."""

    def __init__(self, file: IO[bytes], about: dict[str, str]):
        self._writer = Writer(file)
        self._writer.add_metadata("x5", about)
        self._schemas: dict[str, Any] = {}
        self._tokens: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]

    def describe(self, stamp_ns: int, urdf: str) -> None:
        """Write the robot description."""
        self._write("/robot_description", "std_msgs/String", stamp_ns, {"data": urdf})

    def joint_states(self, stamp_ns: int, joints: Sequence[JointSample]) -> None:
        """Write states of joints at one time."""
        message = {
            "header": _header(stamp_ns),
            "name": [URDF_JOINT + joint.serial for joint in joints],
            "position": [joint.position_rad for joint in joints],
            "velocity": [joint.velocity_rad_s for joint in joints],
            "effort": [joint.effort_nm for joint in joints],
        }
        self._write("/joint_states", "sensor_msgs/JointState", stamp_ns, message)

    def imu(self, stamp_ns: int, serial: str, gyro_rad_s: Vector, accel_m_s2: Vector) -> None:
        """Write the reading of a module's IMU."""
        message = {
            "header": _header(stamp_ns, URDF_IMU + serial),
            "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            "orientation_covariance": _NO_ORIENTATION,
            "angular_velocity": _vector(gyro_rad_s),
            "angular_velocity_covariance": _UNKNOWN,
            "linear_acceleration": _vector(accel_m_s2),
            "linear_acceleration_covariance": _UNKNOWN,
        }
        self._write(f"/imu/{self._token(serial)}", "sensor_msgs/Imu", stamp_ns, message)

    def others(self, stamp_ns: int, serial: str, values: Sequence[float]) -> None:
        """Write what no standard message has a place for."""
        message = {
            "header": _header(stamp_ns),
            "joint_names": [URDF_JOINT + serial],
            "interface_values": [{"interface_names": OTHER_SIGNALS, "values": values}],
        }
        self._write("/dynamic_joint_states", "control_msgs/DynamicJointState", stamp_ns, message)

    def transforms(self, stamp_ns: int, transforms: Sequence[Transform], fixed: bool) -> None:
        """Write transforms."""
        messages = [
            {
                "header": _header(stamp_ns, one.parent),
                "child_frame_id": one.child,
                "transform": {
                    "translation": _vector(one.translation_m),
                    "rotation": dict(zip("xyzw", one.rotation, strict=True)),
                },
            }
            for one in transforms
        ]
        topic = "/tf_static" if fixed else "/tf"
        self._write(topic, "tf2_msgs/TFMessage", stamp_ns, {"transforms": messages})

    def _token(self, serial: str) -> str:
        """Return a module's token in names of topics: no two modules share one."""
        if serial not in self._tokens:
            token, taken = ros_name(serial), set(self._tokens.values())
            numbered = (f"{token}_{number}" for number in count(2))
            self._tokens[serial] = next(name for name in chain([token], numbered) if name not in taken)
        return self._tokens[serial]

    def _write(self, topic: str, name: str, stamp_ns: int, message: object) -> None:
        if name not in self._schemas:
            package, _, kind = name.partition("/")
            self._schemas[name] = self._writer.register_msgdef(f"{package}/msg/{kind}", definition(name))
        self._writer.write_message(topic, self._schemas[name], message, log_time=stamp_ns)


def definition(name: str) -> str:
    """Return the definition of a message with those of all that it contains, as MCAP stores them."""
    needed = [name]
    for one in needed:
        fields = [line.split()[0].partition("[")[0] for line in _TYPES[one].splitlines()]
        needed += [field for field in fields if field in _TYPES and field not in needed]
    return "".join(
        _TYPES[one] if one == name else f"{_SEPARATOR}\nMSG: {one}\n{_TYPES[one]}" for one in needed
    )


def ros_name(serial: str) -> str:
    """Return a serial as a token of a ROS name: letters, digits, underscores, and no digit first."""
    token = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in serial)
    return token if token[:1].isalpha() else f"m_{token}"


def _header(stamp_ns: int, frame: str = "") -> dict[str, object]:
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def _vector(values: Vector) -> dict[str, float]:
    return {"x": values[0], "y": values[1], "z": values[2]}

"""JointState of ROS in MCAP: the same recording as in an npz file, in either encoding."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from coordinator.arm_fit.data_file import DataFileError, read_log
from module_agent.model.chain import Array

JOINTS = ("shoulder", "elbow")
NAMES = ("elbow", "shoulder", "grip")


def cdr(t_ns: int, frame: str, signals: list[list[float]]) -> bytes:
    """Encode as ROS 2 does: little-endian, numbers aligned to their size behind the first four bytes."""
    body = struct.pack("<iI", t_ns // 10**9, t_ns % 10**9)

    def aligned(to: int) -> bytes:
        return body + b"\0" * (-len(body) % to)

    for text in (frame, None, *NAMES):
        body = aligned(4)
        if text is None:
            body += struct.pack("<I", len(NAMES))
        else:
            body += struct.pack("<I", len(text) + 1) + text.encode() + b"\0"
    for values in signals:
        body = aligned(4) + struct.pack("<I", len(values))
        if values:
            body = aligned(8) + struct.pack(f"<{len(values)}d", *values)
    return b"\0\1\0\0" + body


def plain(t_ns: int, frame: str, signals: list[list[float]]) -> bytes:
    stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
    keys = ("position", "velocity", "effort")
    header = {"header": {"stamp": stamp, "frame_id": frame}, "name": NAMES}
    return json.dumps(header | dict(zip(keys, signals, strict=True))).encode()


def write(path: Path, encoding: str, q: Array, tau: Array, velocity: bool) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        other = writer.register_schema("std_msgs/msg/String", "ros2msg", b"")
        topic, chatter = (
            writer.register_channel(name, kind, one)
            for name, kind, one in (("/js", encoding, schema), ("/s", "cdr", other))
        )
        encode = {"cdr": cdr, "json": plain}.get(encoding, cdr)
        for k in range(len(q)):
            t_ns = 10**18 + 2_000_000 * k
            signals = [
                [q[k, 1], q[k, 0], 0.03],
                [9.0, 8.0, 0.0] if velocity else [],
                [tau[k, 1], tau[k, 0], 0.0],
            ]
            writer.add_message(topic, t_ns, encode(t_ns, "base"[: k % 5], signals), t_ns)
            writer.add_message(chatter, t_ns, b"hello", t_ns)
        writer.finish()


@pytest.mark.parametrize("encoding", ["cdr", "json"])
@pytest.mark.parametrize("velocity", [True, False])
def test_joint_states_are_a_recording(tmp_path: Path, encoding: str, velocity: bool) -> None:
    q, tau = np.random.default_rng(1).normal(size=(2, 50, 2))
    write(tmp_path / "a.mcap", encoding, q, tau, velocity)
    log = read_log(tmp_path / "a.mcap", JOINTS, {"elbow": 2.0}, ["grip"])
    np.testing.assert_array_equal(log.q_rad, q)
    np.testing.assert_array_equal(log.tau_nm, tau * [1.0, 2.0])
    # 1e18 ns are known to 128 ns in seconds.
    assert log.rate_hz == pytest.approx(500.0, rel=1e-4)
    assert log.column("tau", "elbow") == f"{tmp_path / 'a.mcap'}: effort of elbow"
    assert log.others == {"grip": pytest.approx(0.03)}
    if velocity:
        np.testing.assert_array_equal(log.qd_rad_s, np.tile([8.0, 9.0], (50, 1)))
    else:
        assert log.qd_rad_s is None


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("json", b"{no json"),
        ("json", b"[1, 2]"),
        ("json", b'{"name": ["elbow"], "position": ["far"]}'),
        ("json", b'{"name": "elbow", "position": 3}'),
        ("json", b'{"name": ["elbow"], "position": [1' + 400 * b"0" + b"]}"),
        ("cdr", b""),
        ("cdr", b"\0\1\0\0\1\0"),
        ("cdr", b"\0\1\0\0" + 16 * b"\xff"),
    ],
)
def test_a_message_that_is_damaged_is_named_by_topic_and_time(
    tmp_path: Path, encoding: str, data: bytes
) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        writer.add_message(writer.register_channel("/js", encoding, schema), 2_500_000_000, data, 0)
        writer.finish()
    words = rf"topic /js: the message of 2\.500 s is damaged, or no JointState as {encoding}"
    with pytest.raises(DataFileError, match=words):
        read_log(tmp_path / "a.mcap", JOINTS)


@pytest.mark.parametrize(
    ("joints", "encoding", "words"),
    [
        (("hip",), "cdr", "no JointState with position and effort of hip; there are elbow, grip, shoulder"),
        (JOINTS, "ros1", "topic /js is encoded as 'ros1'; cdr and json are read"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, joints: tuple[str, ...], encoding: str, words: str) -> None:
    q, tau = np.random.default_rng(1).normal(size=(2, 5, 2))
    write(tmp_path / "a.mcap", encoding, q, tau, False)
    with pytest.raises(DataFileError, match=words):
        read_log(tmp_path / "a.mcap", joints)
    (tmp_path / "b.mcap").write_bytes(b"no mcap at all, but long enough")
    with pytest.raises(DataFileError, match=r"b\.mcap: not an MCAP file"):
        read_log(tmp_path / "b.mcap", JOINTS)


def test_what_other_joints_lack_is_no_damage(tmp_path: Path) -> None:
    """JSON has no NaN: of a gripper without a torque sensor encoders write null."""
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        topic = writer.register_channel("/js", "json", schema)
        for k in range(5):
            told: dict[str, list[str] | list[float | None]] = {"name": list(NAMES)}
            told |= {key: [0.1 * k, 0.2, None] for key in ("position", "velocity", "effort")}
            writer.add_message(topic, 2_000_000 * (k + 1), json.dumps(told).encode(), 0)
        writer.finish()
    log = read_log(tmp_path / "a.mcap", JOINTS)
    np.testing.assert_allclose(log.tau_nm[:, 1], 0.1 * np.arange(5))

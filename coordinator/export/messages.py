"""A run as messages in the order of time, for any middleware: joint states, IMUs, transforms and others.

Every sample becomes messages of its own, at its own time, as it was measured; or, with a rate, all joints are
in one message at common instants, interpolated. A `MessageWriter` gives them a format.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from coordinator.export.exported_run import ExportedRun
from coordinator.export.instants import at_instants
from coordinator.export.transforms import Transform, robot_transforms, turned
from coordinator.synchronisation.signals import Signals

# What no standard message has a place for, by the names of `Signals`.
OTHER_SIGNALS = (
    "position_command_rad",
    "velocity_command_rad_s",
    "effort_command_nm",
    "pwm",
    "deflection_rad",
    "motor_velocity_rad_s",
    "motor_current_a",
    "winding_temperature_c",
    "voltage_v",
    "motion_id",
    "state",
)
# Messages between two reports of progress.
_REPORTED = 5000

Vector = Sequence[float]


class JointSample(NamedTuple):
    """One joint at one time: position [rad], velocity [rad/s], effort [Nm]."""

    serial: str
    position_rad: float
    velocity_rad_s: float
    effort_nm: float


class MessageWriter(Protocol):
    """Writes messages in one format; `stamp_ns` is session time, since 1970 but for virtual time."""

    def describe(self, stamp_ns: int, urdf: str) -> None:
        """Write the robot description."""

    def joint_states(self, stamp_ns: int, joints: Sequence[JointSample]) -> None:
        """Write states of joints at one time."""

    def imu(self, stamp_ns: int, serial: str, gyro_rad_s: Vector, accel_m_s2: Vector) -> None:
        """Write the reading of a module's IMU, angular velocity and specific force, in its own frame."""

    def others(self, stamp_ns: int, serial: str, values: Sequence[float]) -> None:
        """Write what a module reported under the names `OTHER_SIGNALS`."""

    def transforms(self, stamp_ns: int, transforms: Sequence[Transform], fixed: bool) -> None:
        """Write transforms; fixed ones hold for the whole run."""


class _Stream(NamedTuple):
    """A module's samples as plain numbers, which cost less to take one by one."""

    serial: str
    stamps_ns: list[int]
    imu_stamps_ns: list[int]
    joints: list[JointSample]
    gyro_rad_s: list[list[float]]
    accel_m_s2: list[list[float]]
    others: list[list[float]]
    transforms: list[Transform]


def write_messages(
    run: ExportedRun,
    writer: MessageWriter,
    rate_hz: float | None,
    progress: Callable[[int, int], None],
) -> int:
    """Write all messages of a run; return how many samples they hold.

    Raises:
        UsageError: there is no such rate, or the robot description cannot be read.
    """
    signals = run.signals if rate_hz is None else at_instants(run.signals, rate_hz).signals
    known = robot_transforms(run.urdf)
    streams = []
    for serial, each in signals.items():
        joint = known.moving.get(serial)
        moved = list(turned(joint, np.nan_to_num(each.position_rad))) if joint is not None else []
        streams.append(_stream(run, serial, each, moved))
    total = sum(len(stream.stamps_ns) for stream in streams)
    begin_ns = min(stream.stamps_ns[0] for stream in streams)
    if run.urdf is not None:
        writer.describe(begin_ns, run.urdf)
    if known.fixed:
        writer.transforms(begin_ns, known.fixed, fixed=True)
    done = 0
    for samples in _one_by_one(streams) if rate_hz is None else _together(streams):
        _write(writer, samples)
        if done // _REPORTED != (done + len(samples)) // _REPORTED:
            progress(done, total)
        done += len(samples)
    progress(total, total)
    return total


def _stream(run: ExportedRun, serial: str, signals: Signals, moved: list[Transform]) -> _Stream:
    columns = (signals.position_rad, signals.velocity_rad_s, signals.effort_nm)
    return _Stream(
        serial,
        run.stamps_ns(signals.t_s),
        run.stamps_ns(signals.imu_t_s),
        [JointSample(serial, *row) for row in zip(*(c.tolist() for c in columns), strict=True)],
        signals.gyro_rad_s.tolist(),
        signals.accel_m_s2.tolist(),
        np.column_stack([getattr(signals, name) for name in OTHER_SIGNALS]).tolist(),
        moved,
    )


_Samples = Sequence[tuple[_Stream, int]]


def _one_by_one(streams: Sequence[_Stream]) -> Iterator[_Samples]:
    """Yield every sample alone, in the order of time."""
    stamps = np.concatenate([np.array(stream.stamps_ns, dtype=np.int64) for stream in streams])
    of = np.repeat(np.arange(len(streams)), [len(stream.stamps_ns) for stream in streams])
    row = np.concatenate([np.arange(len(stream.stamps_ns)) for stream in streams])
    order = np.argsort(stamps, kind="stable")
    for module, sample in zip(of[order].tolist(), row[order].tolist(), strict=True):
        yield ((streams[module], sample),)


def _together(streams: Sequence[_Stream]) -> Iterator[_Samples]:
    """Yield the samples of all modules at each instant, without modules that have none then."""
    for k in range(len(streams[0].stamps_ns)):
        samples = [(one, k) for one in streams if not math.isnan(one.joints[k].position_rad)]
        if samples:
            yield samples


def _write(writer: MessageWriter, samples: _Samples) -> None:
    stream, row = samples[0]
    stamp_ns = stream.stamps_ns[row]
    writer.joint_states(stamp_ns, [stream.joints[k] for stream, k in samples])
    moved = [stream.transforms[k] for stream, k in samples if stream.transforms]
    if moved:
        writer.transforms(stamp_ns, moved, fixed=False)
    for stream, k in samples:
        if not math.isnan(stream.gyro_rad_s[k][0]):
            writer.imu(stream.imu_stamps_ns[k], stream.serial, stream.gyro_rad_s[k], stream.accel_m_s2[k])
        writer.others(stamp_ns, stream.serial, stream.others[k])

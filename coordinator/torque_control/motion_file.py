"""Read the motion of a robot from CSV, as `x5-coordinator excite` writes it.

A line of names and a line per sample: `t_s`, and per joint that moves `q_<joint>_rad`, <joint> the serial of
its module, or its name in the URDF of a run, `joint_<serial>`; columns in any order. Others are ignored:
velocities and accelerations are those of a cubic spline through the positions.
"""

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline

from coordinator.description.urdf_reader import URDF_JOINT
from coordinator.torque_control.feed_forward import RATE_HZ, Reference
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError
from module_agent.model.read_only import read_only

# A path that begins at rest has less at 250 Hz; a module cannot have it from one tick to the next.
MAX_END_SPEED_RAD_S = 0.1
MAX_MOTION_S = 600.0
MIN_SAMPLES = 4
_TIME = "t_s"
_POSITION = re.compile(r"q_(.+)_rad")


class MotionFile(NamedTuple):
    """A motion of k joints at m increasing times from 0, read-only: t_s (m,), q_rad (m, k)."""

    path: Path
    joints: tuple[str, ...]
    t_s: Array
    q_rad: Array

    def reference(self, serials: Sequence[str], standing_rad: Array) -> Reference:
        """Return the motion of all n joints at 1 kHz; those that the file does not have stand still.

        standing_rad: (n,) their positions.
        """
        t_s = np.arange(round(float(self.t_s[-1]) * RATE_HZ) + 1) / RATE_HZ
        spline = make_interp_spline(self.t_s, self.q_rad, k=3)
        columns = [serials.index(joint) for joint in self.joints]
        q, qd, qdd = np.zeros((3, t_s.size, len(serials)))
        q[:] = standing_rad
        at_s = np.minimum(t_s, self.t_s[-1])
        for array, order in ((q, 0), (qd, 1), (qdd, 2)):
            array[:, columns] = spline(at_s, nu=order)
        return Reference(*(read_only(array) for array in (t_s, q, qd, qdd)))


def read_motion(path: Path, serials: Sequence[str]) -> MotionFile:
    """Read the motion of joints among `serials`.

    Raises:
        UsageError: the file cannot be read, has joints that the robot has not, values that are not finite,
            times that do not increase, or does not begin and end at rest. The message has the line.
        OSError: there is no such file.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [row for row in csv.reader(file) if row]
    except (csv.Error, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not a CSV file: {error}") from error
    names = [name.strip() for name in rows[0]] if rows else []
    named = _joints(path, names, serials)
    joints = tuple(named)
    columns = [names.index(_TIME), *named.values()]
    if len(rows) <= MIN_SAMPLES:
        raise UsageError(f"{path}: {len(rows) - 1} samples; a motion has at least {MIN_SAMPLES}")
    values = np.array([_numbers(path, line, row, columns) for line, row in enumerate(rows[1:], 2)])
    t_s, q_rad = values[:, 0] - values[0, 0], values[:, 1:]
    if (late := np.flatnonzero(np.diff(t_s) <= 0.0)).size:
        line, before, after = int(late[0]) + 3, values[late[0], 0], values[late[0] + 1, 0]
        raise UsageError(f"{path}: line {line}: t_s {after:g} after {before:g}: times must increase")
    if t_s[-1] > MAX_MOTION_S:
        raise UsageError(f"{path}: the motion takes {t_s[-1]:.0f} s, at most {MAX_MOTION_S:.0f} s are played")
    _check_rest(path, joints, t_s, q_rad)
    return MotionFile(path, joints, read_only(t_s), read_only(q_rad))


def _joints(path: Path, names: list[str], serials: Sequence[str]) -> dict[str, int]:
    """Return the column of every joint in the file, by serial."""
    joints = [(match[1], column) for column, name in enumerate(names) if (match := _POSITION.fullmatch(name))]
    if _TIME not in names or not joints:
        raise UsageError(f"{path}: columns {', '.join(names) or 'none'}; needed are t_s and q_<joint>_rad")
    columns: dict[str, int] = {}
    for joint, column in joints:
        serial = joint if joint in serials else joint.removeprefix(URDF_JOINT)
        if serial not in serials:
            raise UsageError(f"{path}: joint {joint} is not one of the robot's: {', '.join(serials)}")
        if serial in columns:
            raise UsageError(f"{path}: joint {serial} has two columns")
        columns[serial] = column
    return columns


def _numbers(path: Path, line: int, row: list[str], columns: list[int]) -> list[float]:
    try:
        values = [float(row[column]) for column in columns]
    except (ValueError, IndexError) as error:
        raise UsageError(f"{path}: line {line}: {error}; every column needs a number") from error
    if not np.isfinite(values).all():
        raise UsageError(f"{path}: line {line}: a value is not finite")
    return values


def _check_rest(path: Path, joints: tuple[str, ...], t_s: Array, q_rad: Array) -> None:
    for place, ends in (("begins", slice(0, 2)), ("ends", slice(-2, None))):
        speed = np.abs(np.diff(q_rad[ends], axis=0)[0]) / np.diff(t_s[ends])[0]
        worst = int(np.argmax(speed))
        if speed[worst] > MAX_END_SPEED_RAD_S:
            raise UsageError(
                f"{path}: joint {joints[worst]} {place} at {speed[worst]:.2f} rad/s: a motion must begin and "
                f"end at rest, under {MAX_END_SPEED_RAD_S:g} rad/s"
            )

"""The recordings of an arm as one, and the arm with the joints that stand still taken as fixed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.arm_fit.checks import wrong_motion
from coordinator.arm_fit.data_file import DataFileError, JointLog, at_rate, joined, read_log
from coordinator.description.urdf_reader import UrdfRobot, read_urdf
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError
from module_agent.model.read_only import read_only

Source = str | Path | JointLog

# A joint that stays within this is held: what moves it is the give of a controller, not a motion.
STILL = 0.01


class Recordings(NamedTuple):
    """An arm whose joints all move, and its recordings as one, of those joints.

    joints: the arm's joints before those that stand still were fixed; `moving` are the others' places there.
    gains: torque constants of joints whose currents were recorded. factors: (n,) of the readings of `log`.
    """

    robot: UrdfRobot
    log: JointLog
    joints: tuple[str, ...]
    moving: tuple[int, ...]
    gains: Mapping[str, float]
    factors: Array

    def scaled(self, factors: Array) -> "Recordings":
        """Return the recordings with the readings of every joint multiplied (n,)."""
        log = self.log._replace(tau_nm=read_only(self.log.tau_nm * factors))
        return self._replace(log=log, factors=self.factors * factors)


def read_recordings(
    robot: UrdfRobot, sources: Sequence[Source], gains: Mapping[str, float], checked: bool
) -> Recordings:
    """Read recordings of an arm: of several rates all at the highest, joints that stand still fixed.

    Joints that the URDF's reader takes as fixed are at their mean recorded positions, if there are any.

    Raises:
        UsageError: files or torque constants that do not fit the arm, or a recording without motion.
        DataFileError: if `checked`, times, positions or velocities that are not what they should be.
        OSError: a file cannot be read.
    """
    joints = robot.chain.serials
    if unknown := [name for name in gains if name not in joints]:
        raise UsageError(f"gain of {unknown[0]!r}: the joints are {', '.join(joints)}")
    logs = [_read(source, robot, gains) for source in sources]
    recorded = {name: position for log in logs for name, position in log.others.items()}
    if recorded:
        robot = read_urdf(robot.path, robot.chain.gravity, robot.held | recorded)
    if checked and (texts := [text for log in logs for text in wrong_motion(robot, log)]):
        raise DataFileError("\n".join(texts))
    log = joined([at_rate(log, max(log.rate_hz for log in logs)) for log in logs])
    still = np.ptp(log.q_rad, axis=0) < STILL
    if still.all():
        raise UsageError(
            f"{log.file}: no joint moves by more than {STILL} rad; record a motion of all joints"
        )
    if still.any():
        held = {joints[i]: float(log.q_rad[:, i].mean()) for i in np.flatnonzero(still)}
        robot = read_urdf(robot.path, robot.chain.gravity, robot.held | held)
    moving = tuple(np.flatnonzero(~still).tolist())
    return Recordings(robot, _columns(log, moving), joints, moving, gains, np.ones(len(moving)))


def read_other(recordings: Recordings, source: Source) -> JointLog:
    """Read another recording of the same joints.

    Raises:
        UsageError: a file that does not fit, or in which a joint that stood still moves.
        OSError: the file cannot be read.
    """
    before = read_urdf(recordings.robot.path) if len(recordings.moving) < len(recordings.joints) else None
    log = _read(source, before or recordings.robot, recordings.gains)
    for name, position in recordings.robot.held.items():
        if name in recordings.joints:
            off = np.abs(log.q_rad[:, recordings.joints.index(name)] - position).max()
            if off > STILL:
                raise UsageError(
                    f"{log.column('q', name)}: {off:.3g} rad from the {position:.3g} rad at which it stood "
                    "still in the other recording; give both as --data"
                )
    other = _columns(log, recordings.moving)
    return other._replace(tau_nm=read_only(other.tau_nm * recordings.factors))


def _read(source: Source, robot: UrdfRobot, gains: Mapping[str, float]) -> JointLog:
    if not isinstance(source, JointLog):
        return read_log(source, robot.chain.serials, gains, tuple(robot.held))
    if source.q_rad.shape != source.tau_nm.shape or source.q_rad.shape[1:] != (len(robot.bodies),):
        raise UsageError(
            f"positions {source.q_rad.shape} and torques {source.tau_nm.shape} of the recording do not fit "
            f"the joints {', '.join(robot.chain.serials)}"
        )
    return source


def _columns(log: JointLog, moving: Sequence[int]) -> JointLog:
    at = list(moving)
    qd = None if log.qd_rad_s is None else log.qd_rad_s[:, at]
    return log._replace(q_rad=log.q_rad[:, at], qd_rad_s=qd, tau_nm=log.tau_nm[:, at])

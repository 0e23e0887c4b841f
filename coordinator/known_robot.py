"""A robot that is known from a former run: its recording, and what it says of the robot."""

from pathlib import Path
from typing import NamedTuple

from coordinator.chain import Chain
from coordinator.identify import IdentificationError, Kinematics, identify_kinematics
from coordinator.kinematics.imu_intrinsics import ImuKind
from coordinator.recording import Recording
from coordinator.run_folder import SESSION, load_recording
from coordinator.session_file import SessionFileError
from module_agent.catalogue import UnknownModuleType


class KnownRobotError(ValueError):
    """The folder holds no run that a robot is known from; the message says what is missing, and where."""


class KnownRobot(NamedTuple):
    """A run's folder, its recording, and the kinematics identified from it."""

    folder: Path
    recording: Recording
    kinematics: Kinematics

    @property
    def chain(self) -> Chain:
        """The chain as refined."""
        return self.kinematics.fit.chain

    @property
    def name(self) -> str:
        """The robot's name, as the run was told."""
        return next((e.robot for e in reversed(self.recording.journal) if e.what == "session"), "")

    @property
    def imu(self) -> ImuKind:
        """How well its IMUs were known, as the run was told."""
        return next((e.imu for e in reversed(self.recording.journal) if e.what == "session"), "uncalibrated")


def load_known(folder: Path) -> KnownRobot:
    """Read a run's folder, and identify its robot again from the recording.

    The recording, not `result.json`, since two sessions are compared by what the sensors read.

    Raises:
        KnownRobotError: there is no recording, or it is not one of a whole exploration.
    """
    path = folder / SESSION
    if not path.is_file():
        raise KnownRobotError(f"{folder} holds no {SESSION}: give the folder of a run that has finished")
    try:
        recording = load_recording(path)
        return KnownRobot(folder, recording, identify_kinematics(recording))
    except (SessionFileError, IdentificationError, UnknownModuleType) as error:
        raise KnownRobotError(f"{path} does not tell the robot: {error}") from error

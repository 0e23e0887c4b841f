"""A robot that is known from a former run: its recording, and what it says of the robot."""

import shutil
from pathlib import Path
from typing import NamedTuple

from coordinator.baseline.update import updated
from coordinator.excitation.plan import Plan
from coordinator.identification.identified import IdentificationError, Kinematics
from coordinator.identification.identify import identify_kinematics
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import SESSION, load_recording
from coordinator.recording.session_file import SessionFileError
from module_agent.model.catalogue import ImuKind, UnknownModuleType
from module_agent.model.chain import Chain
from module_agent.model.errors import UsageError

# In the folder of a run that brought a known robot up to date: the recording of the run that the robot was
# known from, so that the folder tells the robot by itself.
KNOWN = "known"


class BaselineError(UsageError):
    """The folder holds no run that a robot is known from; the message says what is missing, and where."""


class BaselineRobot(NamedTuple):
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
        return self.recording.imu


def load_baseline(folder: Path) -> BaselineRobot:
    """Read a run's folder, and identify its robot again from the recording.

    A run that brought a known robot up to date holds that one's recording too, and both together tell it.
    The recording, not `result.json`, since two sessions are compared by what the sensors read.

    Raises:
        KnownRobotError: there is no recording, or it is not one of a whole exploration.
    """
    path = folder / SESSION
    if not path.is_file():
        raise BaselineError(f"{folder} holds no {SESSION}: give the folder of a run that has finished")
    try:
        recording = load_recording(path)
        kinematics, before = identify_kinematics(recording), baseline_within(folder)
        if before is not None:
            kinematics = updated(before, kinematics)
        return BaselineRobot(folder, recording, kinematics)
    except (SessionFileError, IdentificationError, UnknownModuleType) as error:
        raise BaselineError(f"{path} does not tell the robot: {error}") from error


def baseline_within(folder: Path) -> Kinematics | None:
    """Return the kinematics of the robot as it was known to the run in a folder; None if it was not.

    Raises:
        KnownRobotError: as `load_baseline`.
    """
    return load_baseline(folder / KNOWN).kinematics if (folder / KNOWN).is_dir() else None


def keep_baseline(known: BaselineRobot, folder: Path) -> None:
    """Copy the recordings that a robot is known from into the folder of a run."""
    there, here = known.folder, folder / KNOWN
    while (there / SESSION).is_file():
        here.mkdir()
        shutil.copyfile(there / SESSION, here / SESSION)
        there, here = there / KNOWN, here / KNOWN


def hurried(plan: Plan, known: BaselineRobot) -> dict[str, object]:
    """Return settings with which a robot that is known is moved again: only what for, and fast about it."""
    return {
        "dynamics": False,
        "imu": known.imu,
        "torque": known.recording.torque,
        "discover_s": min(plan.discover_s, 0.5),
        "link_s": min(plan.link_s, 0.5),
        "settle_s": min(plan.settle_s, 0.3),
        "travel_speed_rad_s": max(plan.travel_speed_rad_s, 1.5),
    }

"""A robot as identified by an earlier run, its baseline: the recording and the kinematics."""

import shutil
from pathlib import Path
from typing import NamedTuple

from coordinator.baseline.update import updated
from coordinator.batch_estimation.imu_calibration import CalibrationInformation
from coordinator.excitation.plan import Plan
from coordinator.identification.identified import IdentificationError, Kinematics, calibrations
from coordinator.identification.identify import identify_kinematics
from coordinator.merge.calibration_file import each_once, read_calibration
from coordinator.merge.run_arrays import RunArraysError
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import MEASURED, SESSION, load_recording
from coordinator.recording.session_file import SessionFileError
from coordinator.recording.versions import current_run
from module_agent.model.catalogue import ImuKind, UnknownModuleType
from module_agent.model.chain import Chain
from module_agent.model.errors import UsageError

# Subfolder of a run with a baseline, with the baseline's recording, so that the folder is complete.
BASELINE = "known"


class BaselineError(UsageError):
    """The folder holds no run that can be a baseline; the message says what is missing, and where."""


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
        """The robot's name in the run."""
        return next((e.robot for e in reversed(self.recording.journal) if e.what == "session"), "")

    @property
    def imu(self) -> ImuKind:
        """The prior of its IMUs in the run."""
        return self.recording.imu

    @property
    def measured(self) -> tuple[CalibrationInformation, ...]:
        """What the run, and those before it, tell of its modules' IMUs."""
        return calibrations(self.kinematics, self.recording)

    def updated(self, session: Kinematics) -> Kinematics:
        """Return a session's kinematics with this robot's geometry wherever nothing has changed."""
        return updated(self.kinematics, session)


def load_baseline(folder: Path) -> BaselineRobot:
    """Read a run's folder, or its current version, and identify its robot again from the recording.

    A run with a baseline of its own holds that recording too, and both are combined. The recording is read,
    not `result.json`, since two sessions are compared by their sensor readings.

    Raises:
        BaselineError: there is no recording, or not of a complete exploration.
        VersionError: see `current_run`.
    """
    folder = current_run(folder)
    path = folder / SESSION
    if not path.is_file():
        raise BaselineError(f"{folder} holds no {SESSION}: give the folder of a run that has finished")
    try:
        recording, before = load_recording(path), baseline_within(folder)
        kinematics = identify_kinematics(recording, measured_before_run(folder, before))
        if before is not None:
            kinematics = before.updated(kinematics)
        return BaselineRobot(folder, recording, kinematics)
    except (SessionFileError, IdentificationError, UnknownModuleType, RunArraysError) as error:
        raise BaselineError(f"{path} does not identify the robot: {error}") from error


def baseline_within(folder: Path) -> BaselineRobot | None:
    """Return the baseline that the run in a folder had; None if it had none.

    Raises:
        BaselineError: as `load_baseline`.
    """
    return load_baseline(folder / BASELINE) if (folder / BASELINE).is_dir() else None


def measured_before_run(folder: Path, baseline: BaselineRobot | None) -> tuple[CalibrationInformation, ...]:
    """Return the recordings from which the run in a folder takes the prior of its IMUs, each once.

    Raises:
        RunArraysError: what the folder has of them is damaged.
    """
    kept = read_calibration(folder / MEASURED) if (folder / MEASURED).is_file() else ()
    return each_once((*(baseline.measured if baseline is not None else ()), *kept))


def keep_baseline(baseline: BaselineRobot, folder: Path) -> None:
    """Copy the recordings of a baseline, and what they began with, into the folder of a run."""
    there, here = baseline.folder, folder / BASELINE
    while (there / SESSION).is_file():
        here.mkdir()
        for name in (SESSION, MEASURED):
            if (there / name).is_file():
                shutil.copyfile(there / name, here / name)
        there, here = there / BASELINE, here / BASELINE


def shortened_settings(plan: Plan, baseline: BaselineRobot) -> dict[str, object]:
    """Return the settings of a short run of a robot with a baseline."""
    return {
        "dynamics": False,
        "imu": baseline.imu,
        "torque": baseline.recording.torque,
        "discover_s": min(plan.discover_s, 0.5),
        "link_s": min(plan.link_s, 0.5),
        "settle_s": min(plan.settle_s, 0.3),
        "travel_speed_rad_s": max(plan.travel_speed_rad_s, 1.5),
    }

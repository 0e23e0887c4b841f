"""What leaves with a run: every module's signals, the robot's description, and what is missing of them."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np

from coordinator.description.urdf_reader import UrdfError, read_joints
from coordinator.recording.recording import ModuleRecord, Recording
from coordinator.recording.run_folder import ASIDE, RESULT, SESSION, URDF, load_recording
from coordinator.recording.versions import current_run
from coordinator.synchronisation.round_trips import map_clocks
from coordinator.synchronisation.signals import Signals, module_signals
from module_agent.model.chain import Array
from module_agent.model.errors import DataError, UsageError
from module_agent.signals.clock_map import ClockMap

_S = 1e9


class MissingPackage(UsageError):
    """A format needs a package that is not installed."""


class ExportedRun(NamedTuple):
    """A run as it is exported.

    robot: its name. start_ns: session time [ns] at which the recording began, zero of the signals' times;
    since 1970 but for virtual time. signals: by serial. urdf: the robot's description, None if the run has
    none. missing: a sentence about everything that a complete run would have had.
    """

    robot: str
    start_ns: int
    signals: Mapping[str, Signals]
    urdf: str | None
    missing: tuple[str, ...]

    def stamps_ns(self, t_s: Array) -> list[int]:
        """Return times since the recording began as session times [ns]."""
        # In virtual time a session begins at zero, and an IMU may have been read just before.
        stamps: list[int] = np.maximum(self.start_ns + np.rint(_S * t_s).astype(np.int64), 0).tolist()
        return stamps


def read_exported(folder: Path) -> ExportedRun:
    """Read a run, finished or not, or its current version, for export.

    Raises:
        VersionError: see `current_run`.
        UsageError: the folder holds no recording of a run.
        SessionFileError: the recording cannot be read.
        UsageError: the robot description is damaged.
        DataError: it has no samples of any module.
    """
    folder = current_run(folder)
    session = next((folder / name for name in (SESSION, ASIDE) if (folder / name).is_file()), None)
    if session is None:
        raise UsageError(f"{folder} holds no {SESSION}: give the folder of a run")
    urdf = folder / URDF
    missing = []
    if not (folder / RESULT).is_file():
        missing.append(f"the run has no {RESULT}: it did not end, or failed")
    if not urdf.is_file():
        missing.append(f"the run has no {URDF}: no robot description and no transforms")
    return exported(load_recording(session), _description(urdf) if urdf.is_file() else None, missing)


def _description(path: Path) -> str:
    """Return the text of a run's URDF.

    Raises:
        UsageError: it is damaged.
    """
    try:
        text = path.read_text(encoding="utf-8")
        read_joints(text)
    except (UnicodeDecodeError, UrdfError) as error:
        why = f"{path} is damaged: {error}"
        raise UsageError(f"{why}; `x5-coordinator replay {path.parent}` writes it anew") from error
    return text


def exported(recording: Recording, urdf: str | None, missing: list[str]) -> ExportedRun:
    """Return a recording as it is exported; sentences on what it lacks are added to `missing`.

    Raises:
        DataError: it has no samples of any module.
    """
    missing = [*recording.damage, *recording.remarks, *missing]
    known = {}
    for serial, module in sorted(recording.modules.items()):
        if not module.rows.end_row > module.rows.first_row:
            missing.append(f"{serial} has sent no samples")
        elif not module.trips:
            missing.append(f"{serial} is left out: no round trip maps its clock to the others'")
        else:
            known[serial] = module
            missing += _lost_samples(module)
    missing += _earlier_boots(recording)
    if not known:
        raise DataError("; ".join(["no module has samples with a known clock", *missing]))
    clocks = map_clocks({serial: module.trips for serial, module in known.items()})
    robot = next((event.robot for event in recording.journal if event.what == "session"), "") or "robot"
    start_ns = _start_ns(recording, known, clocks)
    signals = {s: module_signals(module, clocks[s], start_ns) for s, module in known.items()}
    return ExportedRun(robot, start_ns, signals, urdf, tuple(missing))


def _lost_samples(module: ModuleRecord) -> list[str]:
    first, end = module.rows.first_row, module.rows.end_row
    lost = sum(stop - start for start, stop in module.rows.missing(first, end))
    return [f"{module.serial}: {lost} of {end - first} samples were lost"] if lost else []


def _earlier_boots(recording: Recording) -> list[str]:
    """Name the samples of modules before they booted anew: of each the latest boot is exported."""
    return [
        f"{serial}: {module.rows.count} samples of an earlier boot are left out, before it booted anew"
        for (serial, boot), module in sorted(recording.past.items())
        if module.rows.count and recording.modules[serial].boot != boot
    ]


def _start_ns(
    recording: Recording, modules: Mapping[str, ModuleRecord], clocks: Mapping[str, ClockMap]
) -> int:
    """Return when the recording began; where damage has taken its journal, the time of the first sample."""
    if recording.journal:
        return min(event.t_ns for event in recording.journal)
    firsts = [clocks[s].to_session(m.rows.rows(0, m.rows.end_row)["t_ns"][:1]) for s, m in modules.items()]
    return int(min(first[0] for first in firsts))


def check_package(name: str, needed_for: str) -> None:
    """Check before the work that a package is installed.

    Raises:
        MissingPackage: it is not; the message says how to install it.
    """
    if find_spec(name) is None:
        raise MissingPackage(
            f"{needed_for} needs {name.replace('_', '-')}, which is not installed: "
            "pip install 'x5-self-model[export]'"
        )

"""The folder of one run: recording, view, result and the robot as URDF, SRDF and HRDF."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import Recording
from coordinator.recording.session_file import SessionFileError, read_session
from module_agent.model.errors import UsageError
from module_agent.wire.refusal import WireError

SESSION, VIEW, RESULT, URDF, SRDF, HRDF, HELD_OUT, INFORMATION, CALIBRATION, MEASURED, REPORT = (
    "session.mcap",
    "session.rrd",
    "result.json",
    "robot.urdf",
    "robot.srdf",
    "robot.hrdf",
    "held_out.npz",
    "information.npz",
    "imu_calibration.npz",
    "measured.npz",
    "report.html",
)
ASIDE = "session.crashed.mcap"


class RunFolderError(UsageError):
    """The folder cannot be used; the message says why and what to do."""


def check_free(path: Path) -> None:
    """Check that a new run may use the folder; one that ended before its first step does not count.

    Raises:
        RunFolderError: it holds a run already.
    """
    if (path / RESULT).exists() or any(_has_begun(path / name) for name in (SESSION, ASIDE)):
        raise RunFolderError(f"{path} holds a run already: choose another --out, or --resume it")


def view_of(run: Path) -> Path:
    """Return what the viewer shows of a run, by its folder or that file itself.

    Raises:
        RunFolderError: there is no such file.
    """
    recording = run / VIEW if run.is_dir() else run
    if not recording.is_file():
        raise RunFolderError(f"{recording}: there is no such recording; a run writes {VIEW} into its folder")
    return recording


def open_run_folder(path: Path, resume: bool, robot: str | None = None) -> Path | None:
    """Make the folder; return the recording of the crashed run to `resume` from, if there is one.

    The crashed run's recording is set aside under another name and kept until the resumed run is complete.
    It must be of the robot of that name, None for any.

    Raises:
        RunFolderError: the folder holds a run already and `resume` is false, or nothing is there to resume,
            or the run is another robot's.
    """
    if not resume:
        check_free(path)
        path.mkdir(parents=True, exist_ok=True)
        for name in (SESSION, ASIDE, MEASURED):
            (path / name).unlink(missing_ok=True)
        return None
    if (path / RESULT).exists():
        raise RunFolderError(f"{path} holds a complete run: there is nothing to resume")
    session, aside = path / SESSION, path / ASIDE
    if not session.exists() and not aside.exists():
        raise RunFolderError(f"{path} holds no recording to resume")
    # After a crash while resuming, the recording set aside is complete, unless the new file, which begins
    # with a copy of it, is longer.
    older = aside.exists() and (not session.exists() or session.stat().st_size < aside.stat().st_size)
    journal = _journal(aside if older else session)
    resumed = next((event.robot for event in journal if event.what == "session"), None)
    if None not in (resumed, robot) and resumed != robot:
        raise RunFolderError(
            f"{path} holds a run of robot {resumed!r}, not of {robot!r}: give --robot {resumed}, or the "
            f"--out of a run of {robot!r}"
        )
    if not older:
        session.replace(aside)
    return aside


def _journal(session: Path) -> Iterator[JournalEvent]:
    for entry in read_session(session):
        if entry.kind == "journal":
            with suppress(WireError):  # an event of another version
                yield JournalEvent.decode(entry.payload)


def _has_begun(session: Path) -> bool:
    if not session.exists():
        return False
    # An unreadable file, or part of one, is not overwritten.
    damage: list[str] = []
    try:
        for entry in read_session(session, damage.append):
            if entry.kind == "journal" and JournalEvent.decode(entry.payload).what == "begin":
                return True
    except (SessionFileError, WireError):
        return True
    return bool(damage)


def load_recording(path: Path) -> Recording:
    """Read a recording; messages that could not be decoded are left out, as in the live session.

    Damaged places, and events of the journal that this version does not know, are in `Recording.damage`.

    Raises:
        SessionFileError: as `read_session`.
    """
    recording, unknown = Recording(), 0
    for entry in read_session(path, recording.damage.append):
        try:
            recording.add(entry)
        except WireError:  # counted in `recording.refused`
            unknown += entry.kind == "journal"
    if unknown:
        events = f"{unknown} events of the journal are" if unknown > 1 else "an event of the journal is"
        recording.damage.append(f"{path.name}: {events} unknown to this version of the program, and left out")
    return recording

"""The folder of one run: `session.mcap`, `session.rrd`, `result.json`, `robot.urdf`, `held_out.npz`."""

from pathlib import Path

from coordinator.recording import Recording
from coordinator.session_file import read_session
from module_agent.wire.refusal import WireError

SESSION, VIEW, RESULT, URDF, HELD_OUT = (
    "session.mcap",
    "session.rrd",
    "result.json",
    "robot.urdf",
    "held_out.npz",
)
ASIDE = "session.crashed.mcap"


class RunFolderError(ValueError):
    """The folder cannot be used; the message says why and what to do."""


def check_free(path: Path) -> None:
    """Check that a new run may use the folder, without making it.

    Raises:
        RunFolderError: it holds a run already.
    """
    if (path / SESSION).exists() or (path / ASIDE).exists():
        raise RunFolderError(f"{path} holds a run already: choose another --out, or --resume it")


def open_run_folder(path: Path, resume: bool) -> Path | None:
    """Make the folder; return the recording of the crashed run to resume from, if there is one.

    The crashed run's recording is set aside under another name and kept until the resumed run is complete.

    Raises:
        RunFolderError: the folder holds a run already and is not to be resumed, or there is nothing to
        resume.
    """
    if not resume:
        check_free(path)
    path.mkdir(parents=True, exist_ok=True)
    session = path / SESSION
    aside = path / ASIDE
    if not resume:
        return None
    if (path / RESULT).exists():
        raise RunFolderError(f"{path} holds a complete run: there is nothing to resume")
    # Crashed while resuming: what was set aside first has everything that the new file had begun to repeat,
    # unless the new file went further.
    if aside.exists() and session.exists() and session.stat().st_size < aside.stat().st_size:
        return aside
    if session.exists():
        session.replace(aside)
    if not aside.exists():
        raise RunFolderError(f"{path} holds no recording to resume")
    return aside


def load_recording(path: Path) -> Recording:
    """Read a recording; what could not be understood when it came is left out as it was then."""
    recording = Recording()
    for entry in read_session(path):
        try:
            recording.add(entry)
        except WireError:
            continue  # counted in `recording.refused`
    return recording

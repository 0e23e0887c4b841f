"""Start the viewer's own program, which comes with the SDK: with a window, as a web server, or headless.

Put recordings of one run together in one file, with the viewer's own program.

The messages stay in their order, so that the file opens with the layout that came last. (Of the program's
commands `filter` with nothing to filter does that; as of 0.41 `merge` loses the order, and `route` fails on
files that it has not written.)
"""

import importlib.util
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, NamedTuple

START_SECONDS = 15.0
_POLL_SECONDS = 0.05
# The end of what it printed is where the reason is.
LINES_TOLD = 30


class ViewerProcess(NamedTuple):
    """A viewer that was started here, and the file that it prints to."""

    process: subprocess.Popen[bytes]
    output: IO[bytes]

    def told(self) -> str:
        """Return the end of what it has printed so far."""
        self.output.seek(0)
        lines = self.output.read().decode(errors="replace").strip().splitlines()
        return "\n".join(lines[-LINES_TOLD:])


class ViewerNotStarted(RuntimeError):
    """The viewer's program ended, or did not listen in time; the message has what it printed."""


def executable() -> Path:
    """Return the viewer that belongs to the installed SDK, whether or not it is on the PATH.

    Raises:
        ViewerNotStarted: there is none.
    """
    package = importlib.util.find_spec("rerun_cli")
    if package is not None and package.origin is not None:
        bundled = Path(package.origin).parent / "rerun"
        if bundled.is_file():
            return bundled
    found = shutil.which("rerun")
    if found is None:
        raise ViewerNotStarted("no viewer in the rerun-sdk package nor on the PATH; reinstall rerun-sdk")
    return Path(found)


def start(options: Sequence[str], port: int, *, detached: bool) -> ViewerProcess:
    """Start the viewer, listening for data on `port` of 127.0.0.1, and wait until it does.

    A detached viewer has its own session, so that neither Ctrl-C nor the end of this process ends it.

    Raises:
        ViewerNotStarted: it ended or was not ready within `START_SECONDS`.
    """
    # By default the viewer listens on all interfaces; a run is nobody else's business unless asked for.
    command = [str(executable()), "--bind", "127.0.0.1", "--port", str(port), *options]
    environment = {**os.environ, "RERUN_APP_ONLY": "true", "NO_COLOR": "1"}
    output = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the viewer
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        env=environment,
        start_new_session=detached,
    )
    started = ViewerProcess(process, output)
    if _wait_until_ready(process, port):
        return started
    told = started.told()
    stop(started)
    raise ViewerNotStarted(f"{' '.join(command)} did not get ready:\n{told}")


def stop(viewer: ViewerProcess, patience_s: float = 5.0) -> None:
    """End a viewer that was started here, by force if it does not end by itself."""
    viewer.process.terminate()
    try:
        viewer.process.wait(patience_s)
    except subprocess.TimeoutExpired:
        viewer.process.kill()
        viewer.process.wait()
    viewer.output.close()


def free_port() -> int:
    """Return a port of 127.0.0.1 that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _wait_until_ready(process: subprocess.Popen[bytes], port: int) -> bool:
    deadline = time.monotonic() + START_SECONDS
    while process.poll() is None and time.monotonic() < deadline:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=_POLL_SECONDS).close()
        except OSError:
            time.sleep(_POLL_SECONDS)
        else:
            return True
    return False


PATIENCE_S = 120.0
MAGIC = b"RRF"


class MergeFailed(RuntimeError):
    """The files could not be put together; the message says why. Both are as before."""


def merge_into(recording: Path, addition: Path) -> None:
    """Add a recording to another one of the same run; the file is the complete old or the complete new one.

    Raises:
        MergeFailed: one of them is no recording, or there is no viewer's program.
        OSError: one of them cannot be read.
    """
    for path in (recording, addition):
        # The program would leave out what it cannot read, and say that all went well.
        if not is_recording(path):
            raise MergeFailed(f"{path} is no Rerun recording: it does not begin with {MAGIC.decode()!r}")
    temporary = recording.with_name(recording.name + ".part")
    try:
        command = [str(executable()), "rrd", "filter", str(recording), str(addition)]
        done = subprocess.run(
            [*command, "-o", str(temporary)], capture_output=True, timeout=PATIENCE_S, check=False
        )
        if done.returncode != 0 or not is_recording(temporary):
            told = done.stderr.decode(errors="replace").strip().splitlines()[-3:]
            raise MergeFailed(f"{addition} was not added to {recording}: {' / '.join(told)}")
        os.replace(temporary, recording)
    except (ViewerNotStarted, subprocess.TimeoutExpired) as failure:
        raise MergeFailed(f"{addition} was not added to {recording}: {failure}") from failure
    finally:
        temporary.unlink(missing_ok=True)


def is_recording(path: Path) -> bool:
    """Return whether a file begins as a recording does.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC

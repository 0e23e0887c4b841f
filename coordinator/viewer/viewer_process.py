"""The viewer's own program, which comes with the SDK: start it, and merge recordings of one run with it.

It is started with a window, as a web server, or headless. A merge leaves the messages in their order, so that
the file opens with the latest layout. (Of the program's commands `filter` without a filter does that; as of
0.41 `merge` loses the order, and `route` fails on files that it has not written.)
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

from module_agent.model.errors import RobotError

START_SECONDS = 15.0
_POLL_SECONDS, _PROBE_SECONDS = 0.05, 0.5
MERGE_SECONDS = 120.0
# What the server of a page keeps for browsers that come later.
PAGE_MEMORY = "256MB"
MAGIC = b"RRF"
# The reason of a failure is at the end of the output.
REPORTED_LINES = 30


class ViewerProcess(NamedTuple):
    """A viewer that this process has started, and the file with its output."""

    process: subprocess.Popen[bytes]
    output: IO[bytes]

    def output_tail(self) -> str:
        """Return the last lines of its output so far."""
        self.output.seek(0)
        lines = self.output.read().decode(errors="replace").strip().splitlines()
        return "\n".join(lines[-REPORTED_LINES:])


class ViewerNotStarted(RobotError):
    """The viewer's program ended, or did not listen in time; the message contains its output."""


def executable() -> Path:
    """Return the path of the viewer that belongs to the installed SDK.

    Raises:
        ViewerNotStarted: there is none, neither in the SDK nor on the PATH.
    """
    package = importlib.util.find_spec("rerun_cli")
    if package is not None and package.origin is not None:
        bundled = Path(package.origin).parent / "rerun"
        if bundled.is_file():
            return bundled
    on_path = shutil.which("rerun")
    if on_path is None:
        raise ViewerNotStarted("no viewer in the rerun-sdk package nor on the PATH; reinstall rerun-sdk")
    return Path(on_path)


def start(
    options: Sequence[str], port: int, *, detached: bool, page_port: int | None = None
) -> ViewerProcess:
    """Start the viewer, listening for data on `port` of 127.0.0.1, and wait until it does.

    A detached viewer has its own session, so that neither Ctrl-C nor the end of this process ends it. With a
    port for its page it is no window but serves a browser, and is waited for there, too.

    Raises:
        ViewerNotStarted: it ended or was not ready within `START_SECONDS`.
    """
    # By default the viewer listens on all interfaces; a run is shown on this machine only.
    command = [str(executable()), "--bind", "127.0.0.1", "--port", str(port), *options]
    if page_port is not None:
        command += ["--serve-web", "--web-viewer-port", str(page_port), "--server-memory-limit", PAGE_MEMORY]
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
    deadline = time.monotonic() + START_SECONDS
    while process.poll() is None and time.monotonic() < deadline:
        # The page is served a moment after the data are received.
        if listens("127.0.0.1", port) and (page_port is None or listens("127.0.0.1", page_port)):
            return started
        time.sleep(_POLL_SECONDS)
    output_tail = started.output_tail()
    stop(started)
    raise ViewerNotStarted(f"{' '.join(command)} did not get ready:\n{output_tail}")


def stop(viewer: ViewerProcess, patience_s: float = 5.0) -> None:
    """Terminate a viewer that this process has started; kill it if it does not end in time."""
    viewer.process.terminate()
    try:
        viewer.process.wait(patience_s)
    except subprocess.TimeoutExpired:
        viewer.process.kill()
        viewer.process.wait()
    viewer.output.close()


def free_port() -> int:
    """Return a port of 127.0.0.1 that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listens(host: str, port: int) -> bool:
    """Return whether connections are accepted there."""
    try:
        socket.create_connection((host, port), timeout=_PROBE_SECONDS).close()
    except OSError:
        return False
    return True


class MergeFailed(RobotError):
    """The files could not be merged; the message gives the reason. Both are unchanged."""


def merge_into(recording: Path, addition: Path) -> None:
    """Add a recording to another one of the same run, atomically.

    Raises:
        MergeFailed: one of them is not a recording, or the viewer's program is missing or fails.
        OSError: one of them cannot be read.
    """
    for path in (recording, addition):
        # The program skips a file that it cannot read, and reports success.
        if not is_recording(path):
            raise MergeFailed(f"{path} is not a Rerun recording: it does not begin with {MAGIC.decode()!r}")
    temporary = recording.with_name(recording.name + ".part")
    try:
        command = [str(executable()), "rrd", "filter", str(recording), str(addition)]
        done = subprocess.run(
            [*command, "-o", str(temporary)], capture_output=True, timeout=MERGE_SECONDS, check=False
        )
        if done.returncode != 0 or not is_recording(temporary):
            reason = " / ".join(done.stderr.decode(errors="replace").strip().splitlines()[-3:])
            raise MergeFailed(f"{addition} was not added to {recording}: {reason}")
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

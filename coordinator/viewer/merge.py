"""Put recordings of one run together in one file, with the viewer's own program.

The messages stay in their order, so that the file opens with the layout that came last. (Of the program's
commands `filter` with nothing to filter does that; as of 0.41 `merge` loses the order, and `route` fails on
files that it has not written.)
"""

import os
import subprocess
from pathlib import Path

from coordinator.viewer import viewer_process

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
        command = [str(viewer_process.executable()), "rrd", "filter", str(recording), str(addition)]
        done = subprocess.run(
            [*command, "-o", str(temporary)], capture_output=True, timeout=PATIENCE_S, check=False
        )
        if done.returncode != 0 or not is_recording(temporary):
            told = done.stderr.decode(errors="replace").strip().splitlines()[-3:]
            raise MergeFailed(f"{addition} was not added to {recording}: {' / '.join(told)}")
        os.replace(temporary, recording)
    except (viewer_process.ViewerNotStarted, subprocess.TimeoutExpired) as failure:
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

"""Where a recording goes: a file, a viewer on this machine, a viewer elsewhere."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import urlsplit

from coordinator.viewer import viewer_process
from coordinator.viewer.scene import entity_paths
from module_agent.model.errors import UsageError

if TYPE_CHECKING:
    import rerun as rr

NATIVE_PORT = 9876
# Of pages served to a browser; their data are on the next one. (9090 is where rosbridge listens.)
SERVE_PORT = 9878
SCHEMES = ("rerun", "rerun+http", "rerun+https")
# Rows that are logged one by one, such as estimates, share a chunk of a file for this long.
FILE_TICK_SECONDS = 10.0

logger = logging.getLogger(__name__)


class ViewerTargets(NamedTuple):
    """Where to send a recording; any may be left out.

    rrd: file to write, which is complete whatever happens to the live viewers.
    spawn: start a native viewer (or use the one that listens already) and leave it open at the end.
    connect: gRPC address of a running viewer or page, such as `rerun+http://127.0.0.1:9876/proxy`.
    """

    rrd: Path | None = None
    spawn: bool = False
    connect: str | None = None


def viewer_choice(text: str, serve_port: int = SERVE_PORT) -> ViewerTargets:
    """Parse `none`, `spawn`, `serve` or an address; served are the data of the page on a port (`Page`).

    Raises:
        UsageError: none of these; the message lists what is allowed.
    """
    if text in ("none", "spawn"):
        return ViewerTargets(spawn=text == "spawn")
    if text == "serve":
        return ViewerTargets(connect=proxy_url(serve_port + 1))
    scheme, separator, rest = text.partition("://")
    if scheme not in SCHEMES or not separator or not rest:
        raise UsageError(
            f"--viewer {text}: it must be none, spawn, serve or an address like {proxy_url(NATIVE_PORT)}"
        )
    return ViewerTargets(connect=text)


class Opened(NamedTuple):
    """The streams that the targets need.

    A file gets few large chunks and a live viewer small ones at once, so they have a stream each, of the same
    recording.
    """

    file: "rr.RecordingStream | None" = None
    live: "rr.RecordingStream | None" = None


def open_targets(run_id: str, targets: ViewerTargets) -> Opened:
    """Open the targets; a live viewer that cannot be reached is reported and left out.

    Raises:
        OSError: the file cannot be written.
    """
    if targets == ViewerTargets():
        return Opened()
    import rerun as rr

    file = live = None
    if targets.rrd is not None:
        targets.rrd.parent.mkdir(parents=True, exist_ok=True)
        targets.rrd.open("wb").close()  # raises the error of the system if it cannot be written
        batching = rr.ChunkBatcherConfig(flush_tick=FILE_TICK_SECONDS)
        file = rr.RecordingStream(entity_paths.APPLICATION_ID, recording_id=run_id, batcher_config=batching)
        file.set_sinks(rr.FileSink(str(targets.rrd)))
    urls = [targets.connect]
    if targets.spawn:
        native = viewer_process.listens("127.0.0.1", NATIVE_PORT) or _started_native()
        urls.insert(0, proxy_url(NATIVE_PORT) if native else None)
    reached = [url for url in dict.fromkeys(urls) if url is not None and _reachable(url)]
    if reached:
        live = rr.RecordingStream(entity_paths.APPLICATION_ID, recording_id=run_id)
        live.set_sinks(*(rr.GrpcSink(url) for url in reached))
    return Opened(file, live)


def proxy_url(port: int) -> str:
    """Return the address of a viewer on this machine."""
    return f"rerun+http://127.0.0.1:{port}/proxy"


def _reachable(url: str) -> bool:
    parts = urlsplit(url)
    if parts.scheme not in SCHEMES or parts.hostname is None:
        logger.warning("%r is no viewer's address; one looks like %r", url, proxy_url(NATIVE_PORT))
        return False
    # Attaching a sink blocks for seconds if nothing listens there.
    if viewer_process.listens(parts.hostname, parts.port or NATIVE_PORT):
        return True
    logger.warning("no viewer listens at %s, so the run is not shown there", url)
    return False


def _started_native() -> bool:
    """Start a viewer with a window, which outlives this process; return whether there is one."""
    try:
        viewer_process.start([], NATIVE_PORT, detached=True)
    except viewer_process.ViewerNotStarted as failure:
        logger.warning("the native viewer did not start, so the run is not shown there: %s", failure)
        return False
    return True

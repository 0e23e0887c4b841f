"""Where a recording goes: a file, a viewer on this machine, a viewer elsewhere, a web page."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote, urlsplit

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
    connect: gRPC address of a running viewer, such as `rerun+http://127.0.0.1:9876/proxy`.
    serve_port: serve a web page on this port of 127.0.0.1 and its data on the next one, until the run ends.
    """

    rrd: Path | None = None
    spawn: bool = False
    connect: str | None = None
    serve_port: int | None = None


def viewer_choice(text: str, serve_port: int | None = None) -> ViewerTargets:
    """Parse `none`, `spawn`, `serve` (on a port) or an address.

    Raises:
        UsageError: none of these; the message lists what is allowed.
    """
    if text in ("none", "spawn", "serve"):
        return ViewerTargets(spawn=text == "spawn", serve_port=serve_port if text == "serve" else None)
    scheme, separator, rest = text.partition("://")
    if scheme not in SCHEMES or not separator or not rest:
        raise UsageError(
            f"--viewer {text}: it must be none, spawn, serve or an address like {proxy_url(NATIVE_PORT)}"
        )
    return ViewerTargets(connect=text)


class Opened(NamedTuple):
    """The streams that the targets need, and the web server to stop at the end of the run.

    A file gets few large chunks and a live viewer small ones at once, so they have a stream each, of the same
    recording.
    """

    file: "rr.RecordingStream | None" = None
    live: "rr.RecordingStream | None" = None
    web_server: viewer_process.ViewerProcess | None = None


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
    urls, web_server, port = [targets.connect], None, targets.serve_port
    if targets.spawn:
        native = viewer_process.listens("127.0.0.1", NATIVE_PORT) or _started("native", NATIVE_PORT)
        urls.insert(0, proxy_url(NATIVE_PORT) if native else None)
    if port is not None:
        web_server = _started("web", port + 1, page_port=port)
    if port is not None and web_server is not None:
        urls.append(proxy_url(port + 1))
        logger.info("open %s in a browser", page_url(port))
    reached = [url for url in dict.fromkeys(urls) if url is not None and _reachable(url)]
    if reached:
        live = rr.RecordingStream(entity_paths.APPLICATION_ID, recording_id=run_id)
        live.set_sinks(*(rr.GrpcSink(url) for url in reached))
    return Opened(file, live, web_server)


def proxy_url(port: int) -> str:
    """Return the address of a viewer on this machine."""
    return f"rerun+http://127.0.0.1:{port}/proxy"


def page_url(port: int) -> str:
    """Return the address of a page served on a port; without that of its data the page is empty."""
    return f"http://127.0.0.1:{port}?url={quote(proxy_url(port + 1), safe='')}"


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


def _started(which: str, port: int, page_port: int | None = None) -> viewer_process.ViewerProcess | None:
    """Start a viewer; only the native one outlives this process."""
    try:
        return viewer_process.start([], port, detached=which == "native", page_port=page_port)
    except viewer_process.ViewerNotStarted as failure:
        logger.warning("the %s viewer did not start, so the run is not shown there: %s", which, failure)
        return None

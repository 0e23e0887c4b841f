"""`x5-coordinator view`: a finished run in the viewer, on this screen or in a browser."""

import os
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from coordinator.recording.run_folder import VIEW
from coordinator.runtime.command_line import CommandFailed
from coordinator.runtime.event_loop import SIGNALS
from coordinator.viewer import viewer_process
from coordinator.viewer.targets import SERVE_PORT, page_url
from module_agent.model.errors import EXIT_FAILED, UsageError

_POLL_S = 0.2
# Without one of these there is no window on Linux.
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")


def view(
    run: Annotated[Path, typer.Argument(help="Folder of a run, or a session.rrd.")],
    serve: Annotated[bool, typer.Option("--serve", help="Serve it to a browser, until Ctrl-C.")] = False,
    port: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=65534,
            help=f"With --serve, port of the page; the next one has the data [{SERVE_PORT}].",
        ),
    ] = None,
) -> None:
    """Show the recording of a run; the viewer's window stays open, a served page until Ctrl-C."""
    recording = run / VIEW if run.is_dir() else run
    if not recording.is_file():
        raise UsageError(f"{recording}: there is no such recording; a run writes {VIEW} into its folder")
    if not viewer_process.is_recording(recording):
        raise UsageError(f"{recording} is not a Rerun recording: it does not begin with 'RRF'")
    if port is not None and not serve:
        raise UsageError("--port is that of a served page: add --serve")
    if not serve and sys.platform == "linux" and not any(map(os.environ.get, _DISPLAYS)):
        raise UsageError("there is no screen here; add --serve, or use x5-coordinator screenshot")
    port = SERVE_PORT if port is None else port
    if not serve:
        viewer_process.start([str(recording)], viewer_process.free_port(), detached=True)
        return
    for taken in (port, port + 1):
        if viewer_process.listens("127.0.0.1", taken):
            raise UsageError(f"--port {port}: something listens on port {taken} already; choose another")
    served = viewer_process.start([str(recording)], port + 1, detached=False, page_port=port)
    typer.echo(f"open {page_url(port)} in a browser; Ctrl-C ends it")
    ended = threading.Event()
    for number in SIGNALS:
        signal.signal(number, lambda *_: ended.set())
    try:
        while not ended.wait(_POLL_S):
            if served.process.poll() is not None:
                raise CommandFailed(f"the viewer ended: {served.output_tail()}", EXIT_FAILED)
    finally:
        viewer_process.stop(served)

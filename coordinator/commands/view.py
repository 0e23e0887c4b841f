"""`x5-coordinator view`: a finished run on this screen or in a browser; and the page of a live run."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from coordinator.recording.run_folder import view_of
from coordinator.runtime.event_loop import SIGNALS
from coordinator.viewer import viewer_process
from coordinator.viewer.page import Page
from coordinator.viewer.targets import SERVE_PORT
from module_agent.model.errors import UsageError

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
    recording = view_of(run)
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
    with Page(port, [str(recording)]) as page:
        typer.echo(f"open {page.url} in a browser; Ctrl-C ends it")
        _serve_until_signal(page)


@contextmanager
def live_page(viewer: str, port: int) -> Iterator[Callable[[], None]]:
    """Serve a page to what is shown within the block, if the viewer is `serve`, and say where it is.

    Quiet programs say it as well: without the address there is nothing to see. Yields what goes on serving
    the page until a signal, to be called when all else is done; without a page it does nothing.

    Raises:
        UsageError, ViewerNotStarted: as `Page`.
    """
    if viewer != "serve":
        yield lambda: None
        return
    with Page(port) as page:
        typer.echo(f"open {page.url} in a browser", err=True)

        def stay() -> None:
            typer.echo(f"the run has ended; {page.url} shows it until Ctrl-C", err=True)
            _serve_until_signal(page)

        yield stay


def _serve_until_signal(page: Page) -> None:
    """Go on serving a page until a signal comes, which ends that and nothing else.

    Raises:
        PageEnded: it is not served any more.
    """
    ended = threading.Event()
    for number in SIGNALS:
        signal.signal(number, lambda *_: ended.set())
    while not ended.wait(_POLL_S):
        page.check()

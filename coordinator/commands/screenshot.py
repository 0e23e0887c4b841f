"""`x5-coordinator screenshot`: a picture of a recording as the viewer shows it."""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.recording.run_folder import view_of
from coordinator.viewer.screenshot import screenshot as picture


def screenshot(
    run: Annotated[Path, typer.Argument(help="Folder of a run, or a session.rrd.")],
    out: Annotated[Path, typer.Option(help="PNG file to write.")],
    tab: Annotated[str | None, typer.Option(help="Tab to show.")] = None,
    at: Annotated[
        float | None,
        typer.Option(min=0.0, metavar="SECONDS", help="Time of the session to show; by default its end."),
    ] = None,
) -> None:
    """Render a recording as the viewer shows it, without a screen."""
    picture(view_of(run), out, tab, at_s=at)

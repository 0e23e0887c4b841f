"""`x5-coordinator replay`: a result computed again from its recording."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from coordinator.baseline.baseline_robot import baseline_within
from coordinator.baseline.update import updated
from coordinator.commands.run import print_result
from coordinator.identification.identify import identify
from coordinator.recording.run_folder import load_recording
from coordinator.runtime.terminal import Terminal
from coordinator.session.run import write_outputs


def replay(
    session: Annotated[Path, typer.Argument(help="A session.mcap.")],
    out: Annotated[Path | None, typer.Option(help="Folder for result.json [folder of the session].")] = None,
) -> None:
    """Compute the result of a run again from its recording, without a robot."""
    folder = out if out is not None else session.parent
    recording = load_recording(session)
    before = baseline_within(session.parent)
    identified = identify(recording, partial(updated, before) if before is not None else None)
    folder.mkdir(parents=True, exist_ok=True)
    write_outputs(folder, identified)
    print_result(identified.result, Terminal())

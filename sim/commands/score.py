"""`x5-sim score`: a run's result against the simulator's truth."""

from pathlib import Path
from typing import Annotated

import typer

from coordinator.runtime.exit_codes import EXIT_FAILED
from coordinator.runtime.terminal import print_table
from sim.commands.options import fail
from sim.scoring.score import ScoreError, score, table, write_score


def score_run(
    folder: Annotated[Path, typer.Argument(help="Folder of a run.")],
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable.")] = False,
) -> None:
    """Compare a run's result with the simulator's truth."""
    print_score(folder, as_json)


def print_score(folder: Path, as_json: bool = False) -> None:
    """Score a run, write `score.json` into its folder and print it, or end the command."""
    try:
        found = score(folder)
    except ScoreError as error:
        fail(error, EXIT_FAILED)
    write_score(folder / "score.json", found)
    if as_json:
        typer.echo((folder / "score.json").read_text())
    else:
        print_table(table(found))

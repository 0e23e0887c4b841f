"""What runs say together of the parts of their modules: `merged.json`, and a table."""

import os
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict
from rich.table import Table

from coordinator.merge.merge_runs import MergedInformation, RunShare

SCHEMA = 1
MERGED = "merged.json"
# As of a run's own parameters.
IDENTIFIED_BELOW = 0.1


class Piece(BaseModel):
    """A piece of the report."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class SumPart(Piece):
    """One base parameter of the parts: its sum in words, value, and standard deviation relative to it."""

    words: str
    value: float
    relative_sigma: float | None


class RunPart(Piece):
    """One run: what it tells by itself, and what all tell of the same sums.

    identified: how many of its sums have a relative standard deviation below a tenth, by itself and by all.
    gain: median of sigma by all over sigma alone. strain: how far all are off from it, in its own standard
    deviations, root mean square.
    """

    run: str
    serials: list[str]
    rank: int
    identified_alone: int
    identified_merged: int
    gain: float
    inconsistency_sigma: float


class MergeReport(Piece):
    """All runs together. gain: as of a run, over all of them."""

    schema_version: int = SCHEMA
    parts: list[str]
    parameters: int
    rank: int
    gain: float
    runs: list[RunPart]
    sums: list[SumPart]


def merge_report(found: MergedInformation) -> MergeReport:
    """Return the report of merged runs."""
    base = found.base
    relative = base.relative_sigma
    return MergeReport(
        parts=[part.name for part in found.parts],
        parameters=len(base.columns.names),
        rank=base.rank,
        gain=found.gain,
        runs=[_run(run) for run in found.runs],
        sums=[
            SumPart(
                words=base.words(i),
                value=float(base.value[i]),
                relative_sigma=float(relative[i]) if np.isfinite(relative[i]) else None,
            )
            for i in range(base.rank)
        ],
    )


def _run(run: RunShare) -> RunPart:
    size = np.abs(run.base.value) * IDENTIFIED_BELOW
    return RunPart(
        run=run.name,
        serials=list(run.serials),
        rank=run.base.rank,
        identified_alone=int(np.sum(run.sigma_alone < size)),
        identified_merged=int(np.sum(run.sigma_merged < size)),
        gain=run.gain,
        inconsistency_sigma=run.inconsistency_sigma,
    )


def table(report: MergeReport) -> Table:
    """Return the runs in rows."""
    title = f"{report.rank} of {report.parameters} parameters of {len(report.parts)} parts"
    found = Table(
        "run", "modules", "rank", "below 10 %", "so by all", "sigma by all / alone", "strain", title=title
    )
    for run in report.runs:
        found.add_row(
            run.run,
            ", ".join(run.serials),
            str(run.rank),
            str(run.identified_alone),
            str(run.identified_merged),
            f"{run.gain:.2f}",
            f"{run.inconsistency_sigma:.1f}",
        )
    found.add_row("together", "", str(report.rank), "", "", f"{report.gain:.2f}", "")
    return found


def write_report(path: Path, report: MergeReport) -> None:
    """Write the report, whole or not at all."""
    temporary = path.with_suffix(".part")
    temporary.write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, path)

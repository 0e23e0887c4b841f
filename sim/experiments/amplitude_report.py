"""The amplitude experiment's results as files, and beside the thesis' own figures."""

import csv
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.table import Table

from sim.experiments.amplitude_sweep import Trial
from sim.experiments.thesis_lengths import Alignment, ThesisLength, thesis_length


class Repeats(NamedTuple):
    """Repeated trials on one arm at the thesis' amplitude; scatter is one standard deviation of a trial."""

    thesis: ThesisLength
    trials: int
    true_mm: float
    mean_mm: float
    scatter_mm: float

    @property
    def error_mm(self) -> float:
        """The mean's error, positive where it is too long."""
        return self.mean_mm - self.true_mm


def repeats(trials: Sequence[Trial], filtered: bool = True) -> list[Repeats]:
    """Summarise the repeated trials, arm by arm, in the order in which they come.

    An arm on which no trial gave an estimate is left out.
    """
    arms: dict[tuple[Alignment, int], list[Trial]] = {}
    for trial in trials:
        if trial.purpose == "repeats":
            arms.setdefault((trial.alignment, trial.length_mm), []).append(trial)
    found = []
    for (alignment, length), own in arms.items():
        estimates = [t.estimated_mm if filtered else t.unfiltered_mm for t in own]
        known = np.array([e for e in estimates if e is not None])
        if known.size:
            mean, scatter = float(known.mean()), float(known.std(ddof=min(1, known.size - 1)))
            thesis = thesis_length(alignment, length)
            found.append(Repeats(thesis, known.size, own[0].true_mm, mean, scatter))
    return found


def table(found: Sequence[Repeats], filtered: bool = True) -> Table:
    """Return tables 4 and 5 of the thesis with the simulated figures beside, to print."""
    how = "" if filtered else ", without the filter"
    shown = Table(title=f"Repeated trials at the thesis' amplitudes{how}")
    columns = ("arm", "A [rad]", "trials", "mean [mm]", "error [mm]", "error [%]", "scatter [mm]")
    for name in (*columns, "thesis' mean [mm]", "its error [%]"):
        shown.add_column(name, justify="left" if name == "arm" else "right")
    for row in found:
        thesis = row.thesis
        shown.add_row(
            f"{thesis.length_mm} mm {thesis.alignment}",
            f"{thesis.amplitude_rad:.2f}",
            str(row.trials),
            f"{row.mean_mm:.1f}",
            f"{row.error_mm:+.1f}",
            f"{100 * row.error_mm / row.true_mm:+.1f}",
            f"{row.scatter_mm:.1f}",
            f"{thesis.mean_mm:.1f}",
            f"{100 * (thesis.mean_mm / thesis.length_mm - 1):+.1f}",
        )
    return shown


def write_results(folder: Path, settings: dict[str, object], trials: Sequence[Trial]) -> None:
    """Write `amplitudes.json` (settings, all trials, both summaries) and `amplitudes.csv` (all trials).

    Each file is the complete old or the complete new one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    document = {
        **settings,
        "trials": [trial._asdict() for trial in trials],
        "repeats": [_plain(row) for row in repeats(trials)],
        "repeats_unfiltered": [_plain(row) for row in repeats(trials, filtered=False)],
    }
    _replace(folder / "amplitudes.json", json.dumps(document, indent=1, allow_nan=False) + "\n")
    temporary = folder / "amplitudes.csv.part"
    with temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Trial._fields)
        writer.writerows(trials)
    os.replace(temporary, folder / "amplitudes.csv")


def _plain(row: Repeats) -> dict[str, object]:
    return {**row.thesis._asdict(), "thesis_mean_mm": row.thesis.mean_mm} | {
        "trials": row.trials,
        "true_mm": row.true_mm,
        "mean_mm": row.mean_mm,
        "error_mm": row.error_mm,
        "scatter_mm": row.scatter_mm,
    }


def _replace(path: Path, text: str) -> None:
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)

"""What came of comparing estimators: one row for each arm and estimator, to print and as JSON."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.table import Table

from sim.experiments.estimator_variants import VARIANTS, Comparison
from sim.experiments.thesis_lengths import Alignment

# Of a normal error 95 in 100 are within this many standard deviations.
_WITHIN = 1.96


class Arm(NamedTuple):
    """One of the thesis' arms."""

    alignment: Alignment
    length_mm: int


class EstimatorRow(NamedTuple):
    """An estimator on an arm: figures over all trials, lengths in millimetres.

    ratio: rms error over the bound, both over all trials. covered: the share of 95 % intervals that hold the
    truth.
    """

    alignment: Alignment
    length_mm: int
    estimator: str
    trials: int
    mean_error_mm: float
    bias_mm: float
    rms_mm: float
    sigma_mm: float
    bound_mm: float
    ratio: float
    covered: float


def estimator_rows(arm: Arm, comparisons: Sequence[Comparison]) -> list[EstimatorRow]:
    """Return a row for every estimator that found something in any trial of an arm."""
    bound = _rms(np.array([each.bound_m for each in comparisons]))
    rows = []
    for name in VARIANTS:
        found = [each.found[name] for each in comparisons if name in each.found]
        if not found:
            continue
        error, sigma = np.array(found).T
        rows.append(
            EstimatorRow(
                arm.alignment,
                arm.length_mm,
                name,
                len(found),
                1e3 * float(np.abs(error).mean()),
                1e3 * float(error.mean()),
                1e3 * _rms(error),
                1e3 * _rms(sigma),
                1e3 * bound,
                _rms(error) / bound,
                float(np.mean(np.abs(error) < _WITHIN * sigma)),
            )
        )
    return rows


def estimator_table(rows: Sequence[EstimatorRow]) -> Table:
    """Return the rows as a table, a section for each arm."""
    titles = (
        "arm",
        "estimator",
        "trials",
        "mean |e|",
        "bias",
        "rms",
        "sigma",
        "bound",
        "rms / bound",
        "in 95 %",
    )
    shown = Table(*titles, title="Errors of the radial distance [mm]")
    for row, following in zip(rows, [*rows[1:], None], strict=True):
        last = following is None or (following.alignment, following.length_mm) != (
            row.alignment,
            row.length_mm,
        )
        shown.add_row(
            f"{row.length_mm} mm {row.alignment}",
            row.estimator,
            str(row.trials),
            *(f"{value:.3f}" for value in (row.mean_error_mm, row.bias_mm, row.rms_mm, row.sigma_mm)),
            f"{row.bound_mm:.3f}",
            f"{row.ratio:.2f}",
            f"{100.0 * row.covered:.0f} %",
            end_section=last,
        )
    return shown


def write_estimators(path: Path, settings: dict[str, object], rows: Sequence[EstimatorRow]) -> None:
    """Write settings and rows as JSON.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps({"settings": settings, "rows": [row._asdict() for row in rows]}, indent=2)
    path.write_text(text + "\n", encoding="utf-8")


def _rms(values: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]") -> float:
    return float(np.sqrt(np.mean(values**2)))

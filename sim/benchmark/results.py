"""What a benchmark found, as JSON: whole or not at all."""

import json
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from sim.benchmark.case import CaseResult
from sim.benchmark.row import Row

SCHEMA = 1
_MEASURED_WITH = ("x5-self-model", "numpy", "scipy", "numba", "pybullet")


class Cost(NamedTuple):
    """The processor time of a case's trials."""

    case: str
    trials: int
    cpu_time_s: float


class Results(NamedTuple):
    """The rows of a benchmark, what failed in words, what was asked for, and what it cost."""

    benchmark: str
    settings: dict[str, object]
    rows: tuple[Row, ...]
    failures: tuple[str, ...]
    costs: tuple[Cost, ...]
    wall_time_s: float

    @property
    def cpu_time_s(self) -> float:
        """Processor time of all trials."""
        return sum(cost.cpu_time_s for cost in self.costs)

    @property
    def missed(self) -> tuple[Row, ...]:
        """The rows whose bar is not met."""
        return tuple(row for row in self.rows if row.holds is False)


def gathered(
    benchmark: str,
    settings: dict[str, object],
    cases: Sequence[CaseResult],
    over_all: Sequence[Row],
    wall_time_s: float,
) -> Results:
    """Put the rows of all cases together, those over all of them last."""
    rows = [row for case in cases for row in case.summary.rows]
    failures = tuple(f"{case.case}: {text}" for case in cases for text in case.failures)
    costs = tuple(Cost(case.case, case.trials, round(case.cpu_s, 2)) for case in cases)
    return Results(benchmark, settings, (*rows, *over_all), failures, costs, wall_time_s)


def write_results(path: Path, results: Results) -> None:
    """Write the results as JSON; the file is the complete old or the complete new one."""
    document = {
        "schema": SCHEMA,
        "benchmark": results.benchmark,
        "settings": results.settings,
        "versions": {"python": platform.python_version()} | {name: version(name) for name in _MEASURED_WITH},
        "rows": [row.plain() for row in results.rows],
        "failures": list(results.failures),
        "costs": [cost._asdict() for cost in results.costs],
        "wall_time_s": results.wall_time_s,
    }
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)

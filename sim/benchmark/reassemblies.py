"""Modules that share the work: what agents gathered, and what three assemblies tell together."""

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from sim.benchmark.case import Case, Summary, Trial, trial_seed
from sim.benchmark.row import Row, largest
from sim.experiments.reassembly import ROBOT, Reassembly, reassembly_trial

AGREES_BELOW = 1e-10
_COST_S = 10.0


def reassembly_cases(trials: int, seed: int) -> list[Case]:
    """Return the one case: an arm as it is, on a wall, and with its modules in another order."""
    name = f"{ROBOT}, three assemblies"
    work = tuple(
        Trial(reassembly_in_folder, (trial_seed(seed, name, number),), _COST_S) for number in range(trials)
    )
    return [Case(name, work, partial(_summary, name))]


def reassembly_in_folder(seed: int) -> Reassembly:
    """Run a trial in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        return reassembly_trial(seed, Path(folder))


def _summary(case: str, trials: Sequence[Reassembly]) -> Summary:
    gained = [max(t.rank_alone) - t.rank_merged for t in trials]
    rows = (
        Row(
            case,
            "agents' information against the coordinator's [relative]",
            None,
            largest([t.difference for t in trials]),
            None,
            AGREES_BELOW,
        ),
        Row(case, "rank of the best alone less that of all merged", None, _most(gained), None, -1.0),
        Row(case, "rank of all merged", None, _least([t.rank_merged for t in trials])),
        Row(
            case,
            "standard deviations merged over alone, median",
            None,
            _most([t.sigma_ratio for t in trials]),
            None,
            1.0,
        ),
    )
    return Summary(rows)


def _most(values: Sequence[float]) -> float | None:
    return float(max(values)) if values else None


def _least(values: Sequence[float]) -> float | None:
    return float(min(values)) if values else None

"""The benchmark of dynamics: its cases, and what holds over all of them."""

from pathlib import Path
from typing import NamedTuple

from sim.benchmark.assistances import assistance_cases
from sim.benchmark.case import Case
from sim.benchmark.floats import float_cases
from sim.benchmark.inertias import inertia_cases
from sim.benchmark.payloads import payload_cases
from sim.benchmark.reassemblies import reassembly_cases
from sim.benchmark.recorded import recorded_cases
from sim.benchmark.regressors import regressor_cases
from sim.benchmark.watches import watch_cases

DYNAMIC_TRIALS = 5


class DynamicEffort(NamedTuple):
    """How many trials there are of everything; `shortened`: whether robots move less long than they may."""

    inertias: int
    payloads: int
    reassemblies: int
    floats: int
    watches: int
    stretches: int
    shortened: bool = False


QUICK_DYNAMICS = DynamicEffort(1, 1, 1, 1, 1, 1, shortened=True)


def full_dynamics(trials: int = DYNAMIC_TRIALS) -> DynamicEffort:
    """Return the effort with that many trials a case, and an hour of watching without any change."""
    return DynamicEffort(trials, trials, trials, trials, watches=2 * trials, stretches=12)


def dynamic_cases(effort: DynamicEffort, seed: int, tx40: Path | None = None) -> list[Case]:
    """Return all cases, in the order in which they are reported; tx40: folder of a real arm's recording."""
    return [
        *regressor_cases(seed),
        *inertia_cases(effort.inertias, seed, effort.shortened),
        *reassembly_cases(effort.reassemblies, seed),
        *payload_cases(effort.payloads, seed, effort.shortened),
        *assistance_cases(seed, effort.shortened),
        *float_cases(effort.floats, seed, effort.shortened),
        *watch_cases(effort.watches, effort.stretches, seed, effort.shortened),
        *([] if tx40 is None else recorded_cases(tx40)),
    ]

"""`x5-sim estimators`: the thesis' estimator and variants of the joint regression on the same recordings."""

from collections.abc import Sequence
from typing import Annotated

import typer
from rich.table import Table

from coordinator.runtime.command_line import with_options
from coordinator.runtime.terminal import new_table, print_table
from module_agent.model.files import write_json
from sim.benchmark.case import Trial
from sim.commands.experiment import JsonFile, ModuleOptions, WorkerCount, experiment, trial_results
from sim.imperfections.noise_profile import NoiseProfile
from sim.thesis.kinematics.estimator_variants import Arm, EstimatorRow, compare, estimator_rows
from sim.thesis.published import ALIGNMENTS, LENGTHS_MM, TRIALS

ARMS = tuple(Arm(alignment, length_mm) for alignment in ALIGNMENTS for length_mm in LENGTHS_MM)
_COST_S = 2.0


@with_options
def estimators(
    modules: ModuleOptions,
    trials: Annotated[
        int, typer.Option(min=1, help="Trials for each arm, each with other modules.")
    ] = TRIALS,
    processes: WorkerCount = None,
    json_file: JsonFile = None,
) -> None:
    """Compare estimators of one joint's radial distance on the thesis' eight arms, and their bound."""
    rows = _run(modules.profile(), trials, modules.seed, processes)
    print_table(estimator_table(rows))
    if json_file is not None:
        settings = {**modules.settings(), "trials": trials}
        write_json(json_file, {"settings": settings, "rows": [row._asdict() for row in rows]})


def _run(profile: NoiseProfile, trials: int, seed: int, processes: int | None) -> list[EstimatorRow]:
    work = [
        Trial(compare, (arm.length_mm, arm.alignment, profile, seed * 1000 + number), _COST_S)
        for arm in ARMS
        for number in range(trials)
    ]

    def label(index: int) -> str:
        arm = ARMS[index // trials]
        return f"{arm.length_mm} mm {arm.alignment}"

    with experiment() as terminal:
        results = trial_results(terminal, work, processes, label)
    return [
        row
        for place, arm in enumerate(ARMS)
        for row in estimator_rows(arm, results[place * trials : (place + 1) * trials])
    ]


def estimator_table(rows: Sequence[EstimatorRow]) -> Table:
    """Return the rows as a table, a section for each arm."""
    shown = new_table(
        "Errors of the radial distance [mm]",
        "arm | estimator | trials | mean |e| | bias | rms | sigma | bound | rms / bound | in 95 %",
    )
    arms = [f"{row.length_mm} mm {row.alignment}" for row in rows]
    for row, arm, following in zip(rows, arms, [*arms[1:], ""], strict=True):
        shown.add_row(
            arm,
            row.estimator,
            str(row.trials),
            *(f"{value:.3f}" for value in (row.mean_error_mm, row.bias_mm, row.rms_mm, row.sigma_mm)),
            f"{row.bound_mm:.3f}",
            f"{row.ratio:.2f}",
            f"{100.0 * row.covered:.0f} %",
            end_section=following != arm,
        )
    return shown

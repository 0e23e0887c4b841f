"""`x5-sim estimators`: the thesis' estimator and variants of the joint regression on the same recordings."""

from collections.abc import Sequence
from typing import Annotated

import typer
from rich.table import Table

from coordinator.runtime.command_line import fail
from coordinator.runtime.terminal import print_table
from module_agent.model.errors import EXIT_FAILED
from sim.benchmark.case import Trial
from sim.commands.experiment import (
    JsonFile,
    ProfileName,
    WorkerCount,
    check_writable,
    chosen_profile,
    experiment,
    profile_settings,
    trial_results,
)
from sim.commands.options import Seed, With, Without
from sim.imperfections.noise_profile import NoiseProfile
from sim.thesis.estimator_variants import Arm, EstimatorRow, compare, estimator_rows, write_estimators
from sim.thesis.published import ALIGNMENTS, LENGTHS_MM, TRIALS

ARMS = tuple(Arm(alignment, length_mm) for alignment in ALIGNMENTS for length_mm in LENGTHS_MM)
_COST_S = 2.0


def estimators(
    seed: Seed = 0,
    noise: ProfileName = "x5",
    with_effects: With = None,
    without_effects: Without = None,
    trials: Annotated[
        int, typer.Option(min=1, help="Trials for each arm, each with other modules.")
    ] = TRIALS,
    processes: WorkerCount = None,
    json_file: JsonFile = None,
) -> None:
    """Compare estimators of one joint's radial distance on the thesis' eight arms, and their bound."""
    profile = chosen_profile(noise, with_effects, without_effects)
    check_writable(json_file)
    rows = _run(profile, trials, seed, processes)
    print_table(estimator_table(rows))
    settings = {"seed": seed} | profile_settings(noise, with_effects, without_effects) | {"trials": trials}
    if json_file is not None:
        try:
            write_estimators(json_file, settings, rows)
        except OSError as error:
            fail(f"cannot write {json_file}: {error.strerror or error}", EXIT_FAILED)


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

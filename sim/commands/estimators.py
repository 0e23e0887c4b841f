"""`x5-sim estimators`: the thesis' estimator and variants of the joint regression on the same recordings."""

import os
import signal
from pathlib import Path
from typing import Annotated, Any

import typer

from coordinator.runtime.event_loop import SIGNALS
from coordinator.runtime.exit_codes import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE
from coordinator.runtime.terminal import Terminal, print_table
from sim.benchmark.case import Failed, Trial
from sim.benchmark.workers import run_trials
from sim.commands.options import Seed, With, Without, fail
from sim.imperfections.noise_profile import NOISE_PROFILES, NoiseProfile, noise_profile, switched
from sim.robot.noise_choice import NoiseChoice
from sim.thesis.estimator_variants import (
    Arm,
    EstimatorRow,
    compare,
    estimator_rows,
    estimator_table,
    write_estimators,
)
from sim.thesis.published import ALIGNMENTS, LENGTHS_MM, TRIALS

ARMS = tuple(Arm(alignment, length_mm) for alignment in ALIGNMENTS for length_mm in LENGTHS_MM)
_COST_S = 2.0


def estimators(
    seed: Seed = 0,
    noise: Annotated[str, typer.Option(help=f"Noise profile: {', '.join(NOISE_PROFILES)}.")] = "x5",
    with_effects: With = None,
    without_effects: Without = None,
    trials: Annotated[
        int, typer.Option(min=1, help="Rigs of other modules an arm, one trial on each.")
    ] = TRIALS,
    processes: Annotated[
        int | None, typer.Option(min=1, help="Processes that share the work [one for each core].")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the table as JSON too.")] = None,
) -> None:
    """Compare estimators of one joint's radial distance on the thesis' eight arms, and their bound."""
    choice = NoiseChoice(noise, tuple(with_effects or ()), tuple(without_effects or ()))
    profile = _profile(choice)
    if json_file is not None and not json_file.parent.is_dir():
        fail(f"{json_file}: there is no folder {json_file.parent}", EXIT_USAGE)
    rows = _run(profile, trials, seed, processes or os.cpu_count() or 1)
    print_table(estimator_table(rows))
    settings: dict[str, object] = {
        "seed": seed,
        "noise": noise,
        "with": list(choice.on),
        "without": list(choice.off),
        "trials": trials,
    }
    if json_file is not None:
        try:
            write_estimators(json_file, settings, rows)
        except OSError as error:
            fail(f"cannot write {json_file}: {error.strerror or error}", EXIT_FAILED)


def _profile(choice: NoiseChoice) -> NoiseProfile:
    try:
        return switched(noise_profile(str(choice.profile)), choice.on, choice.off)
    except (KeyError, ValueError) as error:
        fail(error.args[0], EXIT_USAGE)


def _run(profile: NoiseProfile, trials: int, seed: int, processes: int) -> list[EstimatorRow]:
    work = [
        Trial(compare, (arm.length_mm, arm.alignment, profile, seed * 1000 + number), _COST_S)
        for arm in ARMS
        for number in range(trials)
    ]
    done = 0

    def show(index: int, result: Any) -> None:
        nonlocal done
        done += 1
        arm = ARMS[index // trials]
        terminal.step(done, len(work), f"{arm.length_mm} mm {arm.alignment}")

    # Processes that share the cores already must not each start as many threads; they inherit this.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        with Terminal() as terminal:
            results = [found.result for found in run_trials(work, processes, show)]
    except KeyboardInterrupt:
        fail("interrupted; nothing is written", EXIT_INTERRUPTED)
    for failure in (found for found in results if isinstance(found, Failed)):
        fail(failure.text, EXIT_FAILED)
    return [
        row
        for place, arm in enumerate(ARMS)
        for row in estimator_rows(arm, results[place * trials : (place + 1) * trials])
    ]

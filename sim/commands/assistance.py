"""`x5-sim assistance`: the thesis' torque assistance on simulated arms, by what they identify themselves."""

import os
import signal
from collections.abc import Sequence
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
from sim.thesis.torque_assistance import MODES, Model, identified_model, standing_robot
from sim.thesis.torque_assistance_cases import Case, Combination, cases, robots_of, try_case
from sim.thesis.torque_assistance_report import (
    assistance_table,
    bar_lines,
    bars,
    plot_assistance,
    write_assistance,
)

_IDENTIFY_S = 15.0
_CASE_S = 1.2 * len(MODES)


def assistance(
    seed: Seed = 0,
    noise: Annotated[str, typer.Option(help=f"Noise profile: {', '.join(NOISE_PROFILES)}.")] = "x5",
    with_effects: With = None,
    without_effects: Without = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Only the thesis' figures, and one arm of six joints.")
    ] = False,
    processes: Annotated[
        int | None, typer.Option(min=1, help="Processes that share the work [one for each core].")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the table as JSON too.")] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Draw figures 52 to 61 (PNG, SVG or PDF).")
    ] = None,
) -> None:
    """Follow motions by position, by velocity too, and by calculated torque too, as the thesis did (6.3)."""
    choice = NoiseChoice(noise, tuple(with_effects or ()), tuple(without_effects or ()))
    profile = _profile(choice)
    for file in (json_file, picture):
        if file is not None and not file.parent.is_dir():
            fail(f"{file}: there is no folder {file.parent}", EXIT_USAGE)
    found = _run(cases(quick), profile, seed, processes or os.cpu_count() or 1)
    print_table(assistance_table(found))
    for line in bar_lines(bars(found)):
        typer.echo(line)
    settings: dict[str, object] = {
        "seed": seed,
        "noise": noise,
        "with": list(choice.on),
        "without": list(choice.off),
        "quick": quick,
    }
    try:
        if json_file is not None:
            write_assistance(json_file, settings, found)
        if picture is not None:
            plot_assistance(
                found, picture, f"Torque assistance: profile {profile.name}, seed {seed}; * unstable"
            )
    except (OSError, ValueError) as error:
        fail(f"cannot write: {error}", EXIT_FAILED)


def identify_robot(name: str, profile: NoiseProfile, seed: int) -> Model:
    """Identify a shipped robot where the seed puts it."""
    return identified_model(standing_robot(name, seed), profile, seed)


def _profile(choice: NoiseChoice) -> NoiseProfile:
    try:
        return switched(noise_profile(str(choice.profile)), choice.on, choice.off)
    except (KeyError, ValueError) as error:
        fail(error.args[0], EXIT_USAGE)


def _run(chosen: Sequence[Case], profile: NoiseProfile, seed: int, processes: int) -> list[Combination]:
    """Identify every robot once, then try all cases with what came of it."""
    # Processes that share the cores already must not each start as many threads; they inherit this.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    robots = robots_of(list(chosen))
    total = len(robots) + len(chosen)
    try:
        with Terminal() as terminal:
            work = [Trial(identify_robot, (name, profile, seed), _IDENTIFY_S) for name in robots]
            models = dict(
                zip(robots, _results(terminal, work, processes, 0, total, "identifying"), strict=True)
            )
            work = [Trial(try_case, (case, models[case.robot], profile, seed), _CASE_S) for case in chosen]
            return _results(terminal, work, processes, len(robots), total, "following")
    except KeyboardInterrupt:
        fail("interrupted; nothing is written", EXIT_INTERRUPTED)


def _results(
    terminal: Terminal, work: Sequence[Trial], processes: int, before: int, total: int, doing: str
) -> list[Any]:
    done = before

    def show(index: int, result: Any) -> None:
        nonlocal done
        done += 1
        terminal.step(done, total, doing)

    results = [found.result for found in run_trials(work, processes, show)]
    for failure in (found for found in results if isinstance(found, Failed)):
        fail(failure.text, EXIT_FAILED)
    return results

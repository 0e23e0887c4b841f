"""`x5-sim assistance`: the thesis' torque assistance on simulated arms, with their identified models."""

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from coordinator.runtime.command_line import in_a_folder, with_options
from coordinator.runtime.terminal import new_table, print_table
from sim.benchmark.case import Trial
from sim.commands.experiment import JsonFile, ModuleOptions, WorkerCount, experiment, trial_results
from sim.imperfections.noise_profile import NoiseProfile
from sim.thesis.dynamics.torque_assistance import MODES, Follow, Model, identified_model, standing_robot
from sim.thesis.dynamics.torque_assistance_cases import Case, Combination, cases, robots_of, try_case
from sim.thesis.dynamics.torque_assistance_report import (
    Bar,
    bars,
    plot_assistance,
    robot_and_pose,
    write_assistance,
)

_IDENTIFY_S = 15.0
_CASE_S = 1.2 * len(MODES)


@with_options
def assistance(
    modules: ModuleOptions,
    quick: Annotated[
        bool, typer.Option("--quick", help="Only the thesis' figures, and one arm of six joints.")
    ] = False,
    processes: WorkerCount = None,
    json_file: JsonFile = None,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", help="Draw figures 52 to 61 (PNG, SVG or PDF).", callback=in_a_folder),
    ] = None,
) -> None:
    """Track motions by position, position and velocity, and with calculated torque too (thesis 6.3)."""
    profile = modules.profile()
    combinations = _run(cases(quick), profile, modules.seed, processes)
    print_table(assistance_table(combinations))
    for line in bar_lines(bars(combinations)):
        typer.echo(line)
    if json_file is not None:
        write_assistance(json_file, {**modules.settings(), "quick": quick}, combinations)
    if picture is not None:
        title = f"Torque assistance: profile {profile.name}, seed {modules.seed}; * unstable"
        plot_assistance(combinations, picture, title)


def identify_robot(name: str, profile: NoiseProfile, seed: int) -> Model:
    """Identify a shipped robot where the seed puts it."""
    return identified_model(standing_robot(name, seed), profile, seed)


def _run(
    chosen: Sequence[Case], profile: NoiseProfile, seed: int, processes: int | None
) -> list[Combination]:
    """Identify every robot once, then try all cases with the identified models."""
    robots = robots_of(list(chosen))
    total = len(robots) + len(chosen)
    with experiment() as terminal:
        work = [Trial(identify_robot, (name, profile, seed), _IDENTIFY_S) for name in robots]
        identified = trial_results(terminal, work, processes, lambda _: "identifying", total=total)
        models = dict(zip(robots, identified, strict=True))
        work = [Trial(try_case, (case, models[case.robot], profile, seed), _CASE_S) for case in chosen]
        return trial_results(terminal, work, processes, lambda _: "following", len(robots), total)


def assistance_table(combinations: Sequence[Combination]) -> Table:
    """Return the combinations as a table, a section for each robot; * marks what is unstable."""
    shown = new_table(
        "Rms tracking error by input mode in mrad, * unstable",
        "robot | gains | read | motion | set-points | commanded | mode 1 | mode 2 | mode 3 | 2 / 3",
    )
    for each, following in zip(combinations, [*combinations[1:], None], strict=True):
        case = each.case
        shown.add_row(
            robot_and_pose(each),
            case.gains.name,
            case.gains.reading or "",
            case.motion,
            case.delivery.name,
            f"{1e3 * each.follows[0].motion_rms_rad:.1f}",
            *(_error(one) for one in each.follows),
            f"{each.gain:.1f}" if isfinite(each.gain) else "",
            end_section=following is None or following.case.robot != case.robot,
        )
    return shown


def bar_lines(checked: Sequence[Bar]) -> list[str]:
    """Return a line for each bar, and below it the combinations that miss it or are unstable."""
    lines = []
    for bar in checked:
        outcome = "holds" if bar.holds else "does not hold"
        lines.append(f"{bar.requirement}: {outcome}, in {bar.met} of {bar.stable} stable combinations")
        lines += [f"  missed: {text}" for text in bar.missed]
        lines += [f"  unstable: {text}" for text in bar.unstable]
    return lines


def _error(one: Follow) -> str:
    text = f"{1e3 * one.rms_error_rad:.2f}" if isfinite(one.rms_error_rad) else "-"
    return f"{text} *" if one.unstable else text

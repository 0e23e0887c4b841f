"""`x5-sim thesis`: the thesis' experiments on simulated modules, against what it printed."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from coordinator.report.plots import check_plots
from coordinator.runtime.command_line import with_options
from coordinator.runtime.terminal import new_table, print_table
from sim.commands.experiment import ModuleOptions, WorkerCount, measured_units
from sim.thesis.dynamics.assistance_experiments import ASSISTANCE_EXPERIMENTS
from sim.thesis.dynamics.gain_experiments import GAIN_EXPERIMENTS
from sim.thesis.dynamics.parameter_experiments import PARAMETER_EXPERIMENTS
from sim.thesis.experiment import Experiment, ExperimentResult, Scope, ThesisResults
from sim.thesis.future_work.experiment import FUTURE_WORK
from sim.thesis.kinematics.configuration_experiments import CONFIGURATION_EXPERIMENTS
from sim.thesis.kinematics.equation16 import EQUATION_16
from sim.thesis.kinematics.estimator_experiments import ESTIMATORS
from sim.thesis.kinematics.motion_experiments import MOTION_EXPERIMENTS
from sim.thesis.kinematics.repeat_experiments import REPEAT_EXPERIMENTS
from sim.thesis.kinematics.sweep_experiments import SWEEP_EXPERIMENTS
from sim.thesis.study import Store, code_version, results, selected, units_of
from sim.thesis.study_report import HTML, counted, write_results


def _place(one: Experiment) -> tuple[int, int]:
    """Return where an experiment stands in the report: figures, then tables by number, then the rest."""
    named = re.fullmatch(r"(figure|table)(\d+)", one.id)
    return (2, 0) if named is None else (("figure", "table").index(named[1]), int(named[2]))


_GROUPS = (
    CONFIGURATION_EXPERIMENTS,
    MOTION_EXPERIMENTS,
    SWEEP_EXPERIMENTS,
    REPEAT_EXPERIMENTS,
    (EQUATION_16, ESTIMATORS),
    PARAMETER_EXPERIMENTS,
    ASSISTANCE_EXPERIMENTS,
    GAIN_EXPERIMENTS,
    (FUTURE_WORK,),
)
EXPERIMENTS: tuple[Experiment, ...] = tuple(sorted((one for own in _GROUPS for one in own), key=_place))


@with_options
def thesis(
    modules: ModuleOptions,
    out: Annotated[
        Path, typer.Option(help="Folder for report.html, report.md, thesis.json, and what is measured.")
    ] = Path("runs/thesis"),
    only: Annotated[
        str, typer.Option(help="Experiments, separated by commas: table4,figure23,... [all].")
    ] = "",
    quick: Annotated[bool, typer.Option("--quick", help="Fewer amplitudes and trials.")] = False,
    processes: WorkerCount = None,
) -> None:
    """Repeat the thesis' experiments; what was measured before by the same code is not measured again."""
    modules.profile()
    check_plots()
    choice = modules.choice()
    chosen = selected(EXPERIMENTS, [name.strip() for name in only.split(",") if name.strip()])
    scope = Scope(modules.seed, choice, quick)
    measured = measured_units(units_of(chosen, scope), Store(out / "measured"), processes)
    settings: dict[str, int | str | bool | tuple[str, ...]] = {
        "seed": modules.seed,
        "noise": modules.noise,
        "with": choice.on,
        "without": choice.off,
        "quick": quick,
        "code": code_version(),
    }
    outcome = ThesisResults(settings=settings, experiments=results(chosen, scope, measured))
    write_results(out, outcome)
    print_table(outcome_table(outcome.experiments))
    typer.echo(f"{counted(outcome)} Report: {out / HTML}")


def outcome_table(experiments: Sequence[ExperimentResult]) -> Table:
    """Return the experiments with their outcomes and reasons."""
    shown = new_table("The thesis' experiments on simulated modules", "experiment | outcome | reason")
    for one in experiments:
        shown.add_row(one.title, one.outcome, escape(one.reason))
    return shown

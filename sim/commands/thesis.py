"""`x5-sim thesis`: the thesis' experiments on simulated modules, against what it printed."""

import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from coordinator.report.plots import check_plots
from coordinator.runtime.command_line import fail, with_options
from coordinator.runtime.terminal import Terminal, new_table, print_table
from module_agent.model.errors import EXIT_FAILED
from sim.benchmark.case import Failed, Trial
from sim.benchmark.workers import run_trials
from sim.commands.experiment import ModuleOptions, WorkerCount, experiment, worker_count
from sim.thesis.dynamics.assistance_experiments import ASSISTANCE_EXPERIMENTS
from sim.thesis.dynamics.gain_experiments import GAIN_EXPERIMENTS
from sim.thesis.dynamics.parameter_experiments import PARAMETER_EXPERIMENTS
from sim.thesis.experiment import Experiment, ExperimentResult, Scope, ThesisResults, Unit
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
    measured = _measured(chosen, scope, Store(out / "measured"), processes)
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


def _measured(
    chosen: Sequence[Experiment], scope: Scope, store: Store, processes: int | None
) -> dict[str, Any]:
    """Measure what the store does not have, keep each result as it comes, and return all by key.

    The first unit that fails ends the command with `EXIT_FAILED`; what is measured stays in the store.
    """
    units = units_of(chosen, scope)
    measured = {key: known for key, unit in units.items() if (known := store.load(key, unit)) is not None}
    missing = [(key, unit) for key, unit in units.items() if key not in measured]
    with experiment("what is measured is kept: the same command continues") as terminal:
        progress = _Progress(terminal, [unit for _, unit in missing], len(units))

        def done(index: int, result: Any) -> None:
            key, unit = missing[index]
            if isinstance(result, Failed):
                fail(result.text, EXIT_FAILED)
            store.keep(key, unit, result)
            measured[key] = result
            progress.step(unit)

        trials = [Trial(unit.work, unit.arguments, unit.cost_s) for _, unit in missing]
        run_trials(trials, worker_count(processes), done)
    return measured


class _Progress:
    """Shows how many units are done, and the time left by their costs and the time so far."""

    def __init__(self, terminal: Terminal, missing: Sequence[Unit], total: int):
        self._terminal, self._total = terminal, total
        self._done = total - len(missing)
        self._cost_s, self._over_s = sum(unit.cost_s for unit in missing), 0.0
        self._start_s = time.monotonic()

    def step(self, unit: Unit) -> None:
        """Show that a unit is done."""
        self._done += 1
        self._over_s += unit.cost_s
        left_s = (time.monotonic() - self._start_s) * (self._cost_s / self._over_s - 1.0)
        self._terminal.step(self._done, self._total, f"{unit.name}; about {left_s:.0f} s left")


def outcome_table(experiments: Sequence[ExperimentResult]) -> Table:
    """Return the experiments with their outcomes and reasons."""
    shown = new_table("The thesis' experiments on simulated modules", "experiment | outcome | reason")
    for one in experiments:
        shown.add_row(one.title, one.outcome, escape(one.reason))
    return shown

"""`x5-sim benchmark`: figures of the whole system on simulated robots, against the bars set for it."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from coordinator.commands.options import JsonFile
from coordinator.excitation.plan import Motions
from coordinator.runtime.command_line import in_a_folder
from coordinator.runtime.terminal import STANDARD_OUTPUT, new_table, print_table, write_result
from module_agent.model.errors import EXIT_FINDING, UsageError
from module_agent.model.suggestion import did_you_mean
from sim.benchmark.case import Case, CaseResult
from sim.benchmark.cases.staubli_tx40 import MOTION, URDF
from sim.benchmark.cases.suites import (
    DYNAMIC_TRIALS,
    KINEMATIC_TRIALS,
    QUICK_DYNAMICS,
    QUICK_KINEMATICS,
    chosen,
    dynamic_cases,
    full_dynamics,
    full_kinematics,
    kinematic_cases,
    over_all,
)
from sim.benchmark.report import Results, document, plot
from sim.benchmark.row import Limit, Row
from sim.benchmark.workers import run_cases
from sim.commands.experiment import WorkerCount, experiment, worker_count
from sim.commands.options import Seed

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Measure the whole system on simulated robots against its bars.",
)

Only = Annotated[str, typer.Option(help="Cases whose name contains this; * and ? are wildcards.")]


@app.command()
def dynamics(
    json_file: JsonFile = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Every row in a minute on two cores: one trial each, with motions cut short."
        ),
    ] = False,
    trials: Annotated[int | None, typer.Option(min=1, help=f"Trials a case [{DYNAMIC_TRIALS}].")] = None,
    seed: Seed = 0,
    tx40: Annotated[
        Path | None,
        typer.Option(help="Folder with a Staubli TX40's recording too: tx40.urdf and motion.npz."),
    ] = None,
    only: Only = "",
    processes: WorkerCount = None,
) -> None:
    """Measure regressor, inertia, payloads, merging, assistance and monitoring against the truth.

    Exit codes as of `kinematics`.
    """
    _check_trials(quick, trials)
    effort = QUICK_DYNAMICS if quick else full_dynamics(trials or DYNAMIC_TRIALS)
    settings: dict[str, object] = {"quick": quick, "seed": seed, "only": only} | effort._asdict()
    for name in (URDF, MOTION):
        if tx40 is not None and not (tx40 / name).is_file():
            raise UsageError(f"--tx40 {tx40}: there is no {name} in it")
    _benchmark("dynamics", dynamic_cases(effort, seed, tx40), settings, processes, json_file)


@app.command()
def kinematics(
    json_file: JsonFile = None,
    plot_file: Annotated[
        Path | None, typer.Option("--plot", help="Picture to write: PNG, SVG, PDF.", callback=in_a_folder)
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Every row in a minute on two cores: one trial each, the thesis' motions cut short for "
            "arms, the smallest of ten random robots, link changes by all joints at once.",
        ),
    ] = False,
    trials: Annotated[
        int | None,
        typer.Option(
            min=1, help=f"Trials a case; 200 robots and 100 unchanged checks besides [{KINEMATIC_TRIALS}]."
        ),
    ] = None,
    seed: Seed = 0,
    motions: Annotated[Motions, typer.Option(help="How whole arms explore joint by joint.")] = "optimised",
    only: Only = "",
    processes: WorkerCount = None,
) -> None:
    """Compare the thesis' estimator, ours and the physical limit on the same recordings of simulated robots.

    Exit code 0 if all bars are met, 4 if one is missed, 1 if a file cannot be written, 2 for wrong usage,
    130 if interrupted; nothing is written then.
    """
    _check_trials(quick, trials)
    effort = QUICK_KINEMATICS if quick else full_kinematics(trials or KINEMATIC_TRIALS)
    settings: dict[str, object] = {"quick": quick, "seed": seed, "only": only, "motions": motions}
    settings |= effort._asdict()
    cases = kinematic_cases(effort, seed, motions)
    _benchmark("kinematics", cases, settings, processes, json_file, plot_file)


def _check_trials(quick: bool, trials: int | None) -> None:
    if quick and trials is not None:
        raise UsageError("--quick has its own number of trials: leave out --trials")


def _benchmark(
    name: str,
    cases: list[Case],
    settings: dict[str, object],
    processes: int | None,
    json_file: Path | None,
    plot_file: Path | None = None,
) -> None:
    """Run the selected cases, report, and exit with `EXIT_FINDING` if a bar is missed."""
    only = str(settings["only"])
    selected = chosen(cases, only)
    if not selected:
        near = did_you_mean(only, [case.name for case in cases])
        raise UsageError(
            f"--only {only}: no such case{near}; they are\n  " + "\n  ".join(c.name for c in cases)
        )
    started_s = time.monotonic()
    measured = _run(selected, worker_count(processes))
    results = Results(name, settings, measured, over_all(measured), time.monotonic() - started_s)
    if write_result(json_file, document(results)):
        print_table(table(results.rows, f"Benchmark of {name}"))
    for text in results.failures:
        typer.echo(f"failed: {text}", err=True)
    held = sum(row.holds is True for row in results.rows)
    cost = f"{results.wall_time_s:.0f} s, of processors {results.cpu_time_s:.0f} s"
    typer.echo(f"{held} bars met, {len(results.missed)} missed; {cost}", err=json_file == STANDARD_OUTPUT)
    if plot_file is not None:
        plot(results.rows, plot_file)
    if results.missed:
        raise typer.Exit(EXIT_FINDING)


def _run(cases: list[Case], processes: int) -> list[CaseResult]:
    total = sum(len(case.trials) for case in cases)
    done = 0

    def show(case: Case, left: int) -> None:
        nonlocal done
        done += 1
        # A pipe gets one line per case.
        if terminal.console.is_terminal or not left:
            terminal.step(done, total, case.name)

    with experiment() as terminal:
        return run_cases(cases, processes, show)


_OUTCOMES = {None: "", True: "[green]holds[/]", False: "[bold red]MISSED[/]"}


def table(rows: Sequence[Row], title: str) -> Table:
    """Return the rows, every case with its name, profile and knowledge once."""
    columns = "case | figure | >thesis | >ours | >bound | >bar | "
    shown = new_table(title, columns, title_justify="left")
    before = ""
    for row in rows:
        if before and row.case != before:
            shown.add_section()
        cells = (_number(row.thesis), _number(row.ours), _number(row.bound), _bar(row.limit))
        # Units stand in brackets, which are markup to rich.
        name = escape(_about(row)) if row.case != before else ""
        shown.add_row(name, escape(row.figure), *cells, _OUTCOMES[row.holds])
        before = row.case
    return shown


def _about(row: Row) -> str:
    return f"{row.case}\n  {row.profile}; known: {row.known}" if row.profile else row.case


def _bar(limit: Limit) -> str:
    if limit is None:
        return ""
    return f"{limit[0]:.4g} to {limit[1]:.4g}" if isinstance(limit, tuple) else f"<= {limit:.4g}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if abs(value) < 100.0 else f"{value:.0f}"

"""`x5-sim amplitudes`: the thesis' amplitude experiment on simulated modules."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from rich.table import Table

from coordinator.runtime.command_line import with_options
from coordinator.runtime.terminal import new_table, print_table
from module_agent.model.errors import UsageError
from sim.benchmark.case import Trial
from sim.commands.experiment import ModuleOptions, WorkerCount, experiment, trial_results
from sim.thesis.kinematics.amplitude_report import Repeats, plot, repeats, write_results
from sim.thesis.kinematics.amplitude_sweep import (
    AmplitudeTrial,
    Series,
    repeat_series,
    run_series,
    sweep_series,
)
from sim.thesis.published import AMPLITUDES_RAD, LENGTHS_MM, TRIALS

T = TypeVar("T", int, float)
_MAX_AMPLITUDE_RAD = 0.5
# About what a trial takes on one core.
_TRIAL_COST_S = 0.6


@with_options
def amplitudes(
    modules: ModuleOptions,
    out: Annotated[Path, typer.Option(help="Folder for amplitudes.json, .csv and .png.")] = Path(
        "runs/amplitudes"
    ),
    lengths: Annotated[str, typer.Option(help="Lengths of the arms [mm], separated by commas.")] = ",".join(
        map(str, LENGTHS_MM)
    ),
    amplitudes: Annotated[str, typer.Option(help="Amplitudes [rad], separated by commas.")] = ",".join(
        map(str, AMPLITUDES_RAD)
    ),
    rigs: Annotated[int, typer.Option(min=1, help="Rigs of other modules that the sweep is run on.")] = 1,
    trials: Annotated[
        int, typer.Option(min=0, help="Repeated trials an arm at the thesis' amplitude, 0 for none.")
    ] = TRIALS,
    filtered: Annotated[
        bool, typer.Option("--filter/--no-filter", help="Show the table with the thesis' filter or without.")
    ] = True,
    processes: WorkerCount = None,
) -> None:
    """Estimate link lengths over amplitudes as the thesis did (chapter 6.2), on simulated modules."""
    modules.profile()
    choice = modules.choice()
    known = "one of " + ", ".join(map(str, LENGTHS_MM))
    arms = _numbers(lengths, "--lengths", int, lambda value: value in LENGTHS_MM, known)
    sizes = _numbers(
        amplitudes,
        "--amplitudes",
        float,
        lambda value: 0.0 < value <= _MAX_AMPLITUDE_RAD,
        f"more than 0 and at most {_MAX_AMPLITUDE_RAD} rad",
    )
    series = sweep_series(arms, sizes, rigs, modules.seed, choice)
    if trials:
        series += repeat_series(arms, trials, modules.seed, choice)
    measured = _run(series, processes)
    write_results(out, {"rigs": rigs, **modules.settings()}, measured)
    names = [f"with {name}" for name in choice.on] + [f"without {name}" for name in choice.off]
    title = f"Link length by circle point analysis: profile {', '.join([modules.noise, *names])}"
    plot(measured, out / "amplitudes.png", title)
    if trials:
        print_table(table(repeats(measured, filtered), filtered))
    typer.echo(str(out / "amplitudes.png"))


def _run(series: list[Series], processes: int | None) -> list[AmplitudeTrial]:
    work = [Trial(run_series, (each,), _TRIAL_COST_S * len(each.amplitudes_rad)) for each in series]

    def label(index: int) -> str:
        own = series[index]
        return f"{own.length_mm} mm {own.alignment}: {len(own.amplitudes_rad)} trials"

    with experiment() as terminal:
        return [trial for trials in trial_results(terminal, work, processes, label) for trial in trials]


def _numbers(
    text: str, option: str, kind: Callable[[str], T], fits: Callable[[T], bool], right: str
) -> list[T]:
    """Read numbers separated by commas, each once and in their order."""
    values = []
    for word in text.split(","):
        try:
            value = kind(word)
        except ValueError:
            raise UsageError(f"{option} {text}: {word!r} is no number") from None
        if not fits(value):
            raise UsageError(f"{option} {text}: {word} must be {right}")
        values.append(value)
    return list(dict.fromkeys(values))


def table(summaries: Sequence[Repeats], filtered: bool = True) -> Table:
    """Return tables 4 and 5 of the thesis with the simulated figures."""
    shown = new_table(
        "Repeated trials at the thesis' amplitudes" + ("" if filtered else ", without the filter"),
        "arm | >A [rad] | >trials | >mean [mm] | >error [mm] | >error [%] | >scatter [mm] | "
        ">thesis' mean [mm] | >its error [%]",
    )
    for row in summaries:
        thesis = row.thesis
        shown.add_row(
            f"{thesis.length_mm} mm {thesis.alignment}",
            f"{thesis.amplitude_rad:.2f}",
            str(row.trials),
            f"{row.mean_mm:.1f}",
            f"{row.error_mm:+.1f}",
            f"{100 * row.error_mm / row.true_mm:+.1f}",
            f"{row.scatter_mm:.1f}",
            f"{thesis.mean_mm:.1f}",
            f"{100 * (thesis.mean_mm / thesis.length_mm - 1):+.1f}",
        )
    return shown

"""`x5-sim amplitudes`: the thesis' amplitude experiment on simulated modules."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from coordinator.runtime.event_loop import SIGNALS
from coordinator.runtime.exit_codes import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE
from coordinator.runtime.terminal import Terminal, print_table
from sim.commands.options import Seed, With, Without, fail
from sim.imperfections.noise_profile import NOISE_PROFILES
from sim.robot.noise_choice import NoiseChoice
from sim.test_bench.module_bench import ExperimentFailed
from sim.thesis.amplitude_report import plot, repeats, table, write_results
from sim.thesis.amplitude_sweep import Series, Trial, repeat_series, run_all, sweep_series
from sim.thesis.published import AMPLITUDES_RAD, LENGTHS_MM, TRIALS

T = TypeVar("T", int, float)
_MAX_AMPLITUDE_RAD = 0.5


def amplitudes(
    out: Annotated[Path, typer.Option(help="Folder for amplitudes.json, .csv and .png.")] = Path(
        "runs/amplitudes"
    ),
    seed: Seed = 0,
    noise: Annotated[str, typer.Option(help=f"Noise profile: {', '.join(NOISE_PROFILES)}.")] = "x5",
    with_effects: With = None,
    without_effects: Without = None,
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
    processes: Annotated[
        int | None, typer.Option(min=1, help="Processes that share the work [one for each core].")
    ] = None,
) -> None:
    """Estimate link lengths over amplitudes as the thesis did (chapter 6.2), on simulated modules."""
    choice = NoiseChoice(noise, tuple(with_effects or ()), tuple(without_effects or ()))
    arms = _numbers(lengths, "--lengths", int, lambda value: value in LENGTHS_MM, _one_of(LENGTHS_MM))
    sizes = _numbers(
        amplitudes,
        "--amplitudes",
        float,
        lambda value: 0.0 < value <= _MAX_AMPLITUDE_RAD,
        f"more than 0 and at most {_MAX_AMPLITUDE_RAD} rad",
    )
    series = sweep_series(arms, sizes, rigs, seed, choice)
    if trials:
        series += repeat_series(arms, trials, seed, choice)
    _check_noise(series[0])
    found = _run(series, processes or os.cpu_count() or 1)
    settings = {"seed": seed, "noise": noise, "rigs": rigs}
    switched = {"with": list(choice.on), "without": list(choice.off)}
    try:
        write_results(out, settings | switched, found)
        plot(found, out / "amplitudes.png", _title(series[0]))
    except OSError as error:
        fail(f"cannot write to {out}: {error.strerror or error}", EXIT_FAILED)
    if trials:
        print_table(table(repeats(found, filtered), filtered))
    typer.echo(str(out / "amplitudes.png"))


def _run(series: list[Series], processes: int) -> list[Trial]:
    done = 0

    def show(finished: Series) -> None:
        nonlocal done
        done += 1
        name = f"{finished.length_mm} mm {finished.alignment}: {len(finished.amplitudes_rad)} trials"
        terminal.step(done, len(series), name)

    # Processes that share the cores already must not each start as many threads; they inherit this.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        with Terminal() as terminal:
            return run_all(series, processes, show)
    except KeyboardInterrupt:
        fail("interrupted; nothing is written", EXIT_INTERRUPTED)
    except ExperimentFailed as error:
        fail(error, EXIT_FAILED)


def _check_noise(series: Series) -> None:
    try:
        series.noise.of(series.robot)
    except (KeyError, ValueError) as error:
        fail(error.args[0], EXIT_USAGE)


def _title(series: Series) -> str:
    switched = [f"with {name}" for name in series.noise.on] + [f"without {name}" for name in series.noise.off]
    return (
        f"Link length by circle point analysis: profile {', '.join([str(series.noise.profile), *switched])}"
    )


def _one_of(values: tuple[int, ...]) -> str:
    return "one of " + ", ".join(map(str, values))


def _numbers(
    text: str, option: str, kind: Callable[[str], T], fits: Callable[[T], bool], right: str
) -> list[T]:
    """Read numbers separated by commas, each once and in their order, or end the command."""
    found = []
    for word in text.split(","):
        try:
            value = kind(word)
        except ValueError:
            fail(f"{option} {text}: {word!r} is no number", EXIT_USAGE)
        if not fits(value):
            fail(f"{option} {text}: {word} must be {right}", EXIT_USAGE)
        found.append(value)
    return list(dict.fromkeys(found))

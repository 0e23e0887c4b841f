"""Options and runner that the experiments on simulated robots share."""

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from coordinator.runtime.command_line import fail
from coordinator.runtime.event_loop import SIGNALS
from coordinator.runtime.terminal import Terminal
from module_agent.model.errors import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE
from sim.benchmark.case import Failed, Trial
from sim.benchmark.workers import run_trials
from sim.imperfections.noise_profile import NOISE_PROFILES, NoiseProfile, noise_profile, switched

ProfileName = Annotated[str, typer.Option("--noise", help=f"Noise profile: {', '.join(NOISE_PROFILES)}.")]
WorkerCount = Annotated[
    int | None, typer.Option("--processes", min=1, help="Processes that share the work [one for each core].")
]
JsonFile = Annotated[Path | None, typer.Option("--json", help="JSON file to write.")]


def chosen_profile(name: str, on: Sequence[str] | None, off: Sequence[str] | None) -> NoiseProfile:
    """Return a noise profile with effects switched on and off."""
    return switched(noise_profile(name), tuple(on or ()), tuple(off or ()))


def profile_settings(name: str, on: Sequence[str] | None, off: Sequence[str] | None) -> dict[str, object]:
    """Return profile and effects as the settings of a results file state them."""
    return {"noise": name, "with": list(on or ()), "without": list(off or ())}


def check_writable(*files: Path | None) -> None:
    """End the command if the folder of a file to be written does not exist."""
    for file in files:
        if file is not None and not file.parent.is_dir():
            fail(f"{file}: there is no folder {file.parent}", EXIT_USAGE)


@contextmanager
def experiment() -> Iterator[Terminal]:
    """Show progress while processes work; a signal ends them, and the command with `EXIT_INTERRUPTED`."""
    # Processes that share the cores already must not each start as many threads; they inherit this.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        with Terminal() as terminal:
            yield terminal
    except KeyboardInterrupt:
        fail("interrupted; nothing is written", EXIT_INTERRUPTED)


def trial_results(
    terminal: Terminal,
    trials: Sequence[Trial],
    processes: int | None,
    label: Callable[[int], str],
    done: int = 0,
    total: int | None = None,
) -> list[Any]:
    """Run trials in processes (one for each core when None) and return their results in order.

    `label` names the trial of an index in the progress. `done` trials of `total` are over already. The first
    trial that fails ends the command with `EXIT_FAILED`.
    """
    of = len(trials) if total is None else total

    def show(index: int, result: Any) -> None:
        nonlocal done
        if isinstance(result, Failed):
            fail(result.text, EXIT_FAILED)
        done += 1
        terminal.step(done, of, label(index))

    return [each.result for each in run_trials(trials, worker_count(processes), show)]


def worker_count(processes: int | None) -> int:
    """Return the number of processes to start: as asked for, or one for each core."""
    return processes or os.cpu_count() or 1

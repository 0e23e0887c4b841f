"""Options and runner that the experiments on simulated robots share."""

import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from coordinator.runtime.command_line import fail
from coordinator.runtime.event_loop import SIGNALS
from coordinator.runtime.terminal import Terminal
from module_agent.model.errors import EXIT_FAILED, EXIT_INTERRUPTED
from sim.benchmark.case import Failed, Trial
from sim.benchmark.workers import run_trials
from sim.commands.options import NoiseOptions
from sim.imperfections.noise_profile import NOISE_PROFILES, NoiseProfile, noise_profile, switched
from sim.thesis.experiment import Unit
from sim.thesis.study import Store

ProfileName = Annotated[str, typer.Option("--noise", help=f"Noise profile: {', '.join(NOISE_PROFILES)}.")]
WorkerCount = Annotated[
    int | None, typer.Option("--processes", min=1, help="Processes that share the work [one for each core].")
]


@dataclass(frozen=True, kw_only=True)
class ModuleOptions(NoiseOptions):
    """The noise of an experiment's modules, and its seed."""

    noise: ProfileName = "x5"

    def profile(self) -> NoiseProfile:
        """Return the noise profile with effects switched on and off.

        Raises:
            UsageError: there is no such profile or effect.
        """
        choice = self.choice()
        return switched(noise_profile(self.noise), choice.on, choice.off)


@contextmanager
def experiment(kept: str = "nothing is written") -> Iterator[Terminal]:
    """Show progress while processes work; a signal ends them, and the command with `EXIT_INTERRUPTED`.

    `kept` says what remains then.
    """
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        with Terminal() as terminal:
            yield terminal
    except KeyboardInterrupt:
        fail(f"interrupted; {kept}", EXIT_INTERRUPTED)


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


def measured_units(units: Mapping[str, Unit], store: Store, processes: int | None) -> dict[str, Any]:
    """Measure what the store does not have, keep each result as it comes, and return all by key.

    The first unit that fails ends the command with `EXIT_FAILED`; what is measured stays in the store.
    """
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

        trials = [Trial(unit.work, unit.arguments, unit.cost_s, unit.shares) for _, unit in missing]
        run_trials(trials, worker_count(processes), done)
    return {key: measured[key] for key in units}


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


def worker_count(processes: int | None) -> int:
    """Return the number of processes to start: as asked for, or one for each core."""
    return processes or os.cpu_count() or 1

"""The runner of all experiments: trials in worker processes, and the cases of a benchmark on top of it.

A process grows by tens of megabytes with every virtual run, so each is replaced after some minutes. A process
that dies is replaced too, as is one whose trial does not end; that trial counts as failed. The trials of all
cases are mixed.
"""

import math
import multiprocessing
import signal
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

from sim.benchmark.case import Case, CaseResult, Failed, Trial, concluded

# Starting a process costs about three seconds of imports.
SECONDS_PER_PROCESS = 150.0
MAX_TEXT_LENGTH = 40
_CONTEXT = multiprocessing.get_context("spawn")


class Done(NamedTuple):
    """What a trial returned, `Failed` if it raised, and the processor time that it took."""

    result: Any
    cpu_s: float


def run_trials(
    trials: Sequence[Trial], processes: int, on_done: Callable[[int, Any], None] = lambda index, result: None
) -> list[Done]:
    """Run trials in several processes and return their results in order.

    Any exception ends the processes at once and removes their temporary folders. `on_done` receives index and
    result of each trial as it ends.
    """
    done: dict[int, Done] = {}
    waiting = _in_turn(trials)
    with _team(min(processes, len(waiting))) as team:
        while waiting or any(worker.busy or worker.next for worker in team):
            for worker in team:
                if waiting and not worker.busy and not worker.next:
                    worker.next = waiting.pop(0)
                if worker.next and not worker.busy:
                    index = worker.next.pop(0)
                    worker.begin(index, trials[index])
            for index, ended in _finished(team):
                done[index] = ended
                on_done(index, ended.result)
    return [done[index] for index in range(len(trials))]


def _in_turn(trials: Sequence[Trial]) -> list[list[int]]:
    """Return the trials' indices, those that share something together, the longest first."""
    groups: dict[object, list[int]] = {}
    for index, trial in enumerate(trials):
        groups.setdefault(trial.shares or index, []).append(index)
    return sorted(groups.values(), key=lambda group: -sum(trials[index].cost_s for index in group))


@contextmanager
def _team(size: int) -> Iterator[list["_Worker"]]:
    # Trials that are terminated leave temporary folders behind: all of them are in this one.
    with tempfile.TemporaryDirectory(prefix="x5-benchmark-") as folder:
        team = [_Worker(folder) for _ in range(size)]
        try:
            yield team
        finally:
            for worker in team:
                worker.end()


def _finished(team: Sequence["_Worker"]) -> Iterator[tuple[int, Done]]:
    busy = {worker.pipe: worker for worker in team if worker.busy}
    until_s = min(worker.until_s for worker in busy.values())
    for pipe in wait(list(busy), None if until_s == math.inf else max(until_s - time.monotonic(), 0.0)):
        if isinstance(pipe, Connection):
            yield busy[pipe].finish()
    for worker in team:
        if worker.busy and time.monotonic() > worker.until_s:
            yield worker.give_up()


class _Worker:
    """One process at a time, the pipe to it, and the trials that must be its next ones.

    until_s: when the present trial is to have ended, by the monotonic clock.
    """

    def __init__(self, folder: str):
        self.next: list[int] = []
        self.until_s = math.inf
        self._folder = folder
        self._left_s = 0.0
        self._limit_s = math.inf
        self._index: int | None = None
        self._process: BaseProcess | None = None
        self.pipe: Connection

    @property
    def busy(self) -> bool:
        """Whether a trial is under way."""
        return self._index is not None

    def begin(self, index: int, trial: Trial) -> None:
        """Hand over a trial, to a new process if there is none."""
        if self._process is None or not self._process.is_alive():
            self._start()
        self._index, self._limit_s = index, trial.limit_s
        self.until_s = time.monotonic() + trial.limit_s
        self._left_s -= trial.cost_s
        self.pipe.send(trial)

    def finish(self) -> tuple[int, Done]:
        """Return the trial's index and result; call it when the pipe is readable."""
        index, self._index = self._index, None
        assert index is not None
        try:
            found = Done(*self.pipe.recv())
        except (EOFError, OSError):
            text = f"the worker process died with exit code {self._exit_code()}"
            found = Done(Failed(text, "died"), 0.0)
            self.end()
        if self._left_s <= 0.0 and not self.next:
            self.end()
        return index, found

    def give_up(self) -> tuple[int, Done]:
        """End a process whose trial does not end; return the trial's index and that it failed."""
        self.end()
        index, self._index = self._index, None
        assert index is not None
        return index, Done(Failed(f"it hangs: it had not ended after {self._limit_s:g} s", "hung"), 0.0)

    def end(self) -> None:
        """End the process, at once if it is at work."""
        process, self._process = self._process, None
        if process is None:
            return
        if self.busy:
            process.terminate()
        self.pipe.close()
        process.join()
        process.close()

    def _start(self) -> None:
        self.pipe, far = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_work, args=(far, self._folder), daemon=True)
        self._process.start()
        # Only the worker holds the far end from here on, so that its death closes the pipe.
        far.close()
        self._left_s = SECONDS_PER_PROCESS

    def _exit_code(self) -> int | None:
        assert self._process is not None
        self._process.join()
        return self._process.exitcode


def _work(pipe: Connection, folder: str) -> None:
    """Run trials until the pipe is closed."""
    # Ctrl-C goes to all processes of a terminal; the one that started them handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tempfile.tempdir = folder
    while True:
        try:
            trial = pipe.recv()
        except EOFError:
            return
        start_s = time.process_time()
        result = run_trial(trial)
        pipe.send((result, time.process_time() - start_s))


def run_trial(trial: Trial) -> Any:
    """Run a trial and return its result, `Failed` if it raises."""
    try:
        return trial.work(*trial.arguments)
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{last.filename.rpartition('/')[2]}, line {last.lineno}"
        text = ", ".join(_short(argument) for argument in trial.arguments)
        return Failed(f"{trial.work.__name__}({text}): {type(error).__name__} in {place}: {error}")


def _short(argument: object) -> str:
    """Return a short text of an argument: a profile or a robot by its name."""
    text = str(getattr(argument, "name", argument))
    return text if len(text) <= MAX_TEXT_LENGTH else text[:MAX_TEXT_LENGTH] + "..."


def run_cases(
    cases: Sequence[Case], processes: int, on_trial: Callable[[Case, int], None] = lambda case, left: None
) -> list[CaseResult]:
    """Run all trials of all cases; `on_trial` receives the case of each, and the number of trials left.

    The results do not depend on the number of processes.
    """
    owner = [(number, case) for number, case in enumerate(cases) for _ in case.trials]
    left = [len(case.trials) for case in cases]

    def done(index: int, _result: object) -> None:
        number, case = owner[index]
        left[number] -= 1
        on_trial(case, left[number])

    found = run_trials([trial for case in cases for trial in case.trials], processes, done)
    own: list[list[Done]] = [[] for _ in cases]
    for (number, _), each in zip(owner, found, strict=True):
        own[number].append(each)
    return [
        concluded(case, [each.result for each in mine], sum(each.cpu_s for each in mine))
        for case, mine in zip(cases, own, strict=True)
    ]

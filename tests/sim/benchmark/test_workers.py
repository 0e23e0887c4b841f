"""Workers return what one process would, lose nothing when one of them dies, and leave nothing behind."""

import math
import multiprocessing
import operator
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

from sim.benchmark.case import Failed, Trial
from sim.benchmark.workers import SECONDS_PER_PROCESS, run_trials


def results(trials: list[Trial], processes: int) -> list[Any]:
    return [done.result for done in run_trials(trials, processes)]


def test_results_come_in_the_order_of_the_trials_whatever_the_number_of_processes() -> None:
    # The longest ones are begun first: here from the last to the first.
    trials = [Trial(math.factorial, (n,), cost_s=float(n)) for n in range(7)]
    expected = [math.factorial(n) for n in range(7)]
    assert results(trials, 1) == expected
    assert results(trials, 3) == expected


def test_every_trial_is_told_of_once_with_its_result() -> None:
    done: dict[int, int] = {}
    run_trials([Trial(operator.neg, (n,)) for n in range(4)], 2, done.__setitem__)
    assert done == {0: 0, 1: -1, 2: -2, 3: -3}


def test_a_trial_that_raises_says_what_and_the_others_go_on() -> None:
    first, second = results([Trial(math.sqrt, (-1.0,)), Trial(math.sqrt, (4.0,))], 1)
    assert isinstance(first, Failed)
    assert first.text.startswith("sqrt(-1.0): ValueError in workers.py, line ")
    assert second == 2.0


def test_a_worker_that_dies_takes_its_trial_along_and_is_replaced() -> None:
    # os._exit ends a process as a crash does: nothing is said.
    first, second = results([Trial(os._exit, (7,), cost_s=2.0), Trial(math.sqrt, (4.0,))], 1)
    assert first == Failed("the worker process died with exit code 7", "died")
    assert second == 2.0


def test_a_trial_that_hangs_is_given_up_and_the_others_go_on() -> None:
    trials = [Trial(time.sleep, (3600.0,), limit_s=0.5), Trial(math.sqrt, (4.0,))]
    assert results(trials, 1) == [Failed("it hangs: it had not ended after 0.5 s", "hung"), 2.0]
    assert not multiprocessing.active_children()


def test_a_result_that_cannot_be_sent_is_a_trial_that_failed() -> None:
    (found,) = results([Trial(memoryview, (b"",))], 1)
    assert isinstance(found, Failed)


def test_a_worker_is_renewed_before_it_has_grown_too_large() -> None:
    short = results([Trial(os.getpid, ()) for _ in range(3)], 1)
    assert len(set(short)) == 1
    long = results([Trial(os.getpid, (), cost_s=SECONDS_PER_PROCESS) for _ in range(3)], 1)
    assert len(set(long)) == 3


def test_trials_that_share_something_run_in_one_process_however_long_they_are() -> None:
    def shared(what: str) -> list[Trial]:
        return [Trial(os.getpid, (), SECONDS_PER_PROCESS, what)] * 2

    first, other, second, third = results([*shared("a")[1:], Trial(os.getpid, ()), *shared("a")], 2)
    assert first == second == third != other
    one, another, again, too = results([*shared("a"), *shared("b")], 1)
    assert one == another != again == too


def test_an_interruption_ends_the_workers_at_once_and_removes_their_folders() -> None:
    # The first trial leaves a folder behind; the second would sleep for ten minutes.
    trials = [Trial(tempfile.mkdtemp, (), cost_s=9.0), Trial(time.sleep, (600.0,), cost_s=5.0)]
    left: list[Path] = []

    def interrupt(_: int, result: Any) -> None:
        left.append(Path(result))
        assert left[0].is_dir()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_trials(trials, 2, interrupt)
    assert multiprocessing.active_children() == []
    assert len(left) == 1
    assert not left[0].exists()
    assert left[0].parent.name.startswith("x5-benchmark-")


def test_the_processor_time_of_a_trial_is_its_own() -> None:
    asleep, at_work = run_trials([Trial(time.sleep, (0.2,)), Trial(pow, (7, 300_000))], 1)
    # A big power takes tens of milliseconds of work, sleep next to nothing.
    assert asleep.cpu_s < 0.5 * at_work.cpu_s


def test_no_trials_need_no_process() -> None:
    assert run_trials([], 4) == []

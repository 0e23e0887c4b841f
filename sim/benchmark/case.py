"""The parts of a benchmark: cases, their trials, and the rows computed from the trials' results."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple
from zlib import crc32

import numpy as np

from sim.benchmark.row import Row


class Trial(NamedTuple):
    """One piece of work for a worker process: a function of a module and its arguments, both picklable.

    cost_s: approximate duration; long trials start first, so that all processes end together.
    shares: trials of the same name run one after the other in one process, which keeps what they have in
        common; none by default.
    limit_s: after this time it is given up, and counts as failed. A cluster does not tell when a trial
        begins: what is left is given up when none has ended for that long.
    """

    work: Callable[..., Any]
    arguments: tuple[Any, ...]
    cost_s: float = 1.0
    shares: str = ""
    limit_s: float = math.inf


class Failed(NamedTuple):
    """The result of a trial that raised, hung, or whose process died; `text` describes it."""

    text: str
    how: Literal["raised", "hung", "died"] = "raised"


class Summary(NamedTuple):
    """What follows from the trials of a case.

    sigmas_off: |error| / claimed sigma of every interval that was claimed, for the coverage over all cases.
    over_bound: |error| / its least standard deviation by the physical limit, by what was measured where; a
        case has too few for a bar, all cases together have not.
    reasons: why trials count as missed that ended without what the rows are of.
    """

    rows: Sequence[Row]
    sigmas_off: Sequence[float] = ()
    over_bound: Mapping[str, Sequence[float]] = {}
    reasons: Sequence[str] = ()


class Case(NamedTuple):
    """Trials that belong together; `summarise` is given the results of those that did not fail, in order.

    profile: the noise profile of its robots. known: what the estimators know beforehand.
    """

    name: str
    trials: Sequence[Trial]
    summarise: Callable[[Sequence[Any]], Summary]
    profile: str = ""
    known: str = ""


class CaseResult(NamedTuple):
    """The result of a case. failures: what trials failed at, or why they count as missed.

    cpu_s: processor time of all its trials.
    """

    case: str
    trials: int
    summary: Summary
    failures: tuple[str, ...]
    cpu_s: float = 0.0


def concluded(case: Case, results: Sequence[Any], cpu_s: float = 0.0) -> CaseResult:
    """Summarise the results of all trials of a case; one that failed makes a row that misses its bar."""
    failures = tuple(result.text for result in results if isinstance(result, Failed))
    summary = case.summarise([result for result in results if not isinstance(result, Failed)])
    failed = [Row(f"trials that failed, of {len(results)}", float(len(failures)), 0.0)] if failures else []
    rows = [
        row._replace(case=case.name, profile=case.profile, known=case.known)
        for row in (*failed, *summary.rows)
    ]
    told = (*failures, *summary.reasons)
    return CaseResult(case.name, len(results), summary._replace(rows=rows), told, cpu_s)


def trial_seeds(seed: int, name: str, trials: int) -> list[int]:
    """Return the seeds of trials; they depend on the benchmark's seed, a name and their numbers alone."""
    sequences = [np.random.SeedSequence(seed, spawn_key=(crc32(name.encode()), k)) for k in range(trials)]
    return [int(sequence.generate_state(1)[0]) for sequence in sequences]

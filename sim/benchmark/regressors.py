"""The regressor: equal to pinocchio's, and what it costs beside it."""

from collections.abc import Sequence
from functools import partial

from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, largest, ratio
from sim.experiments.regressor_trial import CHUNK, JOINTS, SAMPLES, RegressorTrial, regressor_trial

EQUAL_BELOW = 1e-9
BATCH_SHARE = 0.5
CHUNK_US = 20.0
_REPEATS = 9


def regressor_cases(seed: int) -> list[Case]:
    """Return the one case; of pinocchio's there is nothing to tell where it is not installed."""
    name = f"regressor, {JOINTS} joints, {SAMPLES} samples"
    return [Case(name, (Trial(regressor_trial, (seed, _REPEATS), 4.0),), partial(_summary, name))]


def _summary(case: str, trials: Sequence[RegressorTrial]) -> Summary:
    there = [trial for trial in trials if trial.loop_us is not None]
    rows = [
        Row(
            case,
            f"in chunks of {CHUNK} [us a sample]",
            None,
            largest([t.chunks_us for t in trials]),
            None,
            CHUNK_US,
        )
    ]
    if there:
        shares = [ratio(trial.batch_us, trial.loop_us) for trial in there]
        differences = [trial.difference for trial in there]
        rows += [
            Row(
                case, "difference from pinocchio's [relative]", None, largest(differences), None, EQUAL_BELOW
            ),
            Row(case, "cost of a batch over pinocchio's loop", None, largest(shares), None, BATCH_SHARE),
        ]
    return Summary(tuple(rows))

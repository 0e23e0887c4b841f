"""Random robots: who is mounted on whom, and how, must be right on every one."""

from collections.abc import Sequence
from functools import partial

from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, count, largest
from sim.experiments.random_robots import TopologyTrial, topology_trial
from sim.random_robot import random_robot

NOISE = "x5-uncalibrated"
_COST_S = 6.0
AMONG = 10


def topology_cases(robots: int, seed: int, small: bool = False) -> list[Case]:
    """Return the one case of random robots; their seeds follow one another from the benchmark's.

    `small`: of every `AMONG` of them only the one with the fewest modules.
    """
    among = AMONG if small else 1
    first = robots * among * seed
    drawn = [range(first + among * number, first + among * (number + 1)) for number in range(robots)]
    work = tuple(Trial(topology_trial, (_smallest(seeds), NOISE), _COST_S) for seeds in drawn)
    case = f"random robots, {NOISE}" + (f", the smallest of {AMONG}" if small else "")
    return [Case(case, work, partial(_summary, case))]


def _smallest(seeds: Sequence[int]) -> int:
    return seeds[0] if len(seeds) == 1 else min(seeds, key=lambda seed: len(random_robot(seed).modules))


def _summary(case: str, trials: Sequence[TopologyTrial]) -> Summary:
    wrong = [bool(trial.differences) for trial in trials]
    least = min((trial.confidence for trial in trials), default=None)
    return Summary(
        (
            count(case, "wrong topology or mounting", wrong),
            Row(case, "least confidence of all", None, least),
            Row(case, "motions repeated for doubt, most", None, largest([float(t.repeats) for t in trials])),
        )
    )

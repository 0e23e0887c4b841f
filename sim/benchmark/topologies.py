"""Random robots: who is mounted on whom, and how, must be right on every one."""

from collections.abc import Sequence

from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.row import Row, count, largest
from sim.experiments.random_robots import TopologyTrial, topology_trial

NOISE = "x5-uncalibrated"
_COST_S = 6.0


def topology_cases(robots: int, seed: int) -> list[Case]:
    """Return the one case of random robots; their seeds follow one another from the benchmark's."""
    work = tuple(Trial(topology_trial, (robots * seed + number, NOISE), _COST_S) for number in range(robots))
    return [Case(f"random robots, {NOISE}", work, _summary)]


def _summary(trials: Sequence[TopologyTrial]) -> Summary:
    case = f"random robots, {NOISE}"
    wrong = [bool(trial.differences) for trial in trials]
    least = min((trial.confidence for trial in trials), default=None)
    return Summary(
        (
            count(case, "wrong topology or mounting", wrong),
            Row(case, "least confidence of all", None, least),
            Row(case, "motions repeated for doubt, most", None, largest([float(t.repeats) for t in trials])),
        )
    )

"""Gravity compensation: an arm stays where it is left, and a light hand leads it."""

from collections.abc import Sequence
from functools import partial

from sim.benchmark.case import Case, Summary, Trial, trial_seed
from sim.benchmark.row import Row, largest, ratio
from sim.experiments.floating import POSES, FloatTrial, float_trial, true_weight
from sim.place import somewhere
from sim.robot_file import load_robot

ROBOT = "a2085_04"
DRIFT_S, QUICK_DRIFT_S = 10.0, 3.0
# A tip at 0.7 m stays within an inch, and a hand needs a quarter of the force.
DRIFT_DEG, LIGHT = 2.0, 0.25
_COST_S, _QUICK_COST_S = 10.0, 5.0


def float_cases(trials: int, seed: int, shortened: bool = False) -> list[Case]:
    """Return the one case; `shortened`: of one pose, and for some seconds."""
    name = f"{ROBOT}, x5, floating, known without error"
    cost_s = _QUICK_COST_S if shortened else _COST_S
    work = tuple(
        Trial(floated, (trial_seed(seed, name, number), shortened), cost_s) for number in range(trials)
    )
    return [Case(name, work, partial(_summary, name))]


def floated(seed: int, shortened: bool) -> FloatTrial:
    """Let an arm float that knows its weight without error: what is left is the modules' own."""
    robot = somewhere(load_robot(ROBOT), seed)
    drift_s, poses = (QUICK_DRIFT_S, POSES[1:2]) if shortened else (DRIFT_S, POSES)
    return float_trial(seed, robot, true_weight(robot), "x5", drift_s, poses)


def _summary(case: str, trials: Sequence[FloatTrial]) -> Summary:
    alone = largest([trial.drift_deg for trial in trials])
    after = largest([trial.rest_deg for trial in trials])
    guiding = largest([trial.guiding_n for trial in trials])
    light = largest([ratio(trial.guiding_n, trial.held_n) for trial in trials])
    rows = (
        Row(case, "drift left alone, most [deg]", None, alone, None, DRIFT_DEG),
        Row(case, "force that leads the tip, most [N]", None, guiding),
        Row(case, "the same over that of an arm held in position", None, light, None, LIGHT),
        Row(case, "drift after a hand has led it [deg]", None, after, None, DRIFT_DEG),
    )
    return Summary(rows)

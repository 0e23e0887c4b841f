"""Payloads: what an arm is handed is found on the right body, as heavy and where it is; nothing is not."""

from collections.abc import Sequence
from functools import partial

from coordinator.plan import Plan
from sim.benchmark.case import Case, Summary, Trial, trial_seed
from sim.benchmark.inertias import PLAN, QUICK_PLAN
from sim.benchmark.row import Row, count, largest, scaled
from sim.experiments.payload_trial import PayloadTrial, payload_trial

ROBOT = "a2085_06"
MASS_PERCENT, COM_MM, MOTION_S = 3.0, 5.0, 15.0
_COST_S, _QUICK_COST_S = 26.0, 15.0


def payload_cases(trials: int, seed: int, shortened: bool = False) -> list[Case]:
    """Return the case of a payload, and with more than one trial that of none."""
    plan, cost_s = (QUICK_PLAN, _QUICK_COST_S) if shortened else (PLAN, _COST_S)
    cases = [_case(f"{ROBOT}, payload of 0.2 kg", True, trials, seed, plan, cost_s)]
    if not shortened:
        cases.append(_case(f"{ROBOT}, no payload", False, trials, seed, plan, cost_s))
    return cases


def _case(name: str, carries: bool, trials: int, seed: int, plan: Plan, cost_s: float) -> Case:
    work = tuple(
        Trial(payload_trial, (ROBOT, "x5", trial_seed(seed, name, number), plan, carries), cost_s)
        for number in range(trials)
    )
    return Case(name, work, partial(_carrying if carries else _bare, name))


def _carrying(case: str, trials: Sequence[PayloadTrial]) -> Summary:
    found = [trial for trial in trials if trial.found]
    rows = (
        count(case, "payloads not found, or on another body", [not t.on_its_body for t in trials]),
        Row(
            case,
            "mass, worst [%]",
            None,
            scaled(largest([t.mass_error for t in found]), 100.0),
            None,
            MASS_PERCENT,
        ),
        Row(
            case,
            "centre, worst [mm]",
            None,
            scaled(largest([t.com_error_m for t in found]), 1e3),
            None,
            COM_MM,
        ),
        Row(case, "motion, longest [s]", None, largest([t.motion_s for t in trials]), None, MOTION_S),
    )
    return Summary(rows)


def _bare(case: str, trials: Sequence[PayloadTrial]) -> Summary:
    return Summary((count(case, "payloads found where none is", [t.found for t in trials]),))

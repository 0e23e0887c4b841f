"""Torque assistance: calculated torque follows best where it is stable; six joints gain threefold."""

from collections.abc import Sequence
from functools import partial

from sim.benchmark.case import Case, Summary, Trial
from sim.benchmark.cases.arm import KNOWN
from sim.benchmark.row import Row, count
from sim.imperfections.noise_profile import noise_profile
from sim.thesis.dynamics.torque_assistance import identified_model, standing_robot, true_model
from sim.thesis.dynamics.torque_assistance_cases import (
    ABOUT_AS_WELL,
    MIN_GAIN,
    Combination,
    robots_of,
    try_case,
)
from sim.thesis.dynamics.torque_assistance_cases import Case as Combined
from sim.thesis.dynamics.torque_assistance_cases import cases as combinations

NOISE = "x5"
_IDENTIFY_COST_S, _CASE_COST_S = 12.0, 4.0
# One with which both arms are stable.
_QUICK_SETTING = "#4"


def assistance_cases(seed: int, shortened: bool = False) -> list[Case]:
    """Return a case for every robot and kind of gains: the thesis' arm, and arms of six joints.

    `shortened`: of every case one combination, on a robot that is known without error.
    """
    groups: dict[str, list[Combined]] = {}
    for combined in combinations(quick=shortened):
        groups.setdefault(_name(combined), []).append(combined)
    found = []
    for name, own in groups.items():
        chosen = [one for one in own if one.gains.setting in (None, _QUICK_SETTING)][:1] if shortened else own
        cost_s = _CASE_COST_S * len(chosen) + (0.0 if shortened else _IDENTIFY_COST_S)
        # Every robot is identified once for all of its combinations.
        shares = [(robot, tuple(one for one in chosen if one.robot == robot)) for robot in robots_of(chosen)]
        work = [Trial(assistance_of_robot, (*share, seed, shortened), cost_s) for share in shares]
        name += ", true model" if shortened else ""
        known = "the true model" if shortened else KNOWN["calibrated"]
        found.append(Case(name, work, partial(_summary, _limit(chosen[0])), NOISE, known))
    return found


def assistance_of_robot(
    robot: str, chosen: Sequence[Combined], seed: int, shortened: bool
) -> list[Combination]:
    """Identify a robot, or take it as known without error if `shortened`, and try combinations on it."""
    noise = noise_profile(NOISE)
    model = (
        true_model(robot, seed, noise)
        if shortened
        else identified_model(standing_robot(robot, seed), noise, seed)
    )
    return [try_case(case, model, noise, seed) for case in chosen]


def _name(combined: Combined) -> str:
    if combined.alignment is None:
        return f"assistance, six joints, strategy {combined.gains.strategy}"
    whose = "the factory's" if combined.gains.setting is None else "the thesis'"
    return f"assistance, {combined.alignment}, {whose} gains"


def _limit(combined: Combined) -> float | None:
    """Return what the error by calculated torque must not exceed of that without."""
    if combined.alignment is None:
        return 1.0 / MIN_GAIN
    return ABOUT_AS_WELL if combined.gains.setting is not None else None


def _summary(limit: float | None, trials: Sequence[list[Combination]]) -> Summary:
    tried = [combination for trial in trials for combination in trial]
    stable = [each for each in tried if each.is_stable]
    most = max((1.0 / each.gain for each in stable), default=None)
    rows = [
        Row("error by calculated torque over that without, most", most, limit),
        Row(f"unstable with it, of {len(tried)}", float(len(tried) - len(stable))),
    ]
    if limit == ABOUT_AS_WELL:
        rows.insert(0, count("stable, and not the best of three modes", [not each.helps for each in stable]))
    return Summary(rows)

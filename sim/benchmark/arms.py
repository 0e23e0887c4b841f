"""Whole robots: links, axes and tips against the truth, the thesis' chain on the same recordings."""

from collections.abc import Callable, Sequence
from functools import partial
from statistics import median

from coordinator.kinematics.imu_intrinsics import ImuKind
from coordinator.plan import Mode, Motions, Plan
from sim.benchmark.case import Case, Summary, Trial, trial_seed
from sim.benchmark.row import Row, count, for_few, largest, mean_abs, rms, scaled
from sim.experiments.arm_trial import ArmTrial, TipErrors, arm_plan, arm_trial, imu_kind
from sim.noise_profile import noise_profile

ARMS = ("a2085_04", "a2085_06", "arm7")
WHOLE_ARM = COST_ARM = "a2085_06"
PROFILES = ("x5", "x5-uncalibrated")
TIP_MM = {"x5": 1.0, "x5-uncalibrated": 4.0}
# Where the IMU's own axes are only known to a degree, no tip's orientation is known better.
TIP_DEG = {"x5": 0.1, "x5-uncalibrated": None}
AXIS_DEG = {"x5": 0.1, "x5-uncalibrated": None}
JOINT_TIME_S, THESIS_JOINT_TIME_S = 10.0, 18.0
WHOLE_TIME_S = 20.0
REFINEMENT_S = 5.0
# The thesis' motions, and less of everything.
SHORTENED = {
    "motions": "thesis",
    "discover_s": 0.3,
    "link_s": 0.3,
    "rest_s": 0.5,
    "settle_s": 0.3,
    "travel_speed_rad_s": 2.0,
    "constant_duration_s": 0.5,
    "sine_centre_s": 0.8,
    "sine_sigma_s": 0.3,
}
# About what a trial takes on one core.
_COST_S = {"a2085_04": 8.0, "a2085_06": 14.0, "arm7": 16.0}
_WHOLE_COST_S = 6.0


def arm_cases(trials: int, seed: int, shortened: bool = False, motions: Motions | None = None) -> list[Case]:
    """Return one case for every arm and profile, joint by joint and all joints at once.

    `shortened` motions save time: joint by joint, of all cases but the first. `motions`: see `arm_plan`.
    """
    joints = [(arm, noise) for arm in ARMS for noise in PROFILES]
    cases = []
    for number, (arm, noise) in enumerate(joints):
        short = shortened and number > 0
        plan = arm_plan("joint", _imu(noise), motions)
        own = plan.model_copy(update=SHORTENED) if short else plan
        cases.append(_case(arm, noise, own, trials, seed, short))
    whole = [_case(WHOLE_ARM, noise, arm_plan("whole", _imu(noise)), trials, seed) for noise in PROFILES]
    return cases + whole


def _imu(noise: str) -> ImuKind:
    return imu_kind(noise_profile(noise))


def _case(arm: str, noise: str, plan: Plan, trials: int, seed: int, shortened: bool = False) -> Case:
    mode = plan.mode
    how = "joint by joint" if mode == "joint" else "all joints at once"
    cost_s = _COST_S[arm] if mode == "joint" else _WHOLE_COST_S
    # The same modules in both profiles and both modes.
    work = tuple(
        Trial(
            arm_trial,
            (arm, noise, trial_seed(seed, arm, number), mode, "lan", plan),
            0.5 * cost_s if shortened else cost_s,
        )
        for number in range(trials)
    )
    name = f"{arm}, {noise}, {how}"
    return Case(name, work, partial(_summary, name, noise, mode, shortened))


def _summary(case: str, noise: str, mode: Mode, shortened: bool, trials: Sequence[ArmTrial]) -> Summary:
    """Return the rows of an arm; a trial that ended early, or with another topology, is counted as wrong."""
    rows = [
        _wrong(case, trials),
        *_tip_rows(case, noise, trials),
        *_link_rows(case, noise, trials),
        *_time_rows(case, mode, shortened, trials),
    ]
    if mode == "joint" and case.startswith(COST_ARM):
        spent = [t.identify_s for t in trials if not t.why]
        figure = "refinement and all before it, median [s of a core]"
        rows.append(Row(case, figure, None, median(spent) if spent else None, None, REFINEMENT_S))
    return Summary(tuple(rows), sigmas_off(trials))


def sigmas_off(trials: Sequence[ArmTrial]) -> tuple[float, ...]:
    """Return |error| / sigma of every link's length that was claimed."""
    links = [link for trial in trials for link in trial.links]
    return tuple(
        abs(link.error_m) / link.sigma_m for link in links if link.error_m is not None and link.sigma_m
    )


def _wrong(case: str, trials: Sequence[ArmTrial]) -> Row:
    return count(
        case, "runs without the right topology", [bool(trial.why or trial.differences) for trial in trials]
    )


def _tip_rows(case: str, noise: str, trials: Sequence[ArmTrial]) -> tuple[Row, Row]:
    thesis, ours, bound = (
        [tip for tip in tips if tip is not None]
        for tips in (
            [trial.thesis_tip for trial in trials],
            [trial.tip for trial in trials],
            [trial.tip_bound for trial in trials],
        )
    )

    def row(figure: str, of: Callable[[TipErrors], float], limit: float | None) -> Row:
        values = [rms([of(tip) for tip in tips]) for tips in (thesis, ours, bound)]
        return Row(case, figure, values[0], values[1], values[2], for_few(limit, len(trials)))

    return (
        row("tip position, rms [mm]", lambda tip: 1e3 * tip.position_m, TIP_MM[noise]),
        row("tip orientation, rms [deg]", lambda tip: tip.orientation_deg, TIP_DEG[noise]),
    )


def _link_rows(case: str, noise: str, trials: Sequence[ArmTrial]) -> tuple[Row, Row, Row]:
    links = [link for trial in trials for link in trial.links]
    thesis_mm = scaled(mean_abs([link.thesis_error_m for link in links]), 1e3)
    ours_mm = scaled(mean_abs([link.error_m for link in links]), 1e3)
    # The mean size of a Gaussian error is sqrt(2 / pi) of its standard deviation.
    bound_mm = scaled(rms([link.bound_m for link in links]), 1e3 * 0.7979)
    vector_mm = scaled(mean_abs([link.vector_error_m for link in links]), 1e3)
    return (
        Row(case, "link length, mean |error| [mm]", thesis_mm, ours_mm, bound_mm),
        Row(case, "link vector, mean |error| [mm]", None, vector_mm),
        Row(
            case,
            "axis, largest error [deg]",
            largest([link.thesis_axis_error_deg for link in links]),
            largest([link.axis_error_deg for link in links]),
            limit=AXIS_DEG[noise],
        ),
    )


def _time_rows(case: str, mode: Mode, shortened: bool, trials: Sequence[ArmTrial]) -> tuple[Row, ...]:
    """Return how long the robot was at work; of shortened motions that meets no bar."""
    done = [trial for trial in trials if not trial.why]
    if mode == "whole":
        spent = largest([trial.robot_time_s for trial in done])
        return (Row(case, "robot time in all, longest [s]", None, spent, None, WHOLE_TIME_S),)
    each = largest([trial.robot_time_s / trial.joints for trial in done])
    return (
        Row(
            case,
            "robot time a joint, longest [s]",
            THESIS_JOINT_TIME_S,
            each,
            None,
            None if shortened else JOINT_TIME_S,
        ),
    )

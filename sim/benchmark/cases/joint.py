"""The thesis' eight one-joint arms: its estimator, ours and the Cramer-Rao bound on the same recordings."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

from sim.benchmark.case import Case, Summary, Trial, trial_seed
from sim.benchmark.row import Row, for_few, largest, mean_abs, ratio, rms, scaled
from sim.imperfections.noise_profile import NoiseProfile, noise_profile, switched
from sim.thesis.joint_trial import JointTrial, joint_trial
from sim.thesis.published import ALIGNMENTS, LENGTHS_MM, Alignment

_COST_S = 1.2
_SIGMAS_95 = 1.96


class Setting(NamedTuple):
    """A noise profile and its bars; None where it has none.

    error_mm: of the mean |error|. over_bound: of the rms error over the bound. axis_deg: of the largest
    error. error_share: of the mean |error| in per cent of the length, where gravity can calibrate the axis.
    """

    name: str
    noise: NoiseProfile
    error_mm: float | None = None
    over_bound: float | None = None
    axis_deg: float | None = None
    error_share: float | None = None


SETTINGS = (
    Setting(
        "x5 on a solid base",
        switched(noise_profile("x5"), off=("base-shake",)),
        error_mm=0.5,
        over_bound=1.5,
        axis_deg=0.1,
    ),
    Setting("x5 on a shaking base", noise_profile("x5"), error_mm=1.5, axis_deg=0.1),
    Setting("x5-uncalibrated", noise_profile("x5-uncalibrated"), error_share=0.5),
)


def joint_cases(trials: int, seed: int) -> list[Case]:
    """Return one case for every arm and setting."""
    return [
        _case(setting, alignment, length, trials, seed)
        for setting in SETTINGS
        for alignment in ALIGNMENTS
        for length in LENGTHS_MM
    ]


def _case(setting: Setting, alignment: Alignment, length_mm: int, trials: int, seed: int) -> Case:
    arm = f"{length_mm} mm {alignment}"
    # The same modules in all settings.
    work = tuple(
        Trial(joint_trial, (length_mm, alignment, setting.noise, trial_seed(seed, arm, number)), _COST_S)
        for number in range(trials)
    )
    name = f"{arm}, {setting.name}"
    return Case(name, work, partial(_summary, name, setting, alignment, length_mm))


def _summary(
    case: str, setting: Setting, alignment: Alignment, length_mm: int, trials: Sequence[JointTrial]
) -> Summary:
    rows = [*_error_rows(case, setting, trials), _axis_row(case, setting, trials)]
    if setting.error_share is not None:
        rows += _share_rows(case, setting, alignment, length_mm, trials)
    off = tuple(abs(trial.ours_error_m) / trial.ours_sigma_m for trial in trials)
    return Summary(tuple(rows), off)


def _error_rows(case: str, setting: Setting, trials: Sequence[JointTrial]) -> tuple[Row, Row]:
    thesis, ours = [t.thesis_error_m for t in trials], [t.ours_error_m for t in trials]
    bound_m = rms([t.bound_m for t in trials])
    # The bound is a standard deviation; the mean size of such a Gaussian error is sqrt(2 / pi) of it.
    mean = Row(
        case,
        "length, mean |error| [mm]",
        scaled(mean_abs(thesis), 1e3),
        scaled(mean_abs(ours), 1e3),
        scaled(bound_m, 1e3 * 0.7979),
        for_few(setting.error_mm, len(trials)),
    )
    over = Row(
        case,
        "length, rms error over the bound",
        ratio(rms(thesis), bound_m),
        ratio(rms(ours), bound_m),
        1.0 if trials else None,
        for_few(setting.over_bound, len(trials)),
    )
    return mean, over


def _axis_row(case: str, setting: Setting, trials: Sequence[JointTrial]) -> Row:
    worst = largest([t.axis_error_deg for t in trials])
    return Row(case, "axis, largest error [deg]", None, worst, None, setting.axis_deg)


def _share_rows(
    case: str, setting: Setting, alignment: Alignment, length_mm: int, trials: Sequence[JointTrial]
) -> list[Row]:
    """Return errors in per cent; an axis that gravity cannot calibrate has an interval in place of a bar."""
    to_percent = 100.0 / (1e-3 * length_mm)
    thesis = scaled(mean_abs([t.thesis_error_m for t in trials]), to_percent)
    ours = scaled(mean_abs([t.ours_error_m for t in trials]), to_percent)
    half = scaled(mean_abs([t.ours_sigma_m for t in trials]), _SIGMAS_95 * to_percent)
    limit = for_few(setting.error_share, len(trials)) if alignment == "vertical" else None
    return [
        Row(case, "length, mean |error| [%]", thesis, ours, None, limit),
        Row(case, "length, half of the 95 % interval, mean [%]", None, half),
    ]

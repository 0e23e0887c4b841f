"""The thesis' eight one-joint arms: its estimator, ours and the Cramer-Rao bound on the same recordings."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

from sim.benchmark.case import Case, Summary, Trial, trial_seeds
from sim.benchmark.cases.arm import KNOWN
from sim.benchmark.row import SIGMAS_95, Row, largest, mean_abs, ratio, rms, scaled
from sim.imperfections.noise_profile import NoiseProfile, imu_kind, noise_profile, switched
from sim.thesis.kinematics.joint_trial import JointTrial, joint_trial
from sim.thesis.published import ALIGNMENTS, LENGTHS_MM, Alignment

LENGTH_OF_ONE = "length, one joint, x5 on a solid base"
# Half an interval where gravity cannot calibrate: scales of 1 % and axes of 1 deg, as delivered.
INTERVAL_PERCENT = 5.0
_COST_S = 1.2


class Setting(NamedTuple):
    """A noise profile and its bars; None where it has none.

    error_mm: of the mean |error|. axis_deg: of the largest error. error_share: of the mean |error| in per
    cent of the length, where gravity can calibrate the axis. bounded: errors are held against the bound.
    """

    name: str
    noise: NoiseProfile
    error_mm: float | None = None
    axis_deg: float | None = None
    error_share: float | None = None
    bounded: bool = False


SETTINGS = (
    Setting(
        "x5 on a solid base",
        switched(noise_profile("x5"), off=("base-shake",)),
        error_mm=0.5,
        axis_deg=0.1,
        bounded=True,
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
    work = [
        Trial(joint_trial, (length_mm, alignment, setting.noise, own), _COST_S)
        for own in trial_seeds(seed, arm, trials)
    ]
    summarise, known = partial(_summary, setting, alignment, length_mm), KNOWN[imu_kind(setting.noise)]
    return Case(f"{arm}, {setting.name}", work, summarise, setting.noise.name, known)


def _summary(setting: Setting, alignment: Alignment, length_mm: int, trials: Sequence[JointTrial]) -> Summary:
    thesis, ours = [t.thesis_error_m for t in trials], [t.ours_error_m for t in trials]
    thesis_m, ours_m, bound_m = mean_abs(thesis), mean_abs(ours), rms([t.bound_m for t in trials])
    rows = [
        Row(
            "length, mean |error| [mm]",
            scaled(ours_m, 1e3),
            setting.error_mm,
            scaled(thesis_m, 1e3),
            # The bound is a standard deviation; the mean size of such a Gaussian error is sqrt(2 / pi) of it.
            scaled(bound_m, 1e3 * 0.7979),
        ),
        Row(
            "length, rms error over the bound",
            ratio(rms(ours), bound_m),
            None,
            ratio(rms(thesis), bound_m),
            1.0 if trials else None,
        ),
        Row("axis, largest error [deg]", largest([t.axis_error_deg for t in trials]), setting.axis_deg),
    ]
    if setting.error_share is not None:
        to_percent = 100.0 / (1e-3 * length_mm)
        half = scaled(mean_abs([t.ours_sigma_m for t in trials]), SIGMAS_95 * to_percent)
        # An axis that gravity cannot calibrate has an interval in place of a bar.
        limit = setting.error_share if alignment == "vertical" else None
        rows += [
            Row("length, mean |error| [%]", scaled(ours_m, to_percent), limit, scaled(thesis_m, to_percent)),
            Row("length, half of the 95 % interval, mean [%]", half, INTERVAL_PERCENT),
        ]
    off = [abs(trial.ours_error_m) / trial.ours_sigma_m for trial in trials]
    over = [abs(trial.ours_error_m) / trial.bound_m for trial in trials]
    return Summary(rows, off, {LENGTH_OF_ONE: over} if setting.bounded else {})

"""Variants of the joint regression by the source of the joint's motion, compared on the same trials.

The encoder is quantised, the gyro drifts and also measures the bending of the link, the command differs from
the motion. All variants solve the same equations (`joint_regression`); they differ in the joint angle and in
the instruments of the equations:

    encoder   the encoder's angle; the gyro is a measurement that determines the axis and the bending
    gyro      the gyro's integral; the encoder determines its offset and slope only
    fused     the gyro's integral at high, the encoder's angle at low frequencies
    command   the encoder's angle, with the filtered command as instrument

Gyro and fused include the bending and the swing of a base, but not the acceleration of a swinging base; they
inherit the gyro's scale error. The agents use `encoder`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from module_agent.estimate.circle_point_analysis import CircleFit, rest_reading
from module_agent.estimate.gaussian_filter import gaussian_filter
from module_agent.estimate.joint_regression import JointRegression, regress_joint
from module_agent.estimate.observed_motion import MotionWindows, ObservedMotion, observed_motions
from module_agent.estimate.smoothing import SmoothMotion
from module_agent.estimate.windows import Array, ImuWindow, JointWindow, imu_window
from module_agent.model.errors import DataError
from sim.imperfections.noise_profile import NoiseProfile
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import sensing_chain
from sim.scoring.chain_score import link_length_m
from sim.test_bench.one_joint_rig import IMU, OneJointRig, TrialRows, analyse, regress, windows
from sim.thesis.kinematics.joint_trial import bound_m, imu_knowledge, rms, trial_plan
from sim.thesis.published import Alignment, thesis_length

# Below this Gaussian low-pass the encoder is used, above it the gyro: it has 96 % of 2 Hz, so that the angle
# includes the link's bending.
CROSSOVER_S = 0.2
# The joint follows its command within this many rows of 4 ms either way.
FOLLOWS_ROWS = 24


class Estimate(NamedTuple):
    """An estimator's error of the distance, and its claimed sigma, both in metres."""

    error_m: float
    sigma_m: float


class Comparison(NamedTuple):
    """The estimates of one trial by estimator, and the bound of that recording [m]."""

    estimates: dict[str, Estimate]
    bound_m: float


Variant = Callable[[TrialRows, NoiseProfile], CircleFit | JointRegression]


def compare(length_mm: int, alignment: Alignment, profile: NoiseProfile, seed: int) -> Comparison:
    """Run one trial of the thesis' arm and all estimators on it, except those for which it moves too little.

    Raises:
        KeyError: the thesis had no such arm.
        ExperimentFailed: a module refused a motion, or broke it off.
    """
    robot = load_robot(f"thesis_{length_mm}_{alignment}")
    with OneJointRig(robot, seed, profile) as rig:
        trial = rig.trial(trial_plan(thesis_length(alignment, length_mm), profile))
        true_m = link_length_m(sensing_chain(rig.world.robot), child=IMU)
    return compare_estimators(trial, profile, true_m)


def compare_estimators(trial: TrialRows, profile: NoiseProfile, true_m: float) -> Comparison:
    """Run all estimators on one recording whose true distance is known."""
    estimates: dict[str, Estimate] = {}
    for name, variant in VARIANTS.items():
        try:
            fit = variant(trial, profile)
        except DataError:
            continue
        estimates[name] = Estimate(fit.distance_m - true_m, fit.sigma_distance_m)
    return Comparison(estimates, bound_m(trial, profile))


# ---------------------------------------------------------------------- the variants


def _encoder(trial: TrialRows, profile: NoiseProfile) -> JointRegression:
    return regress(trial, imu_knowledge(profile))


def _gyro(trial: TrialRows, profile: NoiseProfile, crossover_s: float | None = None) -> JointRegression:
    motions = [_by_gyro(trial, window, crossover_s) for window in windows(trial)]
    return _regressed(trial, profile, motions)


def _command(trial: TrialRows, profile: NoiseProfile) -> JointRegression:
    motions = []
    for window, motion in zip(windows(trial), (trial.constant, trial.sine), strict=True):
        commanded = _commanded(window.joint, motion.joint["position_command_rad"])
        motions.append(observed_motions([window])[0]._replace(instrument=SmoothMotion(commanded)))
    return _regressed(trial, profile, motions)


VARIANTS: Mapping[str, Variant] = {
    "thesis": lambda trial, _profile: analyse(trial),
    "encoder": _encoder,
    "gyro": _gyro,
    "fused": lambda trial, profile: _gyro(trial, profile, CROSSOVER_S),
    "command": _command,
}


def _regressed(trial: TrialRows, profile: NoiseProfile, motions: list[ObservedMotion]) -> JointRegression:
    rest = rest_reading(imu_window(trial.rest))
    return regress_joint(motions, rest, imu_knowledge(profile), symmetric_load=True)


def _by_gyro(trial: TrialRows, window: MotionWindows, crossover_s: float | None) -> ObservedMotion:
    """Return the motion with an angle from the gyro; the encoder gives its slow part, or offset and slope."""
    since_ns = window.imu.t_ns - window.offset_ns
    inside = (since_ns >= window.joint.t_ns[0]) & (since_ns <= window.joint.t_ns[-1])
    imu = ImuWindow(*(column[inside] for column in window.imu))
    t_s = 1e-9 * (imu.t_ns - imu.t_ns[0])
    encoder = np.interp(since_ns[inside], window.joint.t_ns, window.joint.position_rad)
    rest = rest_reading(imu_window(trial.rest))
    gyro = imu.gyro_rad_s - rest.gyro_offset_rad_s
    rate = np.gradient(encoder, t_s)
    axis = rate @ gyro
    along = gyro @ axis / np.linalg.norm(axis)
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (along[1:] + along[:-1]) * np.diff(t_s))])
    rest_of = encoder - turned
    if crossover_s is None:
        turned = turned + np.polyval(np.polyfit(t_s, rest_of, 1), t_s)
    else:
        spread = crossover_s * (t_s.size - 1) / t_s[-1]
        turned = turned + gaussian_filter(rest_of, 2 * round(4.0 * spread) + 1, spread)
    joint = JointWindow(since_ns[inside], turned, along)
    return observed_motions([window._replace(joint=joint)])[0]._replace(base=None)


def _commanded(joint: JointWindow, command_rad: Array) -> JointWindow:
    """Return the joint's motion predicted from its command by the best FIR filter."""
    command = np.where(np.isfinite(command_rad), command_rad, joint.position_rad)
    padded = np.pad(command, (FOLLOWS_ROWS, 0), mode="edge")
    lags = np.lib.stride_tricks.sliding_window_view(padded, FOLLOWS_ROWS + 1)[:, ::4]
    columns = np.hstack([lags, np.ones((len(lags), 1))])
    weights, *_ = np.linalg.lstsq(columns, joint.position_rad, rcond=1e-9)
    return joint._replace(position_rad=columns @ weights)


# Of a normal error 95 in 100 are within this many standard deviations.
_WITHIN = 1.96


class Arm(NamedTuple):
    """One of the thesis' arms."""

    alignment: Alignment
    length_mm: int


class EstimatorRow(NamedTuple):
    """An estimator on an arm: figures over all trials, lengths in millimetres.

    ratio: rms error over the bound, both over all trials. covered: share of 95 % intervals that contain the
    truth.
    """

    alignment: Alignment
    length_mm: int
    estimator: str
    trials: int
    mean_error_mm: float
    bias_mm: float
    rms_mm: float
    sigma_mm: float
    bound_mm: float
    ratio: float
    covered: float


def estimator_rows(arm: Arm, comparisons: Sequence[Comparison]) -> list[EstimatorRow]:
    """Return a row for every estimator with an estimate in any trial of an arm."""
    bound = rms(np.array([each.bound_m for each in comparisons]))
    rows = []
    for name in VARIANTS:
        estimates = [each.estimates[name] for each in comparisons if name in each.estimates]
        if not estimates:
            continue
        error, sigma = np.array(estimates).T
        rows.append(
            EstimatorRow(
                alignment=arm.alignment,
                length_mm=arm.length_mm,
                estimator=name,
                trials=len(estimates),
                mean_error_mm=1e3 * float(np.abs(error).mean()),
                bias_mm=1e3 * float(error.mean()),
                rms_mm=1e3 * rms(error),
                sigma_mm=1e3 * rms(sigma),
                bound_mm=1e3 * bound,
                ratio=rms(error) / bound,
                covered=float(np.mean(np.abs(error) < _WITHIN * sigma)),
            )
        )
    return rows

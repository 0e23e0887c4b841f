"""Whole robots: links, axes and tips against the truth, with the thesis' chain on the same recordings.

The thesis' chain is assembled from the agents' circle point analyses; ours is the batch refinement over all
motions.
"""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from statistics import median
from typing import NamedTuple

import numpy as np

from coordinator.excitation.plan import Mode, Motions, Plan
from coordinator.identification.identified import Kinematics
from coordinator.identification.identify import identify_kinematics
from coordinator.kinematics.chain_estimate import link_lengths
from coordinator.recording.recording import Recording
from module_agent.model.catalogue import ImuKind
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import RobotError
from module_agent.model.imu_prior import IMU_PRIORS
from module_agent.network_emulation.profile_file import network as named_network
from module_agent.signals.clock_map import ClockMap
from sim.benchmark.case import Case, Summary, Trial, trial_seeds
from sim.benchmark.chain_bound import Bounds, chain_bounds
from sim.benchmark.row import Row, count, largest, mean_abs, ratio, rms, scaled
from sim.imperfections.noise_profile import NoiseProfile, imu_kind, noise_profile
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import sensing_chain, true_chain
from sim.robot.variants import as_built, at_random_site
from sim.scoring.chain_score import LinkErrors, link_errors, tip_errors, tip_spread, topology_differences
from sim.sensors.module_clock import ModuleClock, module_time
from sim.thesis.kinematics.circle_chain import thesis_chain
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from sim.virtual_time.session import record_session
from sim.world.truth import Motion

# Instants of a session at which the clocks' maps are compared with one another.
INSTANTS = 200


class ArmLink(NamedTuple):
    """The errors of one true link, by our chain and by the thesis'; None where a chain has no such link.

    sigma_m: as claimed for our length. bound_m: the least that it can be (`chain_bounds`, Bayesian).
    """

    ours: LinkErrors | None
    thesis: LinkErrors | None
    sigma_m: float | None
    bound_m: float | None

    @property
    def error_m(self) -> float | None:
        """The error of our length."""
        return None if self.ours is None else self.ours.length_m


class TipErrors(NamedTuple):
    """Root mean squares over 1000 random poses of all leaves (see `chain_score.tip_errors`)."""

    position_m: float
    orientation_deg: float


class ArmTrial(NamedTuple):
    """The result of one trial; of one that failed only the first five fields are set.

    why: the reason for a failure, empty without one. differences: errors of the topology, described; tips are
    not compared then. tip_bound, strict_tip_bound: the least errors that the recording allows, with the
    estimator's priors and without any (`chain_bounds`); None without pinocchio, the latter also if priors
    alone resolve a direction. identify_s: processor time from the recording to the chain. clock_error_s: root
    mean square, over modules and times, of the differences between the modules' mapped clocks; clock_sigma_s:
    as claimed.
    """

    network: str
    mode: Mode
    seed: int
    joints: int
    why: str
    differences: tuple[str, ...] = ()
    links: tuple[ArmLink, ...] = ()
    tip: TipErrors | None = None
    thesis_tip: TipErrors | None = None
    tip_bound: TipErrors | None = None
    strict_tip_bound: TipErrors | None = None
    robot_time_s: float = 0.0
    identify_s: float = 0.0
    clock_error_s: float | None = None
    clock_sigma_s: float | None = None

    @property
    def right(self) -> bool:
        """Whether the session came to its end, and the topology is that of the robot."""
        return not self.why and not self.differences


def arm_trial(
    robot: str,
    noise: str | NoiseProfile,
    seed: int,
    mode: Mode = "joint",
    network: str = "lan",
    plan: Plan | None = None,
) -> ArmTrial:
    """Run, identify and score one robot, in virtual time and without dynamics.

    Args:
        robot: a shipped robot or a robot file.
        noise: its profile; the IMUs count as calibrated where it has no errors of scale and misalignment.
        seed: of the modules, their noise, the network, and the site.
        mode: one joint after the other, or all at once.
        network: a network profile or file.
        plan: motions; those of the mode when None.
    """
    profile = noise if isinstance(noise, NoiseProfile) else noise_profile(noise)
    described = at_random_site(as_built(load_robot(robot), seed, profile), seed)
    settings = VirtualSettings(described, named_network(network), seed, profile)
    begun = ArmTrial(network, mode, seed, len(described.modules), "")
    clocks: dict[str, ModuleClock] = {}
    motions: list[Motion] = []

    def keep_truth(simulated: VirtualRobot) -> None:
        clocks.update(zip(simulated.serials, simulated.world.sensors.clocks, strict=True))
        motions.append(simulated.truth.motion())

    try:
        recording = record_session(settings, plan or arm_plan(mode, imu_kind(profile)), keep_truth)
        start_s = time.process_time()
        kinematics = identify_kinematics(recording)
        begun = begun._replace(identify_s=time.process_time() - start_s)
    except RobotError as error:
        return begun._replace(why=str(error))
    truth, types = true_chain(described), [module.type for module in described.modules]
    bounds = chain_bounds(sensing_chain(described), types, motions[0], profile, IMU_PRIORS[recording.imu])
    return _scored(begun, truth, recording, kinematics, clocks, bounds)


def arm_plan(mode: Mode, imu: ImuKind, motions: Motions | None = None) -> Plan:
    """Return the plan of a trial: kinematics only; `motions` other than a run's by default."""
    plan = Plan(mode=mode, imu=imu, dynamics=False)
    return plan if motions is None else plan.model_copy(update={"motions": motions})


def _scored(
    begun: ArmTrial,
    truth: Chain,
    recording: Recording,
    kinematics: Kinematics,
    clocks: Mapping[str, ModuleClock],
    bounds: Bounds | None,
) -> ArmTrial:
    fit, first = kinematics.fit, thesis_chain(recording, kinematics.topology)
    differences = topology_differences(fit.chain, truth)
    time_s = float(np.ptp([event.t_ns for event in recording.journal])) * 1e-9
    if bounds is not None:
        bayesian, strict = bounds
        begun = begun._replace(
            tip_bound=TipErrors(*tip_spread(truth, *bayesian)),
            strict_tip_bound=TipErrors(*tip_spread(truth, *strict))
            if strict.null_basis.shape[1] == bayesian.null_basis.shape[1]
            else None,
        )
    return begun._replace(
        differences=tuple(differences),
        links=_links(truth, kinematics, None if first is None else first.chain, bounds),
        tip=None if differences else _tip(fit.chain, truth, fit.null_basis),
        thesis_tip=None if differences or first is None else _tip(first.chain, truth, first.null_basis),
        robot_time_s=time_s,
        clock_error_s=clock_error_s(kinematics.clocks, clocks, time_s),
        clock_sigma_s=rms([1e-9 * clock.sigma_ns for clock in kinematics.clocks.values()]),
    )


def _tip(chain: Chain, truth: Chain, null_basis: Array) -> TipErrors:
    position_mm, orientation_deg = tip_errors(chain, truth, null_basis)
    return TipErrors(1e-3 * position_mm, orientation_deg)


def clock_error_s(estimated: Mapping[str, ClockMap], true: Mapping[str, ModuleClock], end_s: float) -> float:
    """Return the root mean square, over modules and times, of differences between mapped clocks.

    The same instants of all modules are mapped, spread from the world's start to `end_s`.
    """
    instants = [round(1e9 * t) for t in np.linspace(0.0, end_s, INSTANTS)]
    mapped = np.stack(
        [
            clock.to_session(np.array([module_time(true[s], t) for t in instants], dtype=np.int64))
            for s, clock in estimated.items()
        ],
        axis=1,
    )
    # Whole nanoseconds of years do not fit a float: differences first.
    relative = (mapped - mapped[:, :1]).astype(np.float64)
    return float(np.sqrt(np.mean(np.square(1e-9 * (relative - relative.mean(axis=1, keepdims=True))))))


def _links(
    truth: Chain, kinematics: Kinematics, thesis: Chain | None, bounds: Bounds | None
) -> tuple[ArmLink, ...]:
    fit = kinematics.fit
    least_m = None if bounds is None else link_lengths(truth, bounds.bayesian.covariance)[1]
    links = []
    for child, parent in enumerate(truth.parent):
        if parent < 0:
            continue
        ours, sigma_m, bound_m = link_errors(fit.chain, truth, child), None, None
        # A link that was not identified is not in our chain either.
        if ours is not None:
            own = fit.chain.serials.index(truth.serials[child])
            sigma_m = float(fit.link_length_sigma_m[own])
            bound_m = None if least_m is None else float(least_m[child])
        theirs = None if thesis is None else link_errors(thesis, truth, child)
        links.append(ArmLink(ours, theirs, sigma_m, bound_m))
    return tuple(links)


ARMS = ("a2085_04", "a2085_06", "arm7")
WHOLE_ARM = COST_ARM = "a2085_06"
PROFILES = ("x5", "x5-uncalibrated")
KNOWN: dict[ImuKind, str] = {"calibrated": "IMU scale and axes", "uncalibrated": "nothing"}
# Half as much again as the bound: 1.74 mm by the prior of the last IMU's place alone.
TIP_MM = {"x5": 2.6, "x5-uncalibrated": 4.0}
# Of motions that are shortened, one trial each: 1.94 times, what chance allows one tip in 99 of 100.
# With IMUs as delivered four seeds of `arm7` have 3.5 to 4.4 mm, rms 3.97 with a scatter of 0.37: one in a
# thousand is beyond 5.2, and two of the four exceed what the many trials of long motions have to keep to.
SHORT_TIP_MM = {"x5": 3.4, "x5-uncalibrated": 5.2}
LENGTHS, TIP = "link lengths of arms, x5", "tips of arms, x5"
# Where the IMU's own axes are only known to a degree, no axis and no tip's orientation is known better.
# A calibrated IMU is turned by 0.12 deg (one sigma) in its housing: a tip's orientation by all three angles,
# 0.21 deg; an axis by two of them, the worst of the 78 links of 13 trials by 0.51 deg in 99 of 100 cases.
TIP_ANGLE_DEG = {"x5": 0.4, "x5-uncalibrated": None}
AXIS_DEG = {"x5": 0.5, "x5-uncalibrated": None}
JOINT_TIME_S, THESIS_JOINT_TIME_S = 10.0, 18.0
WHOLE_TIME_S = 20.0
REFINEMENT_S = 5.0
# The thesis' motions, and less of everything.
SHORTENED = {
    "motions": "standard",
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
        plan = arm_plan("joint", imu_kind(noise_profile(noise)), motions)
        own = plan.model_copy(update=SHORTENED) if short else plan
        cases.append(_case(arm, noise, own, trials, seed, short))
    for noise in PROFILES:
        plan = arm_plan("simultaneous", imu_kind(noise_profile(noise)))
        cases.append(_case(WHOLE_ARM, noise, plan, trials, seed))
    return cases


def _case(arm: str, noise: str, plan: Plan, trials: int, seed: int, shortened: bool = False) -> Case:
    by_joint = plan.mode == "joint"
    cost_s = (0.5 if shortened else 1.0) * (_COST_S[arm] if by_joint else _WHOLE_COST_S)
    # The same modules in both profiles and both modes.
    work = [
        Trial(arm_trial, (arm, noise, own, plan.mode, "lan", plan), cost_s)
        for own in trial_seeds(seed, arm, trials)
    ]
    name = f"{arm}, {noise}, {'joint by joint' if by_joint else 'all joints at once'}"
    return Case(name, work, partial(_summary, arm, noise, plan.mode, shortened), noise, KNOWN[plan.imu])


def _summary(arm: str, noise: str, mode: Mode, shortened: bool, trials: Sequence[ArmTrial]) -> Summary:
    """Return the rows of an arm; a trial that failed, or has another topology, is counted as wrong."""
    done = [trial for trial in trials if not trial.why]
    rows = [wrong_row(trials), *_tip_rows(noise, shortened, trials), *_link_rows(noise, trials)]
    if mode == "simultaneous":
        spent = largest([trial.robot_time_s for trial in done])
        rows.append(Row("robot time in all, longest [s]", spent, WHOLE_TIME_S))
    else:
        each = largest([trial.robot_time_s / trial.joints for trial in done])
        # Shortened motions have no bar.
        limit = None if shortened else JOINT_TIME_S
        rows.append(Row("robot time a joint, longest [s]", each, limit, THESIS_JOINT_TIME_S))
    if mode == "joint" and arm == COST_ARM:
        took = median([trial.identify_s for trial in done]) if done else None
        rows.append(Row("refinement and all before it, median [s of a core]", took, REFINEMENT_S))
    over_bound = _over_bound(trials) if noise == "x5" and not shortened else {}
    return Summary(rows, sigmas_off(trials), over_bound, reasons(trials))


def _over_bound(trials: Sequence[ArmTrial]) -> dict[str, list[float]]:
    """Return |error| over its least standard deviation, of links and tips; nothing without pinocchio."""
    links = [link for trial in trials for link in trial.links]
    lengths = [abs(e) / link.bound_m for link in links if (e := link.error_m) is not None and link.bound_m]
    tips = [t.tip.position_m / t.tip_bound.position_m for t in trials if t.tip and t.tip_bound]
    return {LENGTHS: lengths, TIP: tips} if tips else {}


def sigmas_off(trials: Sequence[ArmTrial]) -> list[float]:
    """Return |error| / sigma of every link's length; infinite where nothing is claimed of it."""
    links = [link for trial in trials for link in trial.links]
    pairs = [(e, link.sigma_m) for link in links if (e := link.error_m) is not None and link.sigma_m]
    # Unknown is a miss: a length over infinity would be covered by any claim.
    return [abs(error_m) / sigma_m if np.isfinite(sigma_m) else np.inf for error_m, sigma_m in pairs]


def reasons(trials: Sequence[ArmTrial]) -> list[str]:
    """Return why trials count as wrong, with their seeds."""
    wrong = [trial for trial in trials if not trial.right]
    return [f"seed {trial.seed}: {trial.why or '; '.join(trial.differences)}" for trial in wrong]


def wrong_row(trials: Sequence[ArmTrial]) -> Row:
    """Return the row of trials that failed or have another topology."""
    return count("runs without the right topology", [not trial.right for trial in trials])


def _tip_rows(noise: str, shortened: bool, trials: Sequence[ArmTrial]) -> list[Row]:
    rows = []
    for figure, k, unit, factor, limit in (
        ("tip position", 0, "mm", 1e3, (SHORT_TIP_MM if shortened else TIP_MM)[noise]),
        ("tip orientation", 1, "deg", 1.0, TIP_ANGLE_DEG[noise]),
    ):
        ours, thesis, bound, strict = (
            rms([factor * tip[k] for trial in trials if (tip := getattr(trial, name)) is not None])
            for name in ("tip", "thesis_tip", "tip_bound", "strict_tip_bound")
        )
        rows += [
            Row(f"{figure}, rms [{unit}]", ours, limit, thesis, bound),
            Row(f"{figure}, rms error over the bound with priors", ratio(ours, bound), bound=1.0),
            Row(f"{figure}, rms error over the bound without priors", ratio(ours, strict), bound=1.0),
        ]
    return rows


def _link_rows(noise: str, trials: Sequence[ArmTrial]) -> list[Row]:
    links = [link for trial in trials for link in trial.links]
    ours = [link.ours for link in links if link.ours is not None]
    thesis = [link.thesis for link in links if link.thesis is not None]
    length_mm, thesis_mm = (scaled(mean_abs([link.length_m for link in own]), 1e3) for own in (ours, thesis))
    # The mean size of a Gaussian error is sqrt(2 / pi) of its standard deviation.
    bound_mm = scaled(rms([link.bound_m for link in links]), 1e3 * 0.7979)
    axis_deg, thesis_deg = (largest([link.axis_deg for link in own]) for own in (ours, thesis))
    vector_mm = scaled(mean_abs([link.vector_m for link in ours]), 1e3)
    return [
        Row("link length, mean |error| [mm]", length_mm, None, thesis_mm, bound_mm),
        Row("link vector, mean |error| [mm]", vector_mm),
        Row("axis, largest error [deg]", axis_deg, AXIS_DEG[noise], thesis_deg),
    ]

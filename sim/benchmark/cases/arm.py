"""Whole robots: links, axes and tips against the truth, with the thesis' chain on the same recordings.

The thesis' chain is assembled from the agents' circle point analyses; ours is the batch refinement over all
motions.
"""

import time
from collections.abc import Callable, Sequence
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
from module_agent.model.perturbation import apply_perturbation
from module_agent.network_emulation.profile_file import network as named_network
from sim.benchmark.case import Case, Summary, Trial, trial_seed
from sim.benchmark.row import Row, count, for_few, largest, mean_abs, rms, scaled
from sim.imperfections.noise_profile import NoiseProfile, imu_kind, noise_profile
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain
from sim.robot.variants import at_random_site
from sim.scoring.chain_score import link_errors, link_length_m, tip_errors, topology_differences
from sim.scoring.gauge_alignment import tip_error
from sim.thesis.circle_chain import thesis_chain
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session

# The rms over so many draws scatters by some 15 %, more poses would not make it less.
BOUND_DRAWS, BOUND_POSES = 24, 100


class ArmLink(NamedTuple):
    """The errors of one true link; None where the chain has no such link.

    error_m: estimate - truth of the distance from the parent's axis to the child's IMU. vector_error_m: the
    size of the error of that distance as a vector. sigma_m: as claimed for the length. bound_m: what it would
    be if the sensors' noise were all that there is. The thesis' are those of its chain, None in a mode that
    has none.
    """

    parent: str
    child: str
    true_m: float
    error_m: float | None
    sigma_m: float | None
    bound_m: float | None
    vector_error_m: float | None
    axis_error_deg: float | None
    thesis_error_m: float | None
    thesis_axis_error_deg: float | None


class TipErrors(NamedTuple):
    """Root mean squares over 1000 random poses of all leaves (see `chain_score.tip_errors`)."""

    position_m: float
    orientation_deg: float


class ArmTrial(NamedTuple):
    """The result of one trial; of one that failed only the first five fields are set.

    why: the reason for a failure, empty without one. differences: errors of the topology, described; tips are
    not compared then. tip_bound: errors expected from the sensors' noise alone (Cramer-Rao, by the curvature
    of the fit at its residual noise). identify_s: processor time from the recording to the chain.
    """

    robot: str
    mode: Mode
    seed: int
    joints: int
    why: str
    differences: tuple[str, ...] = ()
    links: tuple[ArmLink, ...] = ()
    tip: TipErrors | None = None
    thesis_tip: TipErrors | None = None
    tip_bound: TipErrors | None = None
    robot_time_s: float = 0.0
    identify_s: float = 0.0


def arm_trial(
    robot: str | Robot,
    noise: str | NoiseProfile,
    seed: int,
    mode: Mode = "joint",
    network: str = "lan",
    plan: Plan | None = None,
) -> ArmTrial:
    """Run, identify and score one robot, in virtual time and without dynamics.

    Args:
        robot: a shipped robot, a robot file, or a robot.
        noise: its profile; the IMUs count as calibrated where it has no errors of scale and misalignment.
        seed: of the modules, their noise, the network, and the site.
        mode: one joint after the other, or all at once.
        network: a network profile or file.
        plan: motions; those of the mode when None.
    """
    described = at_random_site(robot if isinstance(robot, Robot) else load_robot(robot), seed)
    profile = noise if isinstance(noise, NoiseProfile) else noise_profile(noise)
    planned = plan or arm_plan(mode, imu_kind(profile))
    settings = VirtualSettings(described, named_network(network), seed, profile)
    joints = len(described.modules)
    try:
        recording = record_session(settings, planned)
        start_s = time.process_time()
        kinematics = identify_kinematics(recording)
        spent_s = time.process_time() - start_s
    except RobotError as error:
        return ArmTrial(described.name, mode, seed, joints, str(error))
    return _scored(
        ArmTrial(described.name, mode, seed, joints, ""), described, recording, kinematics, spent_s
    )


def arm_plan(mode: Mode, imu: ImuKind, motions: Motions | None = None) -> Plan:
    """Return the plan of a trial: kinematics only; `motions` other than a run's by default."""
    plan = Plan(mode=mode, imu=imu, dynamics=False)
    return plan if motions is None else plan.model_copy(update={"motions": motions})


def _scored(
    begun: ArmTrial, robot: Robot, recording: Recording, kinematics: Kinematics, spent_s: float
) -> ArmTrial:
    truth = true_chain(robot)
    fit, first = kinematics.fit, thesis_chain(recording, kinematics.topology)
    differences = topology_differences(fit.chain, truth)
    times = [event.t_ns for event in recording.journal]
    return begun._replace(
        differences=tuple(differences),
        links=_links(truth, kinematics, None if first is None else first.chain),
        tip=None if differences else _tip(fit.chain, truth, fit.null_basis),
        thesis_tip=None if differences or first is None else _tip(first.chain, truth, first.null_basis),
        tip_bound=expected_tip(fit.chain, kinematics.refinement.noise_covariance, begun.seed),
        robot_time_s=float(np.ptp(times)) * 1e-9,
        identify_s=spent_s,
    )


def _tip(chain: Chain, truth: Chain, null_basis: Array) -> TipErrors:
    position_mm, orientation_deg = tip_errors(chain, truth, null_basis)
    return TipErrors(1e-3 * position_mm, orientation_deg)


def expected_tip(chain: Chain, covariance: Array, seed: int) -> TipErrors:
    """Return the tips' errors for a covariance (6 n, 6 n) of perturbations, by random draws."""
    rng = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(covariance)
    spread = vectors * np.sqrt(np.maximum(values, 0.0))
    q = rng.uniform(-np.pi, np.pi, (BOUND_POSES, len(chain.serials)))
    drawn = rng.standard_normal((BOUND_DRAWS, len(covariance)))
    errors = [tip_error(apply_perturbation(chain, spread @ each), chain, q) for each in drawn]
    squares = np.mean(np.square(errors), axis=0)
    return TipErrors(float(np.sqrt(squares[0])), float(np.degrees(np.sqrt(squares[1]))))


def _links(truth: Chain, kinematics: Kinematics, thesis: Chain | None) -> tuple[ArmLink, ...]:
    fit = kinematics.fit
    _, bounds = link_lengths(fit.chain, kinematics.refinement.noise_covariance)
    found = []
    for child, parent in enumerate(truth.parent):
        if parent < 0:
            continue
        ours = link_errors(fit.chain, truth, child)
        theirs = None if thesis is None else link_errors(thesis, truth, child)
        # A link that was not identified is not in our chain either.
        own = fit.chain.serials.index(truth.serials[child]) if ours is not None else None
        found.append(
            ArmLink(
                parent=truth.serials[parent],
                child=truth.serials[child],
                true_m=link_length_m(truth, child),
                error_m=None if ours is None else ours.length_m,
                sigma_m=None if own is None else float(fit.link_length_sigma_m[own]),
                bound_m=None if own is None else float(bounds[own]),
                vector_error_m=None if ours is None else ours.vector_m,
                axis_error_deg=None if ours is None else ours.axis_deg,
                thesis_error_m=None if theirs is None else theirs.length_m,
                thesis_axis_error_deg=None if theirs is None else theirs.axis_deg,
            )
        )
    return tuple(found)


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
        plan = arm_plan("joint", _imu(noise), motions)
        own = plan.model_copy(update=SHORTENED) if short else plan
        cases.append(_case(arm, noise, own, trials, seed, short))
    whole = [
        _case(WHOLE_ARM, noise, arm_plan("simultaneous", _imu(noise)), trials, seed) for noise in PROFILES
    ]
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
    """Return the rows of an arm; a trial that failed, or has another topology, is counted as wrong."""
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
    """Return the robot time; shortened motions have no bar."""
    done = [trial for trial in trials if not trial.why]
    if mode == "simultaneous":
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

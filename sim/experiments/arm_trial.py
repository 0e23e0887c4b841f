"""One identification of a whole robot in virtual time, scored beside the thesis' way on the same recording.

The thesis' chain is the one that is put together from the agents' circle point analyses; ours is what the
batch refinement makes of all motions.
"""

import time
from typing import NamedTuple

import numpy as np

from coordinator.failure import explain
from coordinator.identify import Kinematics, identify_kinematics
from coordinator.kinematics.assembly import link_lengths
from coordinator.kinematics.imu_intrinsics import ImuKind
from coordinator.kinematics.increments import apply_increment
from coordinator.plan import Mode, Motions, Plan
from coordinator.recording import Recording
from module_agent.dynamics.chain import Array, Chain
from module_agent.wire.network_file import network as named_network
from sim.chain_score import link_errors, link_length_m, tip_errors, topology_differences
from sim.experiments.thesis_chain import thesis_chain
from sim.gauge import tip_error
from sim.noise_profile import NoiseProfile, noise_profile
from sim.place import somewhere
from sim.robot_file import Robot, load_robot
from sim.robot_tree import true_chain
from sim.virtual_robot import VirtualSettings
from sim.virtual_session import record_session

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
    """What came of one trial; of one that did not come to its end only the first five fields tell.

    why: what ended it, empty if nothing did. differences: what is wrong with the topology, in words; tips are
    not compared then. tip_bound: the errors to expect from the sensors' noise alone, by the curvature of the
    fit (Cramer and Rao) at the noise that is left in it. identify_s: processor time from the recording to the
    chain.
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
        seed: of the modules, their noise, the network, and the place where the robot stands.
        mode: one joint after the other, or all at once.
        network: a network profile or file.
        plan: other motions than those of the mode.
    """
    described = somewhere(robot if isinstance(robot, Robot) else load_robot(robot), seed)
    found = noise if isinstance(noise, NoiseProfile) else noise_profile(noise)
    planned = plan or arm_plan(mode, imu_kind(found))
    settings = VirtualSettings(described, named_network(network), seed, found)
    joints = len(described.modules)
    try:
        recording = record_session(settings, planned)
        start_s = time.process_time()
        kinematics = identify_kinematics(recording)
        spent_s = time.process_time() - start_s
    except Exception as error:
        failure = explain(error)
        if failure is None:
            raise
        return ArmTrial(described.name, mode, seed, joints, failure.text)
    return _scored(
        ArmTrial(described.name, mode, seed, joints, ""), described, recording, kinematics, spent_s
    )


def arm_plan(mode: Mode, imu: ImuKind, motions: Motions | None = None) -> Plan:
    """Return the plan of a trial: kinematics only; `motions` other than a run's by default."""
    plan = Plan(mode=mode, imu=imu, dynamics=False)
    return plan if motions is None else plan.model_copy(update={"motions": motions})


def imu_kind(noise: NoiseProfile) -> ImuKind:
    """Return what is to be told of the IMUs of a profile."""
    return (
        "uncalibrated"
        if noise.accel_scale or noise.gyro_scale or noise.imu_misalignment_rad
        else "calibrated"
    )


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
    """Return the errors of the tips that a covariance (6 n, 6 n) of increments stands for, by draws."""
    rng = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(covariance)
    spread = vectors * np.sqrt(np.maximum(values, 0.0))
    q = rng.uniform(-np.pi, np.pi, (BOUND_POSES, len(chain.serials)))
    drawn = rng.standard_normal((BOUND_DRAWS, len(covariance)))
    found = [tip_error(apply_increment(chain, spread @ each), chain, q) for each in drawn]
    squares = np.mean(np.square(found), axis=0)
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
        # Without a link of ours there is no place of it in our chain either.
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

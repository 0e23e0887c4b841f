"""A small arm identified twice: one joint at a time as in the thesis, and all joints at once.

Both sessions are of the same modules in virtual time, kinematics and dynamics. Chains of the first are
compared by what they are made of: circles or regressions, of the module next to each joint or of all beyond
it, or the fit of the whole chain to all motions. Torques of both are compared on the held-out motion of the
second, in which all joints move.
"""

from typing import NamedTuple

import numpy as np

from coordinator.dynamics.torque_prediction import check_held_out, torque_error
from coordinator.excitation.plan import Plan
from coordinator.identification.identified import IdentificationError, Identified
from coordinator.identification.identify import identify
from coordinator.identification.inertia.inertia import without_terms
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.chain_observations import circle_observation, joint_observation
from coordinator.parameter_fit.instrumental_variables import InstrumentalFit
from coordinator.recording.journal import Purpose
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import dynamic_windows, joined_motions
from module_agent.model.chain import Array, Chain
from module_agent.network_emulation.profile_file import network
from module_agent.signals.filtering import JointMotion
from sim.imperfections.noise_profile import imu_kind
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.robot.variants import as_built, at_random_site
from sim.scoring.chain_score import link_errors, tip_errors
from sim.thesis.kinematics.circle_chain import Observation, chain_of_pairs
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session

_NS = 1e-9
# Below this speed a joint counts as held: its torque says nothing of its own motion.
_HELD_RAD_S = 0.02
# Shorter waits of a quick session.
_QUICK = {
    "discover_s": 0.3,
    "link_s": 0.3,
    "rest_s": 0.5,
    "settle_s": 0.3,
    "travel_speed_rad_s": 2.0,
    "dynamic_repeats": 2,
}


class ChainErrors(NamedTuple):
    """Mean size of the links' length errors, and rms error of the tip over random poses, in millimetres.

    The chains of a session are moved along the same directions, which its whole fit leaves unresolved.
    """

    length_mm: float
    tip_mm: float


class ArmSessions(NamedTuple):
    """Errors of the chains and torques of both sessions; None where a method has no chain.

    circles, regressions: chains of all observers; `own`: of the module next to each joint alone. joint,
    whole: the whole fit of joint by joint and of simultaneous motion, whose exploration took `joint_s`,
    `whole_s`. torque: relative errors on the motion of all joints, by the model of a single joint for each,
    and by the whole chain from motions of one joint at a time, and of all joints at once.
    """

    circles: ChainErrors | None
    own_circles: ChainErrors | None
    regressions: ChainErrors | None
    own_regressions: ChainErrors | None
    joint: ChainErrors
    whole: ChainErrors
    joint_s: float
    whole_s: float
    single_joint_torque: float
    joint_torque: float
    whole_torque: float


def arm_sessions(robot: str, noise: NoiseChoice, seed: int, quick: bool) -> ArmSessions:
    """Run and identify a robot both ways.

    Raises:
        IdentificationError: a session did not identify all modules, or no inertia.
        what `record_session` raises.
    """
    described = load_robot(robot)
    profile = noise.of(described)
    described = at_random_site(as_built(described, seed, profile), seed)
    settings = VirtualSettings(described, network("lan"), seed, profile)
    calibrated = {"imu": imu_kind(profile), "torque": "calibrated"} | (_QUICK if quick else {})
    by_joint = Plan.model_validate(calibrated)
    at_once = Plan.model_validate(
        calibrated
        | {"mode": "simultaneous", "excitation": "d-optimal", "excitation_motions": 3, "excitation_s": 4.0}
    )
    truth = true_chain(described)
    recordings = [record_session(settings, plan) for plan in (by_joint, at_once)]
    joint, whole = (identify(recording) for recording in recordings)
    for one in (joint, whole):
        if set(one.kinematics.topology.serials) != set(truth.serials) or one.inertia is None:
            raise IdentificationError(f"{robot}, seed {seed}: a session did not identify all modules")
    topology, basis = joint.kinematics.topology, joint.kinematics.fit.null_basis

    def pairs(observation: Observation, distal: bool) -> ChainErrors | None:
        chain = chain_of_pairs(recordings[0], topology, observation, distal)
        return None if chain is None else chain_errors(chain.chain, truth, basis)

    single, one_joint, all_joints = _torque_errors(joint, whole, recordings)
    return ArmSessions(
        circles=pairs(circle_observation, True),
        own_circles=pairs(circle_observation, False),
        regressions=pairs(joint_observation, True),
        own_regressions=pairs(joint_observation, False),
        joint=_errors(joint.kinematics.fit, truth),
        whole=_errors(whole.kinematics.fit, truth),
        joint_s=_explored_s(recordings[0]),
        whole_s=_explored_s(recordings[1]),
        single_joint_torque=single,
        joint_torque=one_joint,
        whole_torque=all_joints,
    )


def _errors(fit: ChainEstimate, truth: Chain) -> ChainErrors:
    return chain_errors(fit.chain, truth, fit.null_basis)


def chain_errors(chain: Chain, truth: Chain, basis: Array) -> ChainErrors:
    """Return the errors of a chain that is moved along the directions of a basis (6 n, k)."""
    links = [link_errors(chain, truth, child) for child, parent in enumerate(truth.parent) if parent >= 0]
    lengths_mm = [1e3 * abs(link.length_m) for link in links if link is not None]
    return ChainErrors(float(np.mean(lengths_mm)), tip_errors(chain, truth, basis)[0])


def _explored_s(recording: Recording) -> float:
    """Return how long it took from the beginning to the end of the exploration."""
    times = {event.what: event.t_ns for event in reversed(recording.journal)}
    return _NS * (times["explored"] - min(event.t_ns for event in recording.journal))


# ---------------------------------------------------------------------- torques


def _torque_errors(
    joint: Identified, whole: Identified, recordings: list[Recording]
) -> tuple[float, float, float]:
    """Return relative errors on the second session's held-out motion: see `ArmSessions`."""
    serials = joint.kinematics.topology.serials
    estimates = [_inertia(one) for one in (joint, whole)]
    fitted = _motion(recordings[0], joint, serials, "dynamic", estimates[0])
    means = fitted.tau_nm.mean(axis=0)
    # Every model predicts what is left of the torques after its own friction and offsets.
    held_out = [_motion(recordings[1], whole, serials, "held_out", one) for one in estimates]
    single = torque_error(held_out[0].tau_nm, single_joint_torques(fitted, held_out[0]), means).overall
    chain = joint.kinematics.fit.chain
    by_joint = check_held_out(chain, estimates[0].fit.phi, held_out[0], means).error.overall
    return single, by_joint, _held_out_error(whole)


def _inertia(one: Identified) -> InstrumentalFit:
    assert one.inertia is not None
    return one.inertia.instrumental


def _held_out_error(one: Identified) -> float:
    if one.held_out is None:
        raise IdentificationError("the session has no held-out motion")
    return one.held_out.error.overall


def _motion(
    recording: Recording, one: Identified, serials: tuple[str, ...], purpose: Purpose, fit: InstrumentalFit
) -> JointMotion:
    windows = dynamic_windows(recording, one.kinematics.clocks, serials, purpose)
    return joined_motions([without_terms(window, fit) for window in windows])


def single_joint_torques(fitted: JointMotion, motion: JointMotion) -> Array:
    """Return the torques (m, n) of a motion, each joint by the thesis' model of a single joint (eq. 28).

    Its parameters (inertia, and the two moments under gravity) are fitted to another motion, to samples in
    which the joint moves; all other joints are taken to stand as they stood then.
    """
    predicted = np.zeros_like(motion.tau_nm)
    for k in range(motion.tau_nm.shape[1]):
        moves = np.abs(fitted.qd_rad_s[:, k]) > _HELD_RAD_S
        rows, torque = _single_joint_rows(fitted, k)[moves], fitted.tau_nm[moves, k]
        parameters, *_ = np.linalg.lstsq(rows, torque, rcond=1e-9)
        predicted[:, k] = _single_joint_rows(motion, k) @ parameters
    return predicted


def _single_joint_rows(motion: JointMotion, k: int) -> Array:
    q_rad = motion.q_rad[:, k]
    return np.column_stack([motion.qdd_rad_s2[:, k], np.cos(q_rad), np.sin(q_rad)])

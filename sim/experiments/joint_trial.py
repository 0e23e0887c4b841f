"""One trial on the thesis' one-joint arm, and what the thesis' estimator, ours and the bound say of it."""

from math import acos, degrees, pi
from typing import NamedTuple

import numpy as np

from coordinator.plan import Plan
from module_agent.estimate.joint_prior import CALIBRATED
from sim.chain_score import link_length_m
from sim.experiments.joint_bound import bound_m, imu_knowledge
from sim.experiments.one_joint_rig import IMU, JOINT, OneJointRig, TrialRows, analyse, regress
from sim.experiments.thesis_lengths import Alignment, ThesisLength, thesis_length
from sim.noise_profile import NoiseProfile, noise_profile
from sim.place import somewhere
from sim.robot_file import load_robot
from sim.robot_tree import true_chain


class JointTrial(NamedTuple):
    """Errors of the radial distance from the joint's axis to the second IMU, all of the same recording.

    thesis_error_m, ours_error_m: estimated less true; of the thesis None where its analysis found too little
        motion.
    ours_sigma_m: as our estimator states it. bound_m: Cramer-Rao (`joint_bound`).
    axis_error_deg: between our axis and the true one, in the IMU's frame.
    robot_time_s: of the trial with all ways between its motions.
    """

    thesis_error_m: float | None
    ours_error_m: float
    ours_sigma_m: float
    bound_m: float
    axis_error_deg: float
    robot_time_s: float


def trial_plan(arm: ThesisLength, profile: NoiseProfile) -> Plan:
    """Return the thesis' motions for an arm, at the amplitude that it chose.

    An IMU that is not calibrated is calibrated by gravity, if the slow motion lets gravity change along the
    tangent of the IMU's circle: an arm about a horizontal axis then swings about where it hangs, and not
    about the horizontal, where +-0.5 rad change that pull by a tenth. It hangs at -pi/2 (thesis_*.toml).
    """
    delivered = imu_knowledge(profile) != CALIBRATED
    home_rad = -0.5 * pi if delivered and arm.alignment == "vertical" else 0.0
    return Plan(sine_amplitude_rad=arm.amplitude_rad, home_rad=home_rad)


def joint_trial(
    length_mm: int, alignment: Alignment, noise: str | NoiseProfile, seed: int, plan: Plan | None = None
) -> JointTrial:
    """Put up a rig, run one trial on it, and estimate.

    Args:
        length_mm, alignment: one of the thesis' eight arms (`thesis_lengths`).
        noise: profile, by name or as `switched` makes it.
        seed: of the rig's modules, their noise, and the place where it stands.
        plan: the motions; those of `trial_plan` when None.

    Raises:
        KeyError: the thesis had no such arm, or there is no such profile.
        ExperimentFailed: a module refused a motion, or broke it off.
        ValueError: too little motion, with what would be enough.
    """
    profile = noise_profile(noise) if isinstance(noise, str) else noise
    wanted = plan if plan is not None else trial_plan(thesis_length(alignment, length_mm), profile)
    robot = somewhere(load_robot(f"thesis_{length_mm}_{alignment}"), seed)
    with OneJointRig(robot, seed, profile) as rig:
        rows = rig.trial(wanted)
        return judge(rig, rows, profile)


def judge(rig: OneJointRig, rows: TrialRows, profile: NoiseProfile) -> JointTrial:
    """Estimate from a trial on a rig, and compare with the rig's truth.

    Raises:
        ValueError: too little motion, with what would be enough.
    """
    chain = true_chain(rig.robot)
    true_m = link_length_m(chain, child=IMU)
    true_axis = chain.imu_home[IMU, :3, :3].T @ chain.axis[JOINT]
    ours = regress(rows, imu_knowledge(profile))
    cosine = float(np.clip(ours.axis @ true_axis, -1.0, 1.0))
    return JointTrial(
        thesis_error_m=_thesis_error_m(rows, true_m),
        ours_error_m=ours.distance_m - true_m,
        ours_sigma_m=ours.sigma_distance_m,
        bound_m=bound_m(rows, profile),
        axis_error_deg=degrees(acos(cosine)),
        robot_time_s=1e-9 * rig.world.t_ns,
    )


def _thesis_error_m(rows: TrialRows, true_m: float) -> float | None:
    try:
        return analyse(rows).distance_m - true_m
    except ValueError:
        return None

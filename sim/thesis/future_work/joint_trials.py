"""One trial on an arm of the thesis: its alignment as the IMU sees it, and its length if the base moves."""

from math import acos, degrees
from typing import NamedTuple

import numpy as np

from coordinator.excitation.plan import Plan
from module_agent.estimate.circle_point_analysis import rest_reading
from module_agent.estimate.joint_regression import regress_joint
from module_agent.estimate.observed_motion import observed_motions
from module_agent.estimate.windows import imu_window
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import sensing_chain
from sim.scoring.chain_score import link_length_m
from sim.test_bench.one_joint_rig import IMU, OneJointRig, analyse, windows
from sim.thesis.kinematics.joint_trial import imu_knowledge
from sim.thesis.published import Alignment, thesis_length


class AlignedTrial(NamedTuple):
    """Errors of the length [mm]: by the thesis' method, and by ours with the base's motion and without.

    The base's motion is what the IMU of the joint's own module measures. axis_to_gravity_deg: between the
    estimated axis and gravity at rest, both by the IMU that the joint moves; 0 to 90 deg.
    """

    alignment: Alignment
    length_mm: int
    axis_to_gravity_deg: float
    thesis_mm: float
    moving_base_mm: float
    fixed_base_mm: float

    @property
    def seen(self) -> Alignment:
        """The alignment as the IMU sees it: the arm is horizontal if the axis is along gravity."""
        return "horizontal" if self.axis_to_gravity_deg < 45.0 else "vertical"


def aligned_trial(alignment: Alignment, length_mm: int, noise: NoiseChoice, seed: int) -> AlignedTrial:
    """Run one trial of the thesis' motions at its amplitude.

    Raises:
        ExperimentFailed: a module refused a motion or broke it off.
        DataError: too little motion.
        KeyError, ValueError: no such noise profile or effect, no such robot.
    """
    robot = load_robot(f"thesis_{length_mm}_{alignment}")
    profile = noise.of(robot)
    with OneJointRig(robot, seed, profile) as rig:
        rows = rig.trial(Plan(sine_amplitude_rad=thesis_length(alignment, length_mm).amplitude_rad))
        true_m = link_length_m(sensing_chain(rig.world.robot), child=IMU)
    rest, motions = rest_reading(imu_window(rows.rest)), observed_motions(windows(rows))
    with_base, without = (
        regress_joint(own, rest, imu_knowledge(profile), symmetric_load=True)
        for own in (motions, [motion._replace(base=None) for motion in motions])
    )
    up = rest.specific_force_m_s2 / np.linalg.norm(rest.specific_force_m_s2)
    along = abs(float(with_base.axis @ up))
    return AlignedTrial(
        alignment,
        length_mm,
        axis_to_gravity_deg=degrees(acos(min(1.0, along))),
        thesis_mm=1e3 * (analyse(rows).distance_m - true_m),
        moving_base_mm=1e3 * (with_base.distance_m - true_m),
        fixed_base_mm=1e3 * (without.distance_m - true_m),
    )

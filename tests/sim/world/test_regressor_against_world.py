"""The world, which knows nothing of the regressor, and the regressor agree on the torque in the springs."""

import numpy as np
import pytest

from coordinator.dynamics.torque_prediction import check_held_out
from module_agent.signals.filtering import filtered_motion
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain, true_inertia
from sim.world.truth import TruthLog
from sim.world.world import World


@pytest.mark.parametrize("name", ["thesis_484_vertical", "tree_y"])
def test_true_parameters_give_the_true_torque(name: str) -> None:
    robot = load_robot(name)
    world = World(robot, seed=1, noise="ideal")
    log = TruthLog(world, every=1)
    joints = len(world.modules)
    rng = np.random.default_rng(0)
    rate, phase = 2.0 * np.pi * rng.uniform(0.3, 0.9, joints), rng.uniform(0.0, 6.0, joints)
    start = np.array(world.plant.q_rad)
    for tick in range(2500):
        target = start + 0.4 * (np.sin(rate * tick / 1000.0 + phase) - np.sin(phase))
        log.exchange(list(np.clip(3.0 * (target - world.plant.q_rad), -1.0, 1.0)))
    world.close()
    motion = log.motion()
    filtered = filtered_motion(
        motion.t_ns, motion.q_rad, motion.qd_rad_s, motion.spring_torque_nm, 1000.0, 30.0
    )
    error = check_held_out(true_chain(robot), true_inertia(robot), filtered, np.zeros(joints)).error
    # What is left is the world's integration step of 1 ms (measured: 1e-4 to 4e-4).
    assert error.overall < 2e-3
    assert error.per_joint.max() < 2e-3

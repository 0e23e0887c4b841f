"""Is the robot on the network the one that is known, and does it stand as it stood?"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coordinator.torque_control.gravity_model import GravityModel
from coordinator.torque_control.preconditions import RobotMismatch, check_gravity, find_robot
from module_agent.model.chain import Chain
from module_agent.model.forward_kinematics import imu_poses
from sim.benchmark.cases.gravity_compensation import true_weight
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain

ARM = "thesis_171_horizontal"


def rest(
    chain: Chain, q: np.ndarray, tilt_rad: float = 0.0, lost_zero_rad: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and IMU readings at rest: the base tilted about x, the last joint with another zero."""
    turned = Rotation.from_rotvec([tilt_rad, 0.0, 0.0]).as_matrix() @ chain.gravity
    poses = imu_poses(chain, q[None])[0]
    reported = q.copy()
    reported[-1] += lost_zero_rad
    return reported, np.swapaxes(poses[:, :3, :3], 1, 2) @ turned


def test_a_robot_that_stands_as_it_stood_is_known_by_where_its_imus_feel_gravity() -> None:
    chain = true_chain(load_robot("arm6"))
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = rng.uniform(-3.0, 3.0, 6)
        check_gravity(chain, *rest(chain, q))
        # Errors of IMUs as delivered: 3 % of scale, 0.3 m/s^2 of offset.
        _, accel = rest(chain, q)
        check_gravity(chain, q, 1.03 * accel + rng.normal(0.0, 0.3, (6, 3)))


@pytest.mark.parametrize("change", [{"tilt_rad": 0.35}, {"tilt_rad": -np.pi}])
def test_a_base_that_stands_otherwise_is_noticed_and_the_module_is_named(change: dict[str, float]) -> None:
    chain = true_chain(load_robot("arm6"))
    with pytest.raises(RobotMismatch, match=r"the IMU of module A-\d measures gravity \d+ deg from"):
        check_gravity(chain, *rest(chain, np.full(6, 0.2), **change))


def test_a_joint_that_has_lost_its_zero_is_noticed_where_its_imu_turns_with_it() -> None:
    chain = true_chain(load_robot("arm6"))
    q = np.array([0.0, 0.3, -0.4, 0.2, 0.0, 0.0])
    wrong, accel = rest(chain, q)
    wrong[1] += 0.5
    with pytest.raises(RobotMismatch, match="measures gravity 29 deg"):
        check_gravity(chain, wrong, accel)


# --------------------------------------------------------------------------- on a network


def known(**changes: object) -> GravityModel:
    return true_weight(load_robot(ARM))._replace(**changes)


def test_the_known_robot_is_found_and_met(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM, "lan")
    messenger, recording, group = rig.group()
    rig.run(find_robot(group, messenger, known(), lambda: rig.loop.now_ns))
    assert group.serials == ("X-00009", "X-00010")
    assert all(recording.modules[serial].feedback_ns is not None for serial in group.serials)


def test_a_module_that_is_missing_of_another_type_or_no_part_of_it_is_named(
    rigs: Callable[..., Any],
) -> None:
    rig = rigs(ARM, "lan")
    messenger, _, group = rig.group()
    whole = known()
    rename = whole.chain._replace(serials=("X-00009", "gone"))
    less = whole.chain._replace(serials=("X-00009",))
    for model, words in (
        (known(chain=rename), r"module gone is missing \(1 of 2 are\); present: X-00009, X-00010"),
        (known(chain=less), "module X-00010 is not in the model, which has X-00009"),
        (known(types=("X5-9", "X5-1")), "module X-00009 is of type X5-"),
    ):
        with pytest.raises(RobotMismatch, match=words):
            rig.run(find_robot(group, messenger, model, lambda: rig.loop.now_ns))

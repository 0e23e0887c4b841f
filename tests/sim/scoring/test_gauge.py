"""Only the listed directions are removed before chains are compared, and those wholly."""

import numpy as np
import pytest
from numpy.random import Generator, default_rng

from module_agent.model.chain import Array, Chain
from module_agent.model.forward_kinematics import imu_poses
from module_agent.model.perturbation import apply_perturbation
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.scoring.gauge_alignment import align_gauge, move_root, reorder, reorder_basis, tip_error


@pytest.fixture
def chain() -> Chain:
    return true_chain(load_robot("tree_y"))


def poses(rng: Generator, chain: Chain) -> Array:
    return rng.uniform(-np.pi, np.pi, (50, len(chain.serials)))


def beyond(chain: Chain, joint: int, twist: Array) -> Array:
    """Increment that moves every module mounted beyond a joint by one twist."""
    found = np.zeros((len(chain.serials), 6))
    found[list(chain.descendants(joint)[1:])] = twist
    return found.ravel()


def yaw_and_height(chain: Chain) -> Array:
    """What a root joint with a vertical axis never shows: where along and about it the rest stands."""
    axis, point = chain.axis[0], chain.point[0]
    turn = beyond(chain, 0, np.concatenate([axis, np.cross(point, axis)]))
    shift = beyond(chain, 0, np.concatenate([np.zeros(3), axis]))
    basis, _ = np.linalg.qr(np.column_stack([turn, shift]))
    return basis


def test_the_leaves_are_the_modules_that_carry_nothing(chain: Chain) -> None:
    assert [chain.serials[i] for i in chain.leaves] == ["left-3", "right-2"]


@pytest.mark.parametrize("yaw_rad", [0.01, 1.0, -2.5, 3.1, np.pi])
def test_a_chain_that_is_off_in_the_listed_directions_alone_is_the_truth(
    chain: Chain, yaw_rad: float
) -> None:
    axis, point = chain.axis[0], chain.point[0]
    twist = yaw_rad * np.concatenate([axis, np.cross(point, axis)]) + 0.2 * np.concatenate(
        [np.zeros(3), axis]
    )
    off = apply_perturbation(chain, beyond(chain, 0, twist))
    q = poses(default_rng(0), chain)
    assert tip_error(off, chain, q).position_m > 0.01 * abs(yaw_rad)
    error = tip_error(align_gauge(off, chain, yaw_and_height(chain), q), chain, q)
    assert error.position_m < 1e-9
    assert error.orientation_rad < 1e-9


def test_an_error_in_any_other_direction_stays(chain: Chain) -> None:
    q = poses(default_rng(0), chain)
    sideways = np.cross(chain.axis[0], [1.0, 0.0, 0.0])
    off = apply_perturbation(chain, beyond(chain, 0, 0.01 * np.concatenate([np.zeros(3), sideways])))
    before = tip_error(off, chain, q)
    after = tip_error(align_gauge(off, chain, yaw_and_height(chain), q), chain, q)
    assert after.position_m == pytest.approx(before.position_m, rel=0.05)
    assert align_gauge(off, chain, np.zeros((6 * len(chain.serials), 0)), q) is off


def test_a_shift_of_one_leaf_by_a_centimetre_is_a_centimetre(chain: Chain) -> None:
    leaf = len(chain.serials) - 1
    delta = np.zeros((len(chain.serials), 6))
    delta[leaf, 3:] = [0.006, 0.0, 0.008]
    moved = apply_perturbation(chain, delta.ravel())
    error = tip_error(moved, chain, poses(default_rng(1), chain))
    # One of two leaves, its own joint does not carry its IMU: sqrt(1 / 2) of 10 mm in every pose.
    assert error.position_m == pytest.approx(0.01 / np.sqrt(2.0), rel=1e-9)
    assert error.orientation_rad == pytest.approx(0.0, abs=1e-9)


def test_another_order_is_the_same_robot(chain: Chain) -> None:
    order = ("root", "right-1", "left-1", "left-2", "right-2", "left-3")
    q = poses(default_rng(2), chain)
    columns = [chain.serials.index(serial) for serial in order]
    other = reorder(chain, order)
    np.testing.assert_allclose(imu_poses(other, q[:, columns]), imu_poses(chain, q)[:, columns], atol=1e-14)
    basis = yaw_and_height(chain)
    z = np.array([0.3, -0.1])
    moved = apply_perturbation(other, reorder_basis(chain, basis, order) @ z)
    np.testing.assert_allclose(
        moved.imu_home, apply_perturbation(chain, basis @ z).imu_home[columns], atol=1e-14
    )


def test_another_root_frame_is_the_same_robot(chain: Chain) -> None:
    pose = imu_poses(chain, np.full((1, len(chain.serials)), 0.7))[0, 3]
    basis = yaw_and_height(chain)
    moved, moved_basis = move_root(chain, basis, pose)
    q = poses(default_rng(3), chain)
    np.testing.assert_allclose(imu_poses(moved, q), pose @ imu_poses(chain, q), atol=1e-12)
    z = np.array([0.4, 0.1])
    np.testing.assert_allclose(
        apply_perturbation(moved, moved_basis @ z).imu_home,
        pose @ apply_perturbation(chain, basis @ z).imu_home,
        atol=1e-12,
    )

"""Increments must move housing, IMU and axis together, and by what they say."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from module_agent.model.forward_kinematics import imu_poses
from module_agent.model.perturbation import adjoint, apply_perturbation, skew


def test_an_increment_is_the_exponential_of_its_twist_from_the_left(robots: Any) -> None:
    chain, _ = robots.random(0, joints=3)
    delta = np.random.default_rng(0).normal(size=18)
    moved = apply_perturbation(chain, delta)
    for k in range(3):
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = skew(delta[6 * k : 6 * k + 3]), delta[6 * k + 3 : 6 * k + 6]
        np.testing.assert_allclose(moved.imu_home[k], expm(twist) @ chain.imu_home[k], atol=1e-12)


def test_axes_stay_where_they_are_in_the_imus_own_frames(robots: Any) -> None:
    chain, _ = robots.random(1, joints=4)
    moved = apply_perturbation(chain, np.random.default_rng(1).normal(size=24))
    for before, after, vector in ((chain, moved, "axis"), (chain, moved, "point")):
        local = []
        for c in (before, after):
            inverse = np.linalg.inv(c.imu_home)
            shift = inverse[:, :3, 3] if vector == "point" else 0.0
            local.append(np.einsum("nij,nj->ni", inverse[:, :3, :3], getattr(c, vector)) + shift)
        np.testing.assert_allclose(local[0], local[1], atol=1e-12)


def test_the_same_twist_for_all_modules_is_another_view_of_the_same_robot(robots: Any) -> None:
    chain, _ = robots.random(2, joints=5)
    twist = np.array([0.3, -0.5, 0.2, 0.1, 0.4, -0.2])
    moved = apply_perturbation(chain, np.tile(twist, 5))
    q = np.random.default_rng(2).uniform(-1, 1, (3, 5))
    carry = moved.imu_home[0] @ np.linalg.inv(chain.imu_home[0])
    np.testing.assert_allclose(imu_poses(moved, q), carry @ imu_poses(chain, q), atol=1e-12)


def test_the_adjoint_carries_twists_between_frames() -> None:
    rng = np.random.default_rng(3)
    pose = expm(np.array([[0, -0.3, 0.2, 1.0], [0.3, 0, -0.5, 2.0], [-0.2, 0.5, 0, 3.0], [0, 0, 0, 0]]))
    twist = rng.normal(size=6)

    def hat(v: np.ndarray) -> np.ndarray:
        found = np.zeros((4, 4))
        found[:3, :3], found[:3, 3] = skew(v[:3]), v[3:]
        return found

    np.testing.assert_allclose(
        hat(adjoint(pose) @ twist), pose @ hat(twist) @ np.linalg.inv(pose), atol=1e-12
    )


def test_an_increment_of_the_wrong_length_is_refused(robots: Any) -> None:
    with pytest.raises(ValueError, match=r"\(12,\)"):
        apply_perturbation(robots.random(0, joints=2)[0], np.zeros(6))

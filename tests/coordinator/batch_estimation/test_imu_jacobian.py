"""The derivatives of IMU readings agree with differences of the readings on random trees."""

from typing import Any

import numpy as np
import pytest

from coordinator.batch_estimation.estimator import with_placement
from coordinator.batch_estimation.imu_jacobian import imu_jacobian, kernel_motion
from coordinator.batch_estimation.imu_prediction import body_motions, imu_readings
from module_agent.model.chain import Array, Chain
from module_agent.model.perturbation import apply_perturbation

STEP = 1e-5


def _motion(joints: int, seed: int) -> tuple[Array, Array, Array]:
    q, qd, qdd = np.random.default_rng(seed).uniform(-2, 2, (3, 7, joints))
    return q, qd, 3 * qdd


def _read(chain: Chain, motion: tuple[Array, Array, Array]) -> Array:
    """Readings (m, n, 6) of gyro and accelerometer."""
    found = imu_readings(chain, *motion)
    return np.concatenate([found.gyro_rad_s, found.accel_m_s2], axis=2)


def _analytic(chain: Chain, motion: tuple[Array, Array, Array]) -> Array:
    """Slopes (6 n + 3, m, n, 6) by all perturbations and gravity, zero for modules that do not matter."""
    joints, samples = len(chain.serials), len(motion[0])
    found = np.zeros((6 * joints + 3, samples, joints, 6))
    bodies = body_motions(chain, *motion)
    for k in range(joints):
        slopes = imu_jacobian(chain, kernel_motion(bodies, *motion[:2]), len(motion[0]), k)
        rows = np.concatenate([6 * module + np.arange(6) for module in slopes.modules])
        found[rows, :, k] = np.swapaxes(slopes.poses, 1, 2)
        found[-3:, :, k] = np.swapaxes(slopes.gravity, 1, 2)
    return found


def _differences(chain: Chain, motion: tuple[Array, Array, Array]) -> Array:
    """The same by central differences."""
    found = []
    for unit in STEP * np.eye(6 * len(chain.serials) + 3):
        ahead, behind = (
            _read(
                apply_perturbation(chain, sign * unit[:-3])._replace(
                    gravity=chain.gravity + sign * unit[-3:]
                ),
                motion,
            )
            for sign in (1.0, -1.0)
        )
        found.append((ahead - behind) / (2 * STEP))
    return np.array(found)


@pytest.mark.parametrize("seed", range(8))
def test_slopes_are_the_differences_of_the_readings(robots: Any, seed: int) -> None:
    chain, _ = robots.random(seed, joints=2 + seed % 5, roots=1 + seed // 6)
    motion = _motion(len(chain.serials), seed)
    found, expected = _analytic(chain, motion), _differences(chain, motion)
    # Readings of up to 200 m/s^2: rounding leaves 200 * 1e-16 / 1e-5 = 2e-9, the third derivative 2e-8.
    np.testing.assert_allclose(found, expected, atol=2e-7)


@pytest.mark.parametrize("seed", range(4))
def test_slopes_by_the_placement_of_an_imu_are_the_differences_of_its_readings(
    robots: Any, seed: int
) -> None:
    chain, _ = robots.random(seed, joints=3)
    motion = _motion(3, seed)
    bodies = body_motions(chain, *motion)
    for k, unit in np.ndindex(3, 6):
        step = np.zeros((3, 6))
        step[k, unit] = STEP
        ahead, behind = (_read(with_placement(chain, sign * step), motion) for sign in (1.0, -1.0))
        expected = (ahead - behind)[:, k] / (2 * STEP)
        found = imu_jacobian(chain, kernel_motion(bodies, *motion[:2]), len(motion[0]), k).placement[unit].T
        np.testing.assert_allclose(found, expected, atol=2e-7)


def test_the_random_trees_hold_branches_and_both_mountings(robots: Any) -> None:
    chains = [robots.random(seed, joints=2 + seed % 5, roots=1 + seed // 6)[0] for seed in range(8)]
    assert {mounted for chain in chains for mounted in chain.reversed} == {True, False}
    parents = [[p for p in chain.parent if p >= 0] for chain in chains]
    assert any(len(set(p)) < len(p) for p in parents)
    assert any(chain.parent.count(-1) > 1 for chain in chains)


def test_an_imu_feels_the_joints_below_it_and_its_own_module_only(robots: Any) -> None:
    chain, _ = robots.random(3, joints=6)
    motion = _motion(6, 3)
    bodies = body_motions(chain, *motion)
    for k in range(6):
        moved_by, joint = {k}, chain.parent[k]
        while joint >= 0:
            moved_by.add(joint)
            joint = chain.parent[joint]
        assert (
            set(imu_jacobian(chain, kernel_motion(bodies, *motion[:2]), len(motion[0]), k).modules)
            == moved_by
        )


@pytest.mark.parametrize("seed", range(4))
def test_moving_the_whole_robot_as_one_changes_readings_as_turning_gravity_back_does(
    robots: Any, seed: int
) -> None:
    chain, _ = robots.random(seed, joints=5)
    found = _analytic(chain, _motion(5, seed))
    merged = found[:-3].reshape(5, 6, *found.shape[1:]).sum(axis=0)
    # Shifted, everything reads as before; turned by theta it reads as if gravity had turned by -theta.
    np.testing.assert_allclose(merged[3:], 0.0, atol=1e-11)
    back = -np.cross(np.eye(3), chain.gravity)
    np.testing.assert_allclose(merged[:3], np.einsum("ij,j...->i...", back, found[-3:]), atol=1e-11)

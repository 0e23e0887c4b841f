"""A robot moved along its gauge freedoms is brought back to the reference."""

from typing import Any

import numpy as np
import pytest

from coordinator.batch_estimation.imu_prediction import body_motions, readings_on
from coordinator.kinematics.chain_estimate import ChainEstimate
from coordinator.kinematics.gauge_fixing import carried, gauge_fixed, gauge_freedoms, moved, nearest
from coordinator.kinematics.null_space import Unresolved, name_null_space
from module_agent.model.chain import Chain
from module_agent.model.perturbation import apply_perturbation


def hidden(chain: Chain) -> tuple[Unresolved, ...]:
    """What a fixed base with a vertical first axis leaves open: height and heading of every branch on it."""
    columns = []
    for child in [k for k, parent in enumerate(chain.parent) if parent == 0]:
        for twist in (
            np.r_[np.zeros(3), chain.axis[0]],
            np.r_[chain.axis[0], np.cross(chain.point[0], chain.axis[0])],
        ):
            column = np.zeros((len(chain.serials), 6))
            column[list(chain.descendants(child))] = twist
            columns.append(column.ravel())
    basis, _ = np.linalg.qr(np.array(columns).T)
    found = name_null_space(chain, basis)
    assert len(found) == len(columns)
    return found


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_that_has_drifted_by_what_cannot_be_known_comes_back(robots: Any, seed: int) -> None:
    chain, _ = robots.random(seed, joints=5)
    free = gauge_freedoms(chain, hidden(chain))
    rng = np.random.default_rng(seed)
    # Up to half a turn, and half a metre.
    away = moved(
        chain, free, rng.uniform(-0.5, 0.5, len(free)) * [np.pi if "rot" in f.kind else 1 for f in free]
    )
    back = moved(away, free, nearest(away, free, range(5), chain.imu_home))
    np.testing.assert_allclose(back.imu_home, chain.imu_home, atol=1e-6)
    np.testing.assert_allclose(back.point, chain.point, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_turn_about_the_first_axis_changes_no_reading_beyond_it(robots: Any, seed: int) -> None:
    """Whatever the angle between that axis and gravity is."""
    chain, _ = robots.random(seed, joints=4, serial=True)
    chain = chain._replace(reversed=(False, *chain.reversed[1:]))
    free = [one for one in gauge_freedoms(chain, hidden(chain)) if one.kind == "rotation_about_axis"]
    chain = chain._replace(gravity=chain.gravity + np.array([0.3, -0.2, 0.1]))
    turned = moved(chain, free, np.array([2.0]))
    motion = np.random.default_rng(seed).normal(size=(3, 20, 4))
    before, after = (readings_on(one, body_motions(one, *motion)) for one in (chain, turned))
    np.testing.assert_allclose(after.gyro_rad_s[:, 1:], before.gyro_rad_s[:, 1:], atol=1e-10)
    np.testing.assert_allclose(after.accel_m_s2[:, 1:], before.accel_m_s2[:, 1:], atol=1e-10)
    # What is on the base tells.
    assert np.abs(after.accel_m_s2[:, 0] - before.accel_m_s2[:, 0]).max() > 0.1


def test_without_anything_unknown_nothing_moves(robots: Any) -> None:
    chain, _ = robots.random(2, joints=4)
    other, _ = robots.random(3, joints=4)
    assert nearest(chain, (), range(4), other.imu_home).size == 0
    np.testing.assert_array_equal(moved(chain, (), np.zeros(0)).imu_home, chain.imu_home)


def test_a_change_of_the_robot_is_the_same_change_after_it_was_brought_back(robots: Any) -> None:
    chain, _ = robots.random(4, joints=4, serial=True)
    free = gauge_freedoms(chain, hidden(chain))
    amounts = np.array([0.3, -1.1])
    delta = np.random.default_rng(1).normal(size=24) * 1e-6
    delta[:6] = 0.0
    after = moved(chain, free, amounts)
    changed = apply_perturbation(after, carried(chain, after, delta[:, None])[:, 0].copy())
    expected = moved(apply_perturbation(chain, delta), free, amounts)
    # Of first order: the axis that the branch was turned about is the root's, which does not change.
    np.testing.assert_allclose(changed.imu_home, expected.imu_home, atol=1e-10)


def test_motions_of_another_tree_than_the_chains_are_left_out(robots: Any) -> None:
    chain, _ = robots.random(4, joints=4, serial=True)
    items = hidden(chain)
    turned = chain._replace(serials=chain.serials[::-1])
    assert gauge_freedoms(turned, items) == ()
    combination = items[0]._replace(kind="combination", joint="")
    assert gauge_freedoms(chain, [combination]) == ()


def test_a_fit_that_drifted_is_fixed_with_its_covariance_and_null_space(robots: Any) -> None:
    chain, _ = robots.random(6, joints=5)
    items = hidden(chain)
    free = gauge_freedoms(chain, items)
    basis, _ = np.linalg.qr(np.concatenate([item.directions for item in items], axis=1))
    root = np.random.default_rng(2).normal(size=(30, 30)) * 1e-4
    root[:6] = 0.0
    known = root - basis @ (basis.T @ root)
    away = moved(chain, free, np.full(len(free), 0.4))
    drifted_basis, _ = np.linalg.qr(carried(chain, away, basis))
    drifted = carried(chain, away, carried(chain, away, known @ known.T).T)
    back = gauge_fixed(ChainEstimate(away, drifted, drifted_basis, 25, 1.0), chain)
    np.testing.assert_allclose(back.chain.imu_home, chain.imu_home, atol=1e-6)
    np.testing.assert_allclose(back.covariance, known @ known.T, atol=1e-12)
    # The same space, whatever vectors span it.
    np.testing.assert_allclose(back.null_basis @ back.null_basis.T, basis @ basis.T, atol=1e-6)

"""What is claimed of a link's length: no number where nothing that was observed tells it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from coordinator.kinematics.assembly import assemble
from coordinator.kinematics.chain_estimate import ChainEstimate, link_lengths
from module_agent.model.chain import Array
from module_agent.model.perturbation import apply_perturbation


def estimate(robots: Any, seed: int) -> ChainEstimate:
    chain, types = robots.random(seed, joints=4, serial=True)
    positions = robots.positions(chain, seed)
    pairs, rests = robots.observe(chain, positions), [robots.rest(chain, positions[0])]
    found: ChainEstimate = assemble(robots.topology(chain), types, pairs, rests).estimate
    return found


@pytest.mark.parametrize("seed", range(4))
def test_a_length_is_known_along_every_gauge_freedom_of_a_robot_that_moved(robots: Any, seed: int) -> None:
    found = estimate(robots, seed)
    assert found.null_basis.shape[1] > 0
    assert np.isfinite(found.link_length_sigma_m[1:]).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_length_has_no_sigma_exactly_if_an_unresolved_direction_changes_it(robots: Any, seed: int) -> None:
    found = estimate(robots, seed)
    rng = np.random.default_rng(seed)
    direction = np.zeros((4, 6))
    # One module is displaced, so that the links at both its ends change, and those of the others do not.
    direction[2] = rng.normal(size=6)
    direction /= np.linalg.norm(direction)
    hidden = replace(found, null_basis=direction.reshape(-1, 1))
    moved = apply_perturbation(found.chain, 1e-6 * direction.ravel())
    slope = np.abs(_lengths(moved) - found.link_length_m)[1:] / 1e-6
    assert np.array_equal(slope > 0.05, [False, True, True])
    assert np.array_equal(np.isinf(hidden.link_length_sigma_m[1:]), [False, True, True])
    np.testing.assert_array_equal(hidden.link_length_m, found.link_length_m)


def test_a_heading_that_is_not_quite_about_the_joint_leaves_the_length_known(robots: Any) -> None:
    """The null space of a short motion is that about gravity, of which the axis is not known to a degree."""
    found = estimate(robots, 0)
    axis, point = found.chain.axis[1], found.chain.point[1]
    aside = np.cross(axis, found.chain.imu_home[2, :3, 3] - point)
    turned = axis + np.radians(2.0) * aside / np.linalg.norm(aside)
    twist = np.concatenate([turned, np.cross(point, turned)])
    direction = np.concatenate([np.zeros(12), twist, twist])[:, None]
    heading = replace(found, null_basis=direction / np.linalg.norm(direction))
    assert [item.kind for item in heading.unresolved] == ["rotation_about_axis"]
    moved = apply_perturbation(found.chain, 1e-6 * direction.ravel())
    assert abs(_lengths(moved)[2] - found.link_length_m[2]) / 1e-6 > 1e-3
    assert np.isfinite(heading.link_length_sigma_m[1:]).all()


def test_a_length_stays_unknown_however_many_modules_share_the_direction(robots: Any) -> None:
    """Of a direction of length one that a thousand modules share each has a thirtieth."""
    chain, _ = robots.random(0, joints=4, serial=True)
    axis, off = chain.axis[0], chain.imu_home[1, :3, 3] - chain.point[0]
    outward = off - axis * (axis @ off)
    twists = np.zeros((4, 6))
    twists[1:, 3:] = outward / np.linalg.norm(outward) / 1000.0**0.5
    sigma_m = link_lengths(chain, np.zeros((24, 24)), twists.reshape(-1, 1))[1]
    assert np.array_equal(np.isinf(sigma_m[1:]), [True, False, False])


def test_the_error_of_a_null_space_leaves_a_length_known(robots: Any) -> None:
    """With precise priors, what moves two modules as one body moves them apart by some 3e-4 of it."""
    chain, _ = robots.random(0, joints=4, serial=True)
    axis, off = chain.axis[0], chain.imu_home[1, :3, 3] - chain.point[0]
    outward = off - axis * (axis @ off)
    twists = np.tile(np.concatenate([axis, np.cross(chain.point[0], axis)]), (4, 1))
    twists /= np.linalg.norm(twists)
    twists[1:, 3:] += 3e-4 * outward / np.linalg.norm(outward)
    sigma_m = link_lengths(chain, np.zeros((24, 24)), twists.reshape(-1, 1))[1]
    assert np.isfinite(sigma_m[1:]).all()


def _lengths(chain: Any) -> Array:
    return link_lengths(chain, np.zeros((24, 24)))[0]

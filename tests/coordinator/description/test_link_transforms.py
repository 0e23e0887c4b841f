"""The six parameters of every link, their covariance, and which of them are unobservable."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from coordinator.description.link_transforms import LinkTransform, link_transforms, parameter_slope
from module_agent.model.chain import Array
from module_agent.model.perturbation import apply_perturbation
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import build_tree, true_chain

NOTHING = np.zeros((18, 0))


def _pose(values: Array) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = 1e-3 * values[:3]
    pose[:3, :3] = Rotation.from_rotvec(values[3:], degrees=True).as_matrix()
    return pose


@pytest.mark.parametrize("name", ["a2085_04", "tree_y"])
def test_the_transforms_of_a_true_chain_are_those_of_the_robots_parts(name: str) -> None:
    robot = load_robot(name)
    tree, chain = build_tree(robot), true_chain(robot)
    size = 6 * len(chain.serials)
    links = link_transforms(chain, tree.types, np.zeros((size, size)), np.zeros((size, 0)))
    assert [link.child for link in links] == [
        s for s, p in zip(chain.serials, chain.parent, strict=True) if p >= 0
    ]
    for link in links:
        k, p = chain.serials.index(link.child), chain.serials.index(link.parent)
        start = (tree.housing if tree.reversed[p] else tree.output)[p]
        end = (tree.output if tree.reversed[k] else tree.housing)[k]
        np.testing.assert_allclose(_pose(link.values), np.linalg.inv(start) @ end, atol=1e-12)
        assert (link.parent_face, link.child_face) == (
            "housing" if tree.reversed[p] else "output",
            "output" if tree.reversed[k] else "housing",
        )


# Up to 3.1: at half a turn a rotation vector and its opposite are the same rotation.
@settings(max_examples=50, deadline=None)
@given(
    direction=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    angle=st.one_of(st.floats(0.0, 3.1), st.sampled_from([0.0, 1e-9, 1e-6, 1e-3])),
    place=st.tuples(*[st.floats(-1, 1)] * 3),
)
def test_the_slope_of_the_parameters_is_that_of_finite_differences(
    direction: tuple[float, ...], angle: float, place: tuple[float, ...]
) -> None:
    pose = np.eye(4)
    turn = angle * np.array(direction) / np.linalg.norm(direction)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place

    def parameters(twist: Array) -> Array:
        moved = RigidTransform.from_exp_coords(twist).as_matrix() @ pose
        vector = Rotation.from_matrix(moved[:3, :3]).as_rotvec(degrees=True)
        return np.concatenate([1e3 * moved[:3, 3], vector])

    step = 1e-5
    slope = np.stack([(parameters(step * e) - parameters(-step * e)) / (2 * step) for e in np.eye(6)], axis=1)
    # Near half a turn the rotation vector is curved: 1e-5 rad at 0.04 rad from it.
    np.testing.assert_allclose(parameter_slope(pose), slope, rtol=1e-4, atol=2e-3)


def test_the_covariance_is_that_of_many_robots_drawn_from_the_chains(robots: Any) -> None:
    chain, types = robots.random(11, joints=3, serial=True)
    rng = np.random.default_rng(3)
    root = rng.normal(size=(18, 18)) * 1e-4
    root[:6] = 0.0
    claimed = link_transforms(chain, types, root @ root.T, NOTHING)
    drawn = [
        np.array([link.values for link in link_transforms(moved, types, np.zeros((18, 18)), NOTHING)])
        for moved in (apply_perturbation(chain, root @ rng.normal(size=18)) for _ in range(3000))
    ]
    for link, found in zip(claimed, np.swapaxes(np.array(drawn), 0, 1), strict=True):
        # 3000 draws determine a variance to 2.6 %; four of that over the 36 figures.
        scale = np.sqrt(np.outer(link.covariance.diagonal(), link.covariance.diagonal()))
        np.testing.assert_allclose(np.cov(found.T) / scale, link.covariance / scale, atol=0.11)


def _hidden(robots: Any, about: bool) -> tuple[LinkTransform, LinkTransform]:
    """Links of a forward chain in which all beyond joint 1 may move along, or about, the joint's axis."""
    chain, types = robots.random(2, joints=3, serial=True)
    chain = chain._replace(reversed=(False,) * 3)
    chain = robots.build([-1, 0, 1], [False] * 3, chain.imu_home, types, chain.gravity)
    axis, point = chain.axis[0], chain.point[0]
    twist = np.r_[axis, np.cross(point, axis)] if about else np.r_[np.zeros(3), axis]
    basis = np.concatenate([np.zeros(6), twist, twist])[:, None]
    basis /= np.linalg.norm(basis)
    near, far = link_transforms(chain, types, np.zeros((18, 18)), basis)
    return near, far


def test_an_unobservable_offset_along_the_parents_axis_is_the_unknown_z(robots: Any) -> None:
    near, far = _hidden(robots, about=False)
    assert near.unknown == (False, False, True, False, False, False)
    np.testing.assert_allclose(np.abs(near.null_directions[:, 0]), [0, 0, 1, 0, 0, 0], atol=1e-9)
    # What is beyond moves as a whole.
    assert not any(far.unknown)
    assert far.null_directions.shape == (6, 0)


def test_an_unobservable_turn_about_the_parents_axis_leaves_z_known(robots: Any) -> None:
    near, far = _hidden(robots, about=True)
    assert near.unknown[5]
    assert near.unknown[:2] == (True, True)
    assert not near.unknown[2]
    assert not any(far.unknown)


def test_a_place_that_only_a_finite_turn_changes_is_unknown_too(robots: Any) -> None:
    # The child is straight ahead in its parent's y, where a small turn about z moves it along x alone.
    chain, types = robots.random(2, joints=2, serial=True)
    root, child = robots.root_pose(types[0]), robots.root_pose(types[1])
    child[:3, 3] += types[0].output_xyz + np.array([0.0, 0.2, 0.0])
    chain = robots.build([-1, 0], [False] * 2, np.stack([root, child]), types, chain.gravity)
    axis, point = chain.axis[0], chain.point[0]
    basis = np.r_[np.zeros(6), axis, np.cross(point, axis)][:, None]
    (link,) = link_transforms(chain, types, np.zeros((12, 12)), basis)
    np.testing.assert_allclose(link.values, [0, 200, 0, 0, 0, 0], atol=1e-9)
    assert link.unknown == (True, True, False, False, False, True)


def test_what_does_not_fit_the_chain_is_refused(robots: Any) -> None:
    chain, types = robots.random(1, joints=3)
    with pytest.raises(ValueError, match="for 3 modules"):
        link_transforms(chain, types, np.zeros((18, 18)), np.zeros((12, 0)))
    with pytest.raises(ValueError, match="for 3 modules"):
        link_transforms(chain, types, np.zeros((12, 12)), NOTHING)

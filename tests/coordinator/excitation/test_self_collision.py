"""A robot that folds onto itself is detected, and one that does not is not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from coordinator.excitation.self_collision import CLEARANCE_M, clearance_m, link_axes, segment_distances
from module_agent.model.chain import Chain
from module_agent.model.forward_kinematics import body_displacements
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain

seeds = st.integers(0, 2**32 - 1)


def planar_arm(lengths: tuple[float, ...]) -> Chain:
    """Joints about parallel horizontal axes, one at the end of the other's link along x."""
    count = len(lengths)
    at = np.concatenate([[0.0], np.cumsum(lengths)])[:count]
    home = np.tile(np.eye(4), (count, 1, 1))
    home[:, 0, 3] = at
    return Chain(
        serials=tuple(f"M{k}" for k in range(count)),
        parent=tuple(range(-1, count - 1)),
        reversed=(False,) * count,
        axis=np.tile([0.0, 1.0, 0.0], (count, 1)),
        point=np.column_stack([at, np.zeros(count), np.zeros(count)]),
        imu_home=home,
        gravity=np.array([0.0, 0.0, 9.81]),
    )


@settings(max_examples=300, deadline=None)
@given(seed=seeds)
def test_the_distance_of_two_segments_is_the_least_of_all_their_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, other = rng.uniform(-1.0, 1.0, (2, 2, 3))
    # one[0] + s (one[1] - one[0]) - other[0] - t (other[1] - other[0]), with s and t from 0 to 1.
    ways = np.column_stack([one[1] - one[0], other[0] - other[1]])
    found = lsq_linear(ways, other[0] - one[0], bounds=(0.0, 1.0), method="bvls", tol=1e-14)
    assert segment_distances(one, other) == pytest.approx(np.sqrt(2.0 * found.cost), abs=1e-9)


@pytest.mark.parametrize("across", [0.0, 0.3])
def test_parallel_segments_are_as_far_apart_as_their_lines_or_their_ends(across: float) -> None:
    one = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    parallel = np.array([[0.5, across, 0.0], [2.0, across, 0.0]])
    beyond = np.array([[1.4, across, 0.0], [2.0, across, 0.0]])
    assert segment_distances(one, parallel) == pytest.approx(across, abs=1e-9)
    assert segment_distances(one, beyond) == pytest.approx(np.hypot(0.4, across), abs=1e-9)


def test_an_arm_that_folds_back_meets_its_first_link() -> None:
    chain = planar_arm((0.3, 0.3, 0.3, 0.1))
    home = np.zeros(4)
    straight, folded = np.zeros((1, 4)), np.array([[0.0, 2.0 * np.pi / 3.0, 2.0 * np.pi / 3.0, 0.0]])
    assert clearance_m(chain, straight, home)[0] > CLEARANCE_M
    # Three links of one length as a triangle: the third ends where the first begins.
    assert clearance_m(chain, folded, home)[0] < 1e-6


def test_neighbours_are_no_obstacle_to_each_other() -> None:
    chain = planar_arm((0.3, 0.3))
    q = np.column_stack([np.zeros(50), np.linspace(-3.0, 3.0, 50)])
    # Link and tip meet in the joint between them, at home as anywhere.
    assert np.isinf(clearance_m(chain, q, np.zeros(2))).all()
    axes = link_axes(chain)
    assert len(axes.body) == 2


def test_links_that_are_built_close_may_come_only_a_little_nearer() -> None:
    """A link of 6 cm between two of 30 cm: the long ones stand 6 cm apart, and fold onto each other."""
    chain, home = planar_arm((0.3, 0.06, 0.3, 0.1)), np.zeros(4)
    q = np.zeros((3, 4))
    q[1, 1], q[2, 1] = 0.5, 2.6
    found = clearance_m(chain, q, home)
    assert found[0] > CLEARANCE_M
    assert found[1] > CLEARANCE_M
    # At 2.6 rad the third link begins 0.06 sin(2.6) = 3 cm off the first; 4 cm are allowed.
    assert found[2] < CLEARANCE_M


def test_links_move_with_the_bodies_that_they_belong_to() -> None:
    chain = true_chain(load_robot("a2085_06"))
    axes = link_axes(chain)
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, len(chain.serials)))
    moved = body_displacements(chain, q)
    seen = 0
    for body, ends in zip(axes.body, axes.ends, strict=True):
        for child, parent in enumerate(chain.parent):
            if parent == body and np.linalg.norm(ends[1] - chain.imu_home[child, :3, 3]) < 0.2:
                # The far end is on the child's axis, which the body carries.
                here = moved[:, body] @ np.append(ends[1], 1.0)
                there = moved[:, child] @ np.append(ends[1], 1.0)
                np.testing.assert_allclose(here, there, atol=1e-12)
                seen += 1
    assert seen == len(chain.serials) - 1

"""The frame of a joint has its z along the axis and points to what comes next."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng

from coordinator.parameter_fit.base_parameters import joint_frames
from module_agent.model.chain import Array, Chain
from sim.robot.random_robot import random_robot
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain


def chain_of(
    parents: tuple[int, ...], axis: list[list[float]], point: list[list[float]], imu: Array
) -> Chain:
    n = len(parents)
    homes = np.tile(np.eye(4), (n, 1, 1))
    homes[:, :3, 3] = imu
    return Chain(
        serials=tuple(f"M{i}" for i in range(n)),
        parent=parents,
        reversed=(False,) * n,
        axis=np.array(axis),
        point=np.array(point),
        imu_home=homes,
        gravity=np.array([0.0, 0.0, 9.81]),
    )


X, Y, Z = np.eye(3).tolist()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 500))
def test_every_frame_is_right_handed_and_stands_on_its_axis(seed: int) -> None:
    chain = true_chain(random_robot(seed))
    frames = joint_frames(chain)
    turns = frames[:, :3, :3]
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (len(turns), 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
    np.testing.assert_allclose(turns[:, :, 2], chain.axis)
    off = np.cross(frames[:, :3, 3] - chain.point, chain.axis)
    np.testing.assert_allclose(off, 0.0, atol=1e-12)
    assert not frames.flags.writeable


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_origin_is_where_two_axes_are_nearest_and_x_points_across(seed: int) -> None:
    rng = default_rng(seed)
    axis = rng.normal(size=(2, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    if np.linalg.norm(np.cross(*axis)) < 0.2:
        return
    point = rng.uniform(-0.5, 0.5, (2, 3))
    chain = chain_of((-1, 0), axis.tolist(), point.tolist(), rng.normal(size=(2, 3)))
    frame = joint_frames(chain)[0]
    # Of many points of both axes the nearest pair, an independent search: a grid of 1 mm about the origin.
    step = np.arange(-0.05, 0.05, 1e-3)
    own = frame[:3, 3] + step[:, None] * axis[0]

    def distance(places: Array) -> Array:
        return np.asarray(np.linalg.norm(np.cross(places - point[1], axis[1]), axis=1))

    assert distance(own).argmin() == np.abs(step).argmin()
    apart = float(distance(frame[None, :3, 3])[0])
    reached = frame[:3, 3] + apart * frame[:3, 0]
    assert distance(reached[None])[0] < 1e-9 or apart < 5e-3


def test_towards_a_parallel_axis_x_is_the_way_to_it() -> None:
    chain = chain_of((-1, 0), [Z, Z], [[0.0, 0.0, 0.0], [0.0, 0.3, 0.1]], np.zeros((2, 3)))
    frame = joint_frames(chain)[0]
    np.testing.assert_allclose(frame[:3, 0], Y)
    np.testing.assert_allclose(frame[:3, 3], [0.0, 0.0, 0.1])


def test_at_the_end_of_a_branch_and_on_one_line_x_points_to_the_imu() -> None:
    imu = np.array([[0.02, 0.0, 0.1], [0.0, -0.02, 0.4]])
    frames = joint_frames(chain_of((-1, 0), [Z, Z], [[0.0, 0.0, 0.0], [0.0, 0.0, 0.3]], imu))
    np.testing.assert_allclose(frames[:, :3, 0], [X, [0.0, -1.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(frames[:, :3, 3], [[0.0, 0.0, 0.1], [0.0, 0.0, 0.4]])


def test_an_imu_on_the_axis_leaves_x_across_it() -> None:
    frame = joint_frames(chain_of((-1,), [Z], [[0.0, 0.0, 0.0]], np.array([[0.0, 0.0, 0.2]])))[0]
    np.testing.assert_allclose(frame[:3, 0] @ np.array(Z), 0.0, atol=1e-15)


def test_errors_of_an_estimate_do_not_swing_the_frames() -> None:
    chain = true_chain(load_robot("a2085_04"))
    rng = default_rng(2)
    exact = joint_frames(chain)
    for _ in range(20):
        # A quarter of a degree and half a millimetre, as one session leaves them.
        axis = chain.axis + 0.004 * rng.normal(size=chain.axis.shape)
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        point = chain.point + 5e-4 * rng.normal(size=chain.point.shape)
        found = joint_frames(chain._replace(axis=axis, point=point))
        cosine = np.sum(found[:, :3, 0] * exact[:, :3, 0], axis=1)
        # Towards an IMU 25 mm away half a millimetre is 1 degree.
        assert np.degrees(np.arccos(cosine.clip(-1.0, 1.0))).max() < 6.0

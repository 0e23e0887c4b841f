"""The Denavit-Hartenberg tables give the same poses as the chain's screws."""

from typing import Any

import numpy as np
import pytest

from coordinator.description.denavit_hartenberg import DhPath, dh_path, dh_paths
from module_agent.model.chain import Chain
from module_agent.model.forward_kinematics import body_displacements


def dh_transform(
    theta_rad: np.ndarray, d_m: float, a_m: float, alpha_rad: float, beta_rad: float = 0.0
) -> np.ndarray:
    """Eq. 2, and Hayati's turn about y, for (m,) joint angles: (m, 4, 4) poses of frame i in frame i - 1."""
    c, s, ca, sa = np.cos(theta_rad), np.sin(theta_rad), np.cos(alpha_rad), np.sin(alpha_rad)
    poses = np.zeros((len(theta_rad), 4, 4))
    poses[:, 0] = np.stack([c, -s * ca, s * sa, a_m * c], axis=1)
    poses[:, 1] = np.stack([s, c * ca, -c * sa, a_m * s], axis=1)
    poses[:, 2] = [0.0, sa, ca, d_m]
    poses[:, 3, 3] = 1.0
    cb, sb = np.cos(beta_rad), np.sin(beta_rad)
    about_y = np.array([[cb, 0.0, sb, 0.0], [0.0, 1.0, 0.0, 0.0], [-sb, 0.0, cb, 0.0], [0.0, 0.0, 0.0, 1.0]])
    return poses @ about_y


def dh_poses(path: DhPath, q: np.ndarray) -> np.ndarray:
    """The pose of the last frame in the root frame, (m, 4, 4), at positions (m, joints of the path)."""
    pose = np.broadcast_to(path.base, (len(q), 4, 4))
    for i, row in enumerate(path.rows):
        pose = pose @ dh_transform(row.theta_rad + q[:, i], *row[2:])
    return pose


def displaced(chain: Chain, path: DhPath, q: np.ndarray) -> np.ndarray:
    """How the last frame is displaced from q = 0, in the root frame: what the screws say of the last body."""
    own = q[:, [chain.serials.index(row.serial) for row in path.rows]]
    return dh_poses(path, own) @ np.linalg.inv(dh_poses(path, np.zeros_like(own[:1])))


def straight(axes: list[list[float]], points: list[list[float]]) -> Chain:
    count = len(axes)
    return Chain(
        serials=tuple(f"J{i}" for i in range(count)),
        parent=tuple(range(-1, count - 1)),
        reversed=(False,) * count,
        axis=np.array(axes) / np.linalg.norm(axes, axis=1, keepdims=True),
        point=np.array(points, dtype=float),
        imu_home=np.tile(np.eye(4), (count, 1, 1)),
        gravity=np.array([0.0, 0.0, 9.81]),
    )


@pytest.mark.parametrize("seed", range(6))
def test_the_tables_of_a_random_tree_move_every_leaf_as_its_screws_do(robots: Any, seed: int) -> None:
    chain, _ = robots.random(seed, joints=2 + seed, roots=1 + seed % 2)
    q = np.random.default_rng(seed).uniform(-3, 3, (4, 2 + seed))
    paths = dh_paths(chain)
    leaves = [k for k in range(2 + seed) if k not in chain.parent]
    assert len(paths) == len(leaves)
    for leaf, path in zip(leaves, paths, strict=True):
        assert [row.serial for row in path.rows] == [chain.serials[i] for i in chain.ancestors(leaf)]
        assert all(row.a_m >= 0 for row in path.rows)
        np.testing.assert_allclose(
            displaced(chain, path, q), body_displacements(chain, q)[:, leaf], atol=1e-9
        )


@pytest.mark.parametrize(
    ("axes", "points"),
    [
        ([[0, 0, 1], [0, 0, 1], [0, 0, 1]], [[0, 0, 0], [0.3, 0, 0.1], [0.5, 0.1, 0.3]]),  # parallel
        ([[0, 0, 1], [0, 0, -1]], [[0, 0, 0], [0.3, 0.1, 0.1]]),  # opposite
        ([[0, 0, 1], [0, 1, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0.2], [0, 0, 0.2]]),  # meeting: a wrist
        (
            [[0, 0, 1], [0, 0, 1], [0, 1, 0]],
            [[0, 0, 0], [0, 0, 0.4], [0, 0.1, 0.5]],
        ),  # one line, then meeting
        ([[1, 0, 0], [0, 1, 0]], [[0, 0, 0], [0.1, 0, 0.3]]),  # the first axis along the root's x
        ([[0, 0, 1], [1e-4, 0, 1]], [[0, 0, 0], [0.3, 0.1, 0]]),  # all but parallel
        (
            [[0, 0, 1], [0.02, 0.03, -1], [0, 1, 0]],
            [[0, 0, 0], [0.3, 0.1, 0], [0.5, 0, 0]],
        ),  # all but opposite
        (
            [[0, 0, 1], [0.05, 0, 1], [0, 0, 1]],
            [[0, 0, 0], [0, 0, 0], [0.2, 0, 0]],
        ),  # meeting, all but parallel
    ],
)
def test_parallel_meeting_and_coinciding_axes_have_tables_too(
    axes: list[list[float]], points: list[list[float]]
) -> None:
    chain = straight(axes, points)
    q = np.random.default_rng(3).uniform(-3, 3, (5, len(axes)))
    path = dh_path(chain, len(axes) - 1)
    np.testing.assert_allclose(displaced(chain, path, q), body_displacements(chain, q)[:, -1], atol=1e-9)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_noise_of_parallel_axes_leaves_their_rows_where_they_are(way: float) -> None:
    """Two milliradians put the common normal of axes 0.3 m apart more than a hundred metres away."""
    rng = np.random.default_rng(5)
    ideal = [[0, 0, 0], [0.3, 0, 0.05], [0.3, 0.2, 0.1]]
    known = dh_path(straight([[0, 0, 1], [0, 0, way], [0, 0, 1]], ideal), 2)
    for _ in range(20):
        tilted = [[*rng.normal(0.0, 2e-3, 2), up] for up in (1.0, way, 1.0)]
        noisy = dh_path(straight(tilted, ideal), 2)
        assert [row.d_m for row in noisy.rows] == [0.0, 0.0, 0.0]
        np.testing.assert_allclose(
            np.array([row[1:] for row in noisy.rows]), [row[1:] for row in known.rows], atol=2e-2
        )
        lengths = [row.a_m for row in noisy.rows]
        assert lengths == pytest.approx([row.a_m for row in known.rows], abs=2e-3)


def test_a_planar_arm_has_its_link_lengths_and_nothing_else() -> None:
    chain = straight([[0, 0, 1]] * 3, [[0, 0, 0], [0.3, 0, 0], [0.3, 0.2, 0]])
    rows = dh_path(chain, 2).rows
    assert [row.a_m for row in rows] == pytest.approx([0.3, 0.2, 0.0])
    assert [row.d_m for row in rows] == [0.0, 0.0, 0.0]
    assert [row.alpha_rad for row in rows] == pytest.approx([0.0, 0.0, 0.0])
    assert [row.theta_rad for row in rows] == pytest.approx([0.0, np.pi / 2, 0.0])


def test_offsets_of_parallel_axes_along_them_do_not_appear_as_d() -> None:
    path = dh_path(straight([[0, 0, 1]] * 2, [[0, 0, 0.1], [0.3, 0, 0.7]]), 1)
    assert path.rows[0].d_m == 0.0
    assert path.rows[0].a_m == pytest.approx(0.3)


def test_a_shoulder_has_the_twist_and_offset_of_the_text_book() -> None:
    """Joint 2 lies 0.2 m up joint 1's axis and is turned by -90 degrees about x."""
    chain = straight([[0, 0, 1], [0, 1, 0]], [[0, 0, 0], [0, 5.0, 0.2]])
    row = dh_path(chain, 0 + 1).rows[0]
    assert (row.d_m, row.a_m) == pytest.approx((0.2, 0.0))
    assert abs(row.alpha_rad) == pytest.approx(np.pi / 2)


def test_one_transform_is_the_product_of_the_four_of_equation_2() -> None:
    theta, d, a, alpha = 0.7, 0.2, 0.3, -1.1

    def about(axis: int, angle: float) -> np.ndarray:
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        found = np.eye(4)
        found[i, i] = found[j, j] = np.cos(angle)
        found[j, i], found[i, j] = np.sin(angle), -np.sin(angle)
        return found

    def along(axis: int, length: float) -> np.ndarray:
        found = np.eye(4)
        found[axis, 3] = length
        return found

    product = about(2, theta) @ along(2, d) @ along(0, a) @ about(0, alpha)
    np.testing.assert_allclose(dh_transform(np.array([theta]), d, a, alpha)[0], product, atol=1e-12)

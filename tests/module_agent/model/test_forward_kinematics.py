"""The forward model must agree with pinocchio and with what a hinge does."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from module_agent.model.chain import Chain
from module_agent.model.forward_kinematics import (
    body_displacements,
    imu_poses,
)


def random_chain(seed: int, joints: int) -> Chain:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(joints, 3))
    home = np.tile(np.eye(4), (joints, 1, 1))
    home[:, :3, :3] = Rotation.random(joints, rng=rng).as_matrix()
    home[:, :3, 3] = rng.uniform(-1, 1, (joints, 3))
    return Chain(
        serials=tuple(f"M{i}" for i in range(joints)),
        parent=tuple(int(rng.integers(-1, i)) for i in range(joints)),
        reversed=tuple(bool(r) for r in rng.random(joints) < 0.4),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        point=rng.uniform(-1, 1, (joints, 3)),
        imu_home=home,
        gravity=np.array([0.0, 0.0, 9.81]),
    )


def pinocchio_imu_poses(chain: Chain, q: np.ndarray) -> np.ndarray:
    """Joint frames axis-parallel to the root frame and through `point`; the IMUs as frames on the bodies."""
    model = pin.Model()
    ids: list[int] = []
    for i, parent in enumerate(chain.parent):
        offset = chain.point[i] - (chain.point[parent] if parent >= 0 else 0.0)
        ids.append(
            model.addJoint(
                ids[parent] if parent >= 0 else 0,
                pin.JointModelRevoluteUnaligned(chain.axis[i]),
                pin.SE3(np.eye(3), offset),
                chain.serials[i],
            )
        )
    frames = []
    for k in range(len(chain.serials)):
        body = k if chain.reversed[k] else chain.parent[k]
        origin = chain.point[body] if body >= 0 else np.zeros(3)
        home = pin.SE3(chain.imu_home[k, :3, :3], chain.imu_home[k, :3, 3] - origin)
        frames.append(
            model.addFrame(pin.Frame(f"imu{k}", ids[body] if body >= 0 else 0, home, pin.FrameType.OP_FRAME))
        )
    data = model.createData()
    found = []
    for row in q:
        pin.framesForwardKinematics(model, data, row)
        found.append([data.oMf[f].homogeneous for f in frames])
    return np.array(found)


@pytest.mark.parametrize("seed", range(8))
def test_imu_poses_of_random_trees_with_reversed_modules_agree_with_pinocchio(seed: int) -> None:
    chain = random_chain(seed, joints=1 + seed)
    q = np.random.default_rng(100 + seed).uniform(-3, 3, (5, 1 + seed))
    np.testing.assert_allclose(imu_poses(chain, q), pinocchio_imu_poses(chain, q), atol=1e-12)


def test_nothing_is_displaced_at_zero() -> None:
    chain = random_chain(3, joints=6)
    np.testing.assert_allclose(body_displacements(chain, np.zeros((1, 6)))[0], np.tile(np.eye(4), (6, 1, 1)))
    np.testing.assert_allclose(imu_poses(chain, np.zeros((1, 6)))[0], chain.imu_home)


def test_a_joint_moves_its_descendants_and_no_other_body() -> None:
    chain = random_chain(5, joints=8)
    for joint in range(8):
        q = np.zeros((1, 8))
        q[0, joint] = 0.7
        shift = np.abs(body_displacements(chain, q)[0] - np.eye(4)).max(axis=(1, 2))
        assert tuple(np.flatnonzero(shift > 1e-9)) == chain.descendants(joint)
        assert all(joint in chain.ancestors(body) for body in chain.descendants(joint))


def test_points_on_the_axis_stay_where_they_are() -> None:
    chain = random_chain(1, joints=1)
    moved = body_displacements(chain, [[1.2]])[0, 0] @ np.append(chain.point[0] + 0.4 * chain.axis[0], 1.0)
    np.testing.assert_allclose(moved[:3], chain.point[0] + 0.4 * chain.axis[0], atol=1e-12)


def test_the_imu_rides_on_its_own_body_only_when_reversed() -> None:
    chain = random_chain(2, joints=5)
    for k in range(5):
        assert chain.carrier(k) == (k if chain.reversed[k] else chain.parent[k])


def test_results_cannot_be_written_to() -> None:
    chain = random_chain(4, joints=2)
    with pytest.raises(ValueError, match="read-only"):
        imu_poses(chain, np.zeros((1, 2)))[0, 0, 0, 0] = 1.0


def test_positions_of_the_wrong_shape_are_refused_by_shape() -> None:
    with pytest.raises(ValueError, match=r"\(samples, 3\)"):
        body_displacements(random_chain(0, joints=3), np.zeros((4, 2)))

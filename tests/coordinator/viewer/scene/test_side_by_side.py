"""Trees whose places are not known are drawn apart, each as it is."""

import numpy as np

from coordinator.viewer.scene.robot_geometry import side_by_side
from module_agent.model.chain import Chain
from module_agent.model.forward_kinematics import imu_poses


def three(arm: Chain) -> Chain:
    """Three arms on one spot, on a base that is tilted."""
    arrays = {name: np.concatenate([getattr(arm, name)] * 3) for name in ("axis", "point", "imu_home")}
    return Chain(
        serials=tuple(f"{s}{n}" for n in range(3) for s in arm.serials),
        parent=(-1, 0, -1, 2, -1, 4),
        reversed=arm.reversed * 3,
        gravity=np.array([3.0, 5.0, 7.9]),
        **arrays,
    )


def test_one_tree_stays_where_it_is(arm: Chain) -> None:
    assert side_by_side(arm) is arm


def test_trees_stand_apart_on_one_level_and_are_what_they_were(arm: Chain) -> None:
    chain = three(arm)
    apart = side_by_side(chain)
    q = np.array([[0.3, -0.8] * 3])
    before, after = imu_poses(chain, q)[0], imu_poses(apart, q)[0]
    np.testing.assert_array_equal(after[:2], before[:2])
    shift = after[:, :3, 3] - before[:, :3, 3]
    np.testing.assert_allclose(shift @ chain.gravity, 0.0, atol=1e-12)
    np.testing.assert_allclose(after[:, :3, :3], before[:, :3, :3], atol=1e-12)
    for tree in (2, 4):
        np.testing.assert_allclose(shift[tree], shift[tree + 1], atol=1e-12)
    along = shift[2] / np.linalg.norm(shift[2])
    reach = [(p @ along).tolist() for p in apart.imu_home[:, :3, 3].reshape(3, 2, 3)]
    assert max(reach[0]) + 0.2 < min(reach[1])
    assert max(reach[1]) + 0.2 < min(reach[2])

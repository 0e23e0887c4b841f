"""A robot as screws and tips is the same robot as the chain, and as pinocchio's of its URDF."""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import RigidTransform

from coordinator.description.product_of_exponentials import ScrewModel, Tip, screw_axes, screw_model
from coordinator.description.urdf_writer import write_urdf
from coordinator.kinematics.frames import distal_homes, housing_homes, output_homes, proximal_homes
from module_agent.model.chain import Array, Chain
from module_agent.model.forward_kinematics import body_displacements
from module_agent.model.perturbation import apply_perturbation, skew
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import build_tree, true_chain


def _spread(chain: Chain, seed: int, size: float = 1e-4) -> Array:
    """A covariance of the increments in which nothing is known to better than any other; the root is."""
    root = np.random.default_rng(seed).normal(size=(6 * len(chain.serials),) * 2) * size
    root[:6] = 0.0
    return root @ root.T


def tip_poses(model: ScrewModel, tip: Tip, q: Array) -> Array:
    """The tip's pose (m, 4, 4) in the space frame at positions (m, n) in the order of the model."""
    pose = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for serial in tip.joints:
        joint = model.serials.index(serial)
        pose = pose @ RigidTransform.from_exp_coords(q[:, joint, None] * model.screws[joint]).as_matrix()
    return pose @ tip.home


@pytest.mark.parametrize("seed", range(8))
def test_the_tips_stand_where_the_screws_of_the_chain_put_them(robots: Any, seed: int) -> None:
    chain, types = robots.random(seed, joints=1 + seed, roots=1 + seed % 2 if seed else 1)
    model = screw_model(chain, types, _spread(chain, seed))
    q = np.random.default_rng(seed).uniform(-3, 3, (5, len(chain.serials)))
    moved, homes = body_displacements(chain, q), distal_homes(chain, types)
    assert [tip.serial for tip in model.tips] == [
        s for k, s in enumerate(chain.serials) if k not in chain.parent
    ]
    for tip in model.tips:
        k = chain.serials.index(tip.serial)
        np.testing.assert_allclose(tip_poses(model, tip, q), moved[:, k] @ homes[k], atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_pinocchio_has_the_tips_there_too(robots: Any, tmp_path: Path, seed: int) -> None:
    chain, types = robots.random(seed, joints=6)
    write_urdf(tmp_path / "robot.urdf", chain, None)
    other = pin.buildModelFromUrdf(str(tmp_path / "robot.urdf"))
    data = other.createData()
    order = [chain.serials.index(name.removeprefix("joint_")) for name in list(other.names)[1:]]
    model = screw_model(chain, types, _spread(chain, seed))

    def at(q: Array, serial: str) -> Array:
        joint = other.getFrameId(f"body_{serial}")
        own = q[order]
        pin.framesForwardKinematics(other, data, np.column_stack([np.cos(own), np.sin(own)]).ravel())
        base = data.oMf[other.getFrameId("base")].homogeneous
        return np.asarray(np.linalg.solve(base, data.oMf[joint].homogeneous))

    q = np.random.default_rng(seed).uniform(-3, 3, (3, 6))
    for tip in model.tips:
        # URDF's link frames are others than ours; how they are displaced is the same.
        home = np.linalg.solve(at(np.zeros(6), tip.serial), tip.home)
        expected = np.array([at(one, tip.serial) @ home for one in q])
        np.testing.assert_allclose(tip_poses(model, tip, q), expected, atol=1e-11)


def test_a_screw_axis_is_the_rate_at_which_its_joint_turns_the_robot(robots: Any) -> None:
    chain, _ = robots.random(3, joints=5)
    for k, (w, v) in enumerate(screw_axes(chain).reshape(-1, 2, 3)):
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = skew(w), v
        q = np.zeros((1, 5))
        q[0, k] = 0.7
        np.testing.assert_allclose(expm(0.7 * twist), body_displacements(chain, q)[0, k], atol=1e-12)


def test_the_covariances_are_those_of_many_robots_drawn_from_the_chains(robots: Any) -> None:
    chain, types = robots.random(5, joints=4)
    spread = _spread(chain, 5)
    model = screw_model(chain, types, spread)
    rng = np.random.default_rng(7)
    root = np.linalg.cholesky(spread + 1e-18 * np.eye(24))
    drawn = [apply_perturbation(chain, root @ rng.normal(size=24)) for _ in range(4000)]
    screws = np.array([screw_axes(one) for one in drawn])
    for k in range(1, 4):
        found = np.cov(screws[:, k].T)
        # 4000 draws determine a variance to 2.2 %; five of that over some 20 figures.
        np.testing.assert_allclose(found, model.covariance[k], atol=0.11 * np.abs(found).max())
    np.testing.assert_array_equal(model.covariance[0], 0.0)
    tip = model.tips[-1]
    k = chain.serials.index(tip.serial)
    places = np.array([distal_homes(one, types)[k, :3, 3] for one in drawn])
    slope = np.concatenate([-skew(tip.home[:3, 3]), np.eye(3)], axis=1)
    expected = slope @ tip.covariance @ slope.T
    np.testing.assert_allclose(np.cov(places.T), expected, atol=0.11 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["a2085_04", "tree_y", "snake16"])
def test_the_faces_are_where_the_simulated_modules_have_theirs(name: str) -> None:
    robot = load_robot(name)
    tree, chain = build_tree(robot), true_chain(robot)
    to_root = np.linalg.inv(tree.housing[0])
    np.testing.assert_allclose(housing_homes(chain, tree.types), to_root @ tree.housing, atol=1e-12)
    np.testing.assert_allclose(output_homes(chain, tree.types), to_root @ tree.output, atol=1e-12)
    # A body's frame in the simulation is always the output's; what moves it differs.
    for k, turned in enumerate(tree.reversed):
        ends = tree.output[k], tree.housing[k]
        np.testing.assert_allclose(distal_homes(chain, tree.types)[k], to_root @ ends[turned], atol=1e-12)
        mounted = proximal_homes(chain, tree.types)[k]
        np.testing.assert_allclose(mounted, to_root @ ends[not turned], atol=1e-12)


def test_what_does_not_fit_the_chain_is_refused(robots: Any) -> None:
    chain, types = robots.random(1, joints=3)
    with pytest.raises(ValueError, match="2 module types for a chain of 3"):
        screw_model(chain, types[:2], np.zeros((18, 18)))
    with pytest.raises(ValueError, match=r"\(6, 6\) for the perturbations of 3"):
        screw_model(chain, types, np.zeros((6, 6)))

"""The URDF, read by pinocchio, is the same robot as the chain."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Generator, default_rng
from scipy.spatial.transform import Rotation

from coordinator.description.urdf_writer import comment, link_homes, robot_element, write_urdf
from module_agent.model.catalogue import CATALOGUE
from module_agent.model.chain import Array, Chain
from module_agent.model.forward_kinematics import body_displacements, imu_poses
from module_agent.model.regressor import inverse_dynamics


def random_tree(rng: Generator, joints: int) -> Chain:
    axis = rng.normal(size=(joints, 3))
    # Axes along the root's own directions are the usual case and the degenerate one of Euler angles.
    axis[::2] = rng.permutation(np.vstack([np.eye(3), -np.eye(3)]))[rng.integers(0, 6, len(axis[::2]))]
    home = np.tile(np.eye(4), (joints, 1, 1))
    home[:, :3, :3] = Rotation.random(joints, rng=rng).as_matrix()
    home[:, :3, 3] = rng.uniform(-1.0, 1.0, (joints, 3))
    return Chain(
        serials=tuple(f"X5-{i}.a" for i in range(joints)),
        parent=tuple(int(rng.integers(-1, i)) for i in range(joints)),
        reversed=tuple(bool(r) for r in rng.integers(0, 2, joints)),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        point=rng.uniform(-1.0, 1.0, (joints, 3)),
        imu_home=home,
        gravity=Rotation.random(rng=rng).apply([0.0, 0.0, 9.81]),
    )


def real_bodies(rng: Generator, chain: Chain) -> Array:
    found = []
    for point in chain.point:
        masses, places = rng.uniform(0.02, 0.2, 6), point + rng.uniform(-0.2, 0.2, (6, 3))
        inertia = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, places, strict=True))
        first = masses @ places
        found.append([masses.sum(), *first, *np.asarray(inertia)[np.triu_indices(3)]])
    return np.array(found)


def load(path: Path) -> tuple[pin.Model, pin.Data]:
    model = pin.buildModelFromUrdf(str(path))
    return model, model.createData()


def columns(model: pin.Model, chain: Chain) -> list[int]:
    """The chain's joint behind each of pinocchio's velocity coordinates (it orders joints by name)."""
    return [chain.serials.index(name.removeprefix("joint_")) for name in list(model.names)[1:]]


def configuration(q: Array) -> Array:
    """Pinocchio holds a continuous joint as cosine and sine."""
    return np.column_stack([np.cos(q), np.sin(q)]).ravel()


@settings(max_examples=20, deadline=None)
@given(joints=st.integers(1, 8), seed=st.integers(0, 2**32 - 1))
def test_bodies_and_imus_stand_where_the_chain_has_them(
    tmp_path_factory: pytest.TempPathFactory, joints: int, seed: int
) -> None:
    rng = default_rng(seed)
    chain = random_tree(rng, joints)
    path = tmp_path_factory.mktemp("urdf") / "robot.urdf"
    write_urdf(path, chain, None)
    model, data = load(path)
    assert model.nv == joints
    q = rng.uniform(-3.0, 3.0, (3, joints))
    moved, imus, homes = body_displacements(chain, q), imu_poses(chain, q), link_homes(chain)
    for k in range(len(q)):
        pin.framesForwardKinematics(model, data, configuration(q[k, columns(model, chain)]))
        base = data.oMf[model.getFrameId("base")].homogeneous
        np.testing.assert_allclose(base[:3, :3] @ chain.gravity, [0, 0, 9.81], atol=1e-12)
        for i, serial in enumerate(chain.serials):
            link = data.oMf[model.getFrameId(f"body_{serial}")].homogeneous
            imu = data.oMf[model.getFrameId(f"imu_{serial}")].homogeneous
            np.testing.assert_allclose(link, base @ moved[k, i] @ homes[i], atol=1e-11)
            np.testing.assert_allclose(imu, base @ imus[k, i], atol=1e-11)
            np.testing.assert_allclose(homes[i, :3, 2], chain.axis[i], atol=1e-14)


@pytest.mark.parametrize(("joints", "seed"), [(1, 0), (4, 1), (9, 2)])
def test_with_real_bodies_the_torques_are_those_of_the_regressor(
    tmp_path: Path, joints: int, seed: int
) -> None:
    rng = default_rng(seed)
    chain = random_tree(rng, joints)
    phi = real_bodies(rng, chain)
    write_urdf(tmp_path / "robot.urdf", chain, phi)
    assert "nearest real body" not in (tmp_path / "robot.urdf").read_text()
    model, data = load(tmp_path / "robot.urdf")
    order = columns(model, chain)
    q, qd, qdd = rng.uniform(-3.0, 3.0, (3, 5, joints))
    expected = inverse_dynamics(chain, phi, q, qd, qdd)
    for k in range(5):
        tau = pin.rnea(model, data, configuration(q[k, order]), qd[k, order], qdd[k, order])
        np.testing.assert_allclose(tau, expected[k, order], atol=1e-10)


def test_what_is_no_real_body_is_replaced_and_said() -> None:
    rng = default_rng(5)
    chain = random_tree(rng, 3)
    phi = real_bodies(rng, chain)
    phi[1, 0] = -0.2
    robot = robot_element(chain, phi)
    comments = [
        link.get("name")
        for link in robot.iter("link")
        if any("nearest real body" in str(child.text) for child in link if not isinstance(child.tag, str))
    ]
    assert comments == [f"body_{chain.serials[1]}"]
    assert all(float(str(mass.get("value"))) > 0.0 for mass in robot.iter("mass"))
    assert len(list(robot.iter("mass"))) == 3


def test_without_parameters_no_inertia_is_claimed() -> None:
    assert not list(robot_element(random_tree(default_rng(6), 2), None).iter("inertial"))


def test_limits_are_those_of_the_module_types(tmp_path: Path) -> None:
    chain = random_tree(default_rng(7), 2)
    write_urdf(tmp_path / "robot.urdf", chain, None, "pair", [CATALOGUE["X5-1"], CATALOGUE["X5-9"]])
    root = ElementTree.parse(tmp_path / "robot.urdf").getroot()
    assert root.get("name") == "pair"
    assert [limit.get("effort") for limit in root.iter("limit")] == ["2.5", "13"]
    assert {joint.get("type") for joint in root.iter("joint")} == {"continuous", "fixed"}
    with pytest.raises(ValueError, match="1 module types for a chain of 2 joints"):
        write_urdf(tmp_path / "robot.urdf", chain, None, "pair", [CATALOGUE["X5-1"]])


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    chain = random_tree(default_rng(8), 2)
    write_urdf(path, chain, None)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="phi has 3 values"):
        write_urdf(path, chain, [1.0, 2.0, 3.0])
    (tmp_path / "robot.urdf.part").mkdir()
    with pytest.raises(OSError, match=r"robot\.urdf\.part"):
        write_urdf(path, chain, None, "another")
    assert path.read_bytes() == before


@pytest.mark.parametrize("serial", ["a-b", "a--b", "a---b", "a----"])
def test_a_comment_may_have_any_serial(serial: str) -> None:
    """XML allows no double hyphen in it."""
    robot = ElementTree.Element("robot")
    comment(robot, f"order: {serial}")
    assert ElementTree.fromstring(ElementTree.tostring(robot)).tag == "robot"

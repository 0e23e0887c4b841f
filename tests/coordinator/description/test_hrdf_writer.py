"""The HRDF, read by the format's rules, is the same robot as the chain."""

import ast
import operator
import re
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Generator, default_rng
from scipy.spatial.transform import Rotation

from coordinator.description.hrdf_writer import hrdf_element, joint_order, write_hrdf
from coordinator.description.urdf_writer import upright_pose
from coordinator.dynamics.inertia_prior import modules_alone
from coordinator.dynamics.pseudo_inertia import parameters
from coordinator.kinematics.frames import distal_homes
from module_agent.model.catalogue import CATALOGUE, ModuleType
from module_agent.model.chain import Array, Chain
from module_agent.model.forward_kinematics import body_displacements
from module_agent.model.regressor import inverse_dynamics
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia

# ------------------------------------------------------------------ a reader of the format

_OPERATORS: dict[type, Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
_ABOUT = {"x": 0, "y": 1, "z": 2}


def formula(text: str) -> float:
    def value(node: Any) -> float:
        match node:
            case ast.Constant():
                return float(node.value)
            case ast.Name(id="pi"):
                return float(np.pi)
            case ast.UnaryOp(op=ast.USub()):
                return -value(node.operand)
            case ast.BinOp():
                return float(_OPERATORS[type(node.op)](value(node.left), value(node.right)))
        raise ValueError(text)

    return value(ast.parse(text.strip(), mode="eval").body)


def rotation(text: str) -> Array:
    if "R" not in text:
        return np.array([formula(part) for part in text.split()]).reshape(3, 3)
    found = np.eye(3)
    for axis, angle in re.findall(r"R([xyz])\(([^()]*)\)", text):
        found = found @ Rotation.from_rotvec(formula(angle) * np.eye(3)[_ABOUT[axis]]).as_matrix()
    return found


def pose(element: Any, prefix: str = "") -> Array:
    found = np.eye(4)
    found[:3, :3] = rotation(element.get(f"{prefix}rot", "1 0 0 0 1 0 0 0 1"))
    found[:3, 3] = [formula(part) for part in element.get(f"{prefix}trans", "0 0 0").split()]
    return found


class Frame(NamedTuple):
    """A frame that joint number `joint` carries (-1: the base), there at q = 0 of that joint."""

    joint: int
    pose: Array


class Robot:
    """A file, read element by element."""

    def __init__(self, root: Any):
        assert root.tag == "robot"
        assert root.get("version") == "1.6.0"
        self.joints: list[tuple[str, Frame, Array]] = []  # tag, frame before, and from its turn to its output
        self.tips: dict[str, Frame] = {}
        self.bodies: list[tuple[Frame, float, Array, Array]] = []
        self._chain(root, Frame(-1, pose(root)))

    def _chain(self, parent: Any, at: Frame) -> None:
        for element in parent:
            if isinstance(element.tag, str):
                at = getattr(self, "_" + element.tag.replace("-", "_"))(element, at)

    def _turn(self, tag: str, at: Frame, after: Array) -> Frame:
        self.joints.append((tag, at, after))
        return Frame(len(self.joints) - 1, after)

    def _actuator(self, element: Any, at: Frame) -> Frame:
        assert element.get("type") in ("X5-1", "X5-4", "X5-9")
        self._heavy(element, at)
        after = np.eye(4)
        after[2, 3] = 0.03105
        return self._turn(element.get("tag", ""), at, after)

    def _joint(self, element: Any, at: Frame) -> Frame:
        assert element.get("axis") == "rz"
        return self._turn(element.get("tag", ""), at, np.eye(4))

    def _rigid_body(self, element: Any, at: Frame) -> Frame:
        self._heavy(element, at)
        for output in element.findall("output"):
            self._chain(output, Frame(at.joint, at.pose @ pose(output)))
        return Frame(at.joint, at.pose @ pose(element, "output_"))

    def _end_effector(self, element: Any, at: Frame) -> Frame:
        self.tips[element.get("tag", "")] = Frame(at.joint, at.pose @ pose(element, "output_"))
        return at

    def _bracket(self, element: Any, at: Frame) -> Frame:
        assert element.get("type") == "X5HeavyRightOutside"
        after = np.eye(4)
        after[:3, :3], after[:3, 3] = rotation("Rx(pi/2)"), (0.0, -0.0375, 0.055)
        return Frame(at.joint, at.pose @ after)

    def _link(self, element: Any, at: Frame) -> Frame:
        length, twist = formula(element.get("extension")), formula(element.get("twist"))
        after = np.eye(4)
        after[:3, :3] = rotation(f"Rx({twist})")
        after[:3, 3] = (length, -0.02 * np.sin(twist), 0.02 * (1.0 + np.cos(twist)))
        return Frame(at.joint, at.pose @ after)

    def _heavy(self, element: Any, at: Frame) -> None:
        assert element.tag == "actuator" or element.get("mass") is not None  # which the format requires
        mass = formula(element.get("mass", "0"))
        inertia = np.zeros((3, 3))
        for i, j, name in (
            (0, 0, "ixx"),
            (0, 1, "ixy"),
            (0, 2, "ixz"),
            (1, 1, "iyy"),
            (1, 2, "iyz"),
            (2, 2, "izz"),
        ):
            inertia[i, j] = inertia[j, i] = formula(element.get(name, "0"))
        place = np.array([formula(part) for part in element.get("com_trans", "0 0 0").split()])
        self.bodies.append((at, mass, place, inertia))

    @property
    def tags(self) -> list[str]:
        return [tag for tag, _, _ in self.joints]

    def after(self, q: dict[str, float]) -> list[Array]:
        """Where every joint's element ends, in the base frame."""
        found: list[Array] = []
        for tag, at, after in self.joints:
            before = (
                at.pose
                if at.joint < 0
                else found[at.joint] @ np.linalg.inv(self.joints[at.joint][2]) @ at.pose
            )
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, q[tag]]).as_matrix()
            found.append(before @ turn @ after)
        return found

    def at(self, frame: Frame, q: dict[str, float]) -> Array:
        if frame.joint < 0:
            return frame.pose
        return self.after(q)[frame.joint] @ np.linalg.inv(self.joints[frame.joint][2]) @ frame.pose


def read(path: Path) -> Robot:
    return Robot(ElementTree.parse(path).getroot())


# ------------------------------------------------------------------ robots


def random_robot(rng: Generator, joints: int, roots: int) -> tuple[Chain, list[ModuleType]]:
    """Modules of any type mounted anyhow; the axes of a third are not where their type has them."""
    types = [list(CATALOGUE.values())[i] for i in rng.integers(0, len(CATALOGUE), joints)]
    home = np.tile(np.eye(4), (joints, 1, 1))
    home[:, :3, :3] = Rotation.random(joints, rng=rng).as_matrix()
    home[:, :3, 3] = rng.uniform(-1.0, 1.0, (joints, 3))
    turned = rng.random(joints) < 0.3
    axis = np.where(turned, -1.0, 1.0)[:, None] * home[:, :3, 2]
    across = np.array([np.array(kind.output_xyz) - np.array(kind.imu_xyz) for kind in types])
    point = np.einsum("nij,nj->ni", home[:, :3, :3], across) + home[:, :3, 3]
    for k in np.flatnonzero(rng.random(joints) < 0.3):
        axis[k] = Rotation.from_rotvec(rng.normal(size=3) * 1e-3).apply(axis[k])
        point[k] += rng.normal(size=3) * 1e-3
    parent = [-1] * roots + [int(rng.integers(0, i)) for i in range(roots, joints)]
    chain = Chain(
        serials=tuple(f"X5-{i}.a" for i in range(joints)),
        parent=tuple(parent),
        reversed=tuple(bool(t) for t in turned),
        axis=axis,
        point=point,
        imu_home=home,
        gravity=Rotation.random(rng=rng).apply([0.0, 0.0, 9.81]),
    )
    return chain, types


def compare(chain: Chain, types: Any, found: Robot, q: Array) -> None:
    """The faces at the ends of the branches, and how every joint's body is displaced, at q (m, n)."""
    base = upright_pose(chain.gravity)
    moved, tips = body_displacements(chain, q), distal_homes(chain, types)
    rest = found.after(dict.fromkeys(chain.serials, 0.0))
    for displaced, one in zip(moved, q.tolist(), strict=True):
        at = dict(zip(chain.serials, one, strict=True))
        for tag, now, home in zip(found.tags, found.after(at), rest, strict=True):
            expected = base @ displaced[chain.serials.index(tag)] @ np.linalg.inv(base)
            np.testing.assert_allclose(now @ np.linalg.inv(home), expected, atol=1e-9)
        for tag, frame in found.tips.items():
            k = chain.serials.index(tag.removeprefix("tip_"))
            np.testing.assert_allclose(found.at(frame, at), base @ displaced[k] @ tips[k], atol=1e-9)


def check_torques(found: Robot, chain: Chain, phi: Any) -> None:
    """Compare the torques of the bodies in a file, by pinocchio, with those of the regressor."""
    model = pin.Model()
    for tag, at, _ in found.joints:
        model.addJoint(at.joint + 1, pin.JointModelRZ(), pin.SE3(at.pose), tag)
    for at, mass, place, inertia in found.bodies:
        if at.joint >= 0 and mass > 0.0:
            into = pin.SE3(at.pose)
            model.appendBodyToJoint(at.joint + 1, pin.Inertia(mass, place, inertia), into)
    q, qd, qdd = default_rng(3).uniform(-2, 2, (3, 4, len(chain.serials)))
    order = [chain.serials.index(tag) for tag in found.tags]
    expected = inverse_dynamics(chain, phi, q, qd, qdd)
    data = model.createData()
    for k in range(4):
        tau = pin.rnea(model, data, q[k, order], qd[k, order], qdd[k, order])
        np.testing.assert_allclose(tau, expected[k, order], atol=1e-9)


# ------------------------------------------------------------------ tests


@settings(max_examples=40, deadline=None)
@given(joints=st.integers(1, 9), seed=st.integers(0, 2**32 - 1))
def test_every_body_and_tip_moves_as_the_chains(
    tmp_path_factory: pytest.TempPathFactory, joints: int, seed: int
) -> None:
    rng = default_rng(seed)
    chain, types = random_robot(rng, joints, roots=1 + int(joints > 2 and rng.random() < 0.3))
    path = tmp_path_factory.mktemp("hrdf") / "robot.hrdf"
    write_hrdf(path, chain, types)
    found = read(path)
    assert found.tags == [chain.serials[k] for k in joint_order(chain)]
    leaves = [s for k, s in enumerate(chain.serials) if k not in chain.parent]
    assert sorted(found.tips) == sorted(f"tip_{s}" for s in leaves)
    compare(chain, types, found, rng.uniform(-3.0, 3.0, (4, joints)))


@pytest.mark.parametrize("name", ["a2085_04", "tree_y", "snake16", "arm7"])
def test_forward_modules_of_the_makers_types_are_its_actuators(tmp_path: Path, name: str) -> None:
    robot = load_robot(name)
    chain, types = true_chain(robot), build_tree(robot).types
    write_hrdf(tmp_path / "robot.hrdf", chain, types, name=name)
    root = ElementTree.parse(tmp_path / "robot.hrdf").getroot()
    assert root.get("description") == name
    made = {
        s
        for s, kind, turned in zip(chain.serials, types, chain.reversed, strict=True)
        if not turned and kind.name.startswith("X5")
    }
    assert {str(a.get("tag")) for a in root.iter("actuator")} == made
    assert {str(j.get("tag")) for j in root.iter("joint")} == set(chain.serials) - made
    compare(chain, types, read(tmp_path / "robot.hrdf"), default_rng(1).uniform(-3, 3, (4, len(types))))


def test_the_makers_own_file_of_its_kit_arm_is_read_as_the_simulated_arm(tmp_path: Path) -> None:
    """So the reader above, and the frames in which we write, are those of the format."""
    (tmp_path / "kit.hrdf").write_text(
        '<robot version="1.6.0"><actuator type="X5-4" tag="shoulder-yaw"/>'
        '<bracket type="X5HeavyRightOutside"/><actuator type="X5-9" tag="shoulder-lift"/>'
        '<link type="X5" extension="0.325" twist="pi"/><actuator type="X5-4" tag="elbow"/>'
        '<end-effector tag="tip_elbow"/></robot>'
    )
    robot = load_robot("a2085_03")
    chain, types = true_chain(robot), build_tree(robot).types
    compare(chain, types, read(tmp_path / "kit.hrdf"), default_rng(2).uniform(-3, 3, (5, 3)))


@pytest.mark.parametrize("name", ["a2085_04", "tree_y", "snake16"])
def test_with_identified_bodies_the_torques_are_those_of_the_regressor(tmp_path: Path, name: str) -> None:
    robot = load_robot(name)
    chain, types = true_chain(robot), build_tree(robot).types
    phi = true_inertia(robot).ravel()
    write_hrdf(tmp_path / "robot.hrdf", chain, types, phi)
    assert "no real body's" not in (tmp_path / "robot.hrdf").read_text()
    check_torques(read(tmp_path / "robot.hrdf"), chain, phi)


@pytest.mark.parametrize("name", ["a2085_04", "tree_y", "snake16"])
def test_without_identified_bodies_modules_have_the_mass_of_their_types(tmp_path: Path, name: str) -> None:
    """An actuator has it in the manufacturer's library, a module that is none to the format in its bodies."""
    robot = load_robot(name)
    chain, types = true_chain(robot), build_tree(robot).types
    write_hrdf(tmp_path / "robot.hrdf", chain, types)
    found = read(tmp_path / "robot.hrdf")
    made = {a.get("tag") for a in ElementTree.parse(tmp_path / "robot.hrdf").getroot().iter("actuator")}
    others = [k for k, serial in enumerate(chain.serials) if serial not in made]
    bodies = modules_alone(chain, types, others)
    check_torques(found, chain, np.concatenate([parameters(one) for one in bodies]))
    # A tenth of a module turns with its output, the rest with its housing; the base has no mass in the file.
    moved = sum(
        types[k].mass_kg * (1.0 if chain.parent[k] >= 0 else 0.9 if chain.reversed[k] else 0.1)
        for k in others
    )
    assert sum(mass for _, mass, _, _ in found.bodies) == pytest.approx(moved)


def test_without_identified_bodies_only_the_actuators_are_heavy(tmp_path: Path) -> None:
    robot = load_robot("tree_y")
    chain, types = true_chain(robot), build_tree(robot).types
    root = hrdf_element(chain, types)
    assert all(body.get("mass") == "0" for body in root.iter("rigid-body"))
    assert all(actuator.get("mass") is None for actuator in root.iter("actuator"))


def test_what_is_no_real_body_is_replaced_and_said() -> None:
    robot = load_robot("a2085_04")
    chain, types = true_chain(robot), build_tree(robot).types
    phi = true_inertia(robot).copy()
    phi[1, 0] = -0.2
    root = hrdf_element(chain, types, phi.ravel())
    comments = [e for e in root if not isinstance(e.tag, str) and "no real body's" in str(e.text)]
    assert len(comments) == 1
    assert all(float(str(body.get("mass"))) >= 0.0 for body in root.iter("rigid-body"))


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "robot.hrdf"
    chain, types = random_robot(default_rng(4), 3, 1)
    write_hrdf(path, chain, types)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="phi has 3 values"):
        write_hrdf(path, chain, types, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="2 module types"):
        write_hrdf(path, chain, types[:2])
    (tmp_path / "robot.hrdf.part").mkdir()
    with pytest.raises(OSError, match=r"robot\.hrdf\.part"):
        write_hrdf(path, chain, types)
    assert path.read_bytes() == before

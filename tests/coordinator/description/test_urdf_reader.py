"""A URDF as a chain: torques and regressor against pinocchio's own reading of the same file."""

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.random import default_rng

from coordinator.description.urdf_reader import STANDARD_GRAVITY, UrdfError, read_urdf
from coordinator.dynamics.pseudo_inertia import parameter_transform
from module_agent.model.chain import Array
from module_agent.model.regressor import PER_BODY, inverse_dynamics, torque_regressor

TX40 = Path(__file__).resolve().parents[3] / ".." / "shared" / "data" / "tx40" / "tx40.urdf"
# Pinocchio's order of a body's dynamic parameters: m, mc, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
PIN_ORDER = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]


def numbers(values: Array) -> str:
    return " ".join(repr(float(v)) for v in values)


def random_urdf(seed: int, joints: int) -> str:
    """A tree of revolute and continuous joints, with a link fixed to every other body and one to the base."""
    rng = default_rng(seed)
    parts = ['<robot name="random"><link name="base"/>']
    for i in range(joints):
        on = "base" if i == 0 else f"link_{rng.integers(0, i)}"
        parts += [
            link(f"link_{i}", rng),
            joint(f"j{i}", ("revolute", "continuous")[i % 2], on, f"link_{i}", rng),
        ]
        if i % 2:
            parts += [link(f"tool_{i}", rng), joint(f"f{i}", "fixed", f"link_{i}", f"tool_{i}", rng)]
    parts += [link("table", rng), joint("stand", "fixed", "base", "table", rng)]
    return "\n".join([*parts, "</robot>"])


def origin(rng: np.random.Generator) -> str:
    return f'<origin xyz="{numbers(rng.uniform(-0.5, 0.5, 3))}" rpy="{numbers(rng.uniform(-3.0, 3.0, 3))}"/>'


def link(name: str, rng: np.random.Generator) -> str:
    shape = rng.normal(size=(3, 3)) * 0.05
    spread = shape @ shape.T
    inertia = np.trace(spread) * np.eye(3) - spread  # any positive mass distribution
    six = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), inertia[np.triu_indices(3)], strict=True)
    text = " ".join(f'{key}="{float(value)!r}"' for key, value in six)
    return (
        f'<link name="{name}"><inertial>{origin(rng)}<mass value="{rng.uniform(0.1, 3.0)}"/>'
        f"<inertia {text}/></inertial></link>"
    )


def joint(name: str, kind: str, parent: str, child: str, rng: np.random.Generator) -> str:
    limit = '<limit lower="-3" upper="3" effort="9" velocity="9"/>' if kind == "revolute" else ""
    return (
        f'<joint name="{name}" type="{kind}">{origin(rng)}<parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{numbers(rng.normal(size=3))}"/>{limit}</joint>'
    )


def pin_q(model: pin.Model, name: str, q: Array) -> Array:
    """Pinocchio keeps a continuous joint as cosine and sine, and orders joints by itself."""
    found = np.zeros(model.nq)
    for own, value in zip(name.split(), q, strict=True):
        at = model.joints[model.getJointId(own)]
        found[at.idx_q : at.idx_q + at.nq] = [value] if at.nq == 1 else [np.cos(value), np.sin(value)]
    return found


def in_order(model: pin.Model, names: tuple[str, ...]) -> Array:
    return np.array([model.joints[model.getJointId(name)].idx_v for name in names])


@pytest.mark.parametrize(("joints", "seed"), [(1, 0), (4, 1), (7, 2), (9, 3)])
def test_the_torques_of_the_urdfs_inertias_are_pinocchios(tmp_path: Path, joints: int, seed: int) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(random_urdf(seed, joints))
    compare(path, joints, seed)


def test_the_staubli_tx40s_torques_are_pinocchios() -> None:
    if not TX40.exists():
        pytest.skip("the data of the Staubli TX40 is not next to the project")
    compare(TX40, 6, 0)


def compare(
    path: Path, joints: int, seed: int, gravity: tuple[float, float, float] = STANDARD_GRAVITY
) -> None:
    robot = read_urdf(path, gravity)
    model = pin.buildModelFromUrdf(str(path))
    model.gravity.linear = -np.array(gravity)
    data, names = model.createData(), robot.chain.serials
    at = in_order(model, names)
    q, qd, qdd = default_rng(seed).uniform(-3.0, 3.0, (3, 12, joints))
    assert robot.phi is not None
    ours = inverse_dynamics(robot.chain, robot.phi, q, qd, qdd)
    regressor = torque_regressor(robot.chain, q, qd, qdd)
    for k in range(q.shape[0]):
        position, rates = pin_q(model, " ".join(names), q[k]), np.zeros((2, model.nv))
        rates[:, at] = qd[k], qdd[k]
        theirs = pin.rnea(model, data, position, *rates)[at]
        np.testing.assert_allclose(ours[k], theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())
        matrix = np.atleast_2d(pin.computeJointTorqueRegressor(model, data, position, *rates))[at]
        for body, index in enumerate(at):
            # Theirs is in the joint's frame: the link's own, as a URDF's joint frame is.
            block = regressor[k][:, PER_BODY * body : PER_BODY * (body + 1)] @ parameter_transform(
                robot.homes[body]
            )
            expected = matrix[:, PER_BODY * index : PER_BODY * (index + 1)][:, PIN_ORDER]
            np.testing.assert_allclose(block, expected, rtol=0, atol=1e-9 * np.abs(matrix).max())


def test_a_robot_on_a_wall_has_the_gravity_that_is_given(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(random_urdf(5, 3))
    compare(path, 3, 5, gravity=(6.0, 0.0, -7.0))


def test_joints_written_in_any_order_give_the_same_tree(tmp_path: Path) -> None:
    path, text = tmp_path / "robot.urdf", random_urdf(6, 4)
    path.write_text(text)
    first = read_urdf(path)
    lines = text.splitlines()
    path.write_text("\n".join([lines[0], *reversed(lines[1:-1]), lines[-1]]))
    again = read_urdf(path)
    order = [again.chain.serials.index(name) for name in first.chain.serials]
    np.testing.assert_array_equal(again.chain.axis[order], first.chain.axis)
    assert [again.bodies[i] for i in order] == list(first.bodies)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            'type="revolute"',
            'type="planar"',
            "joint 'j0' is planar; revolute, continuous, prismatic and fixed",
        ),
        ('<parent link="base"/>', '<parent link="bed"/>', "joint 'j0' has parent 'bed', and no link has"),
        ('<mass value="', '<mass value="heavy', "inertial of link 'link_0': value holds 'heavy"),
        ('<origin xyz="', '<origin xyz="nan ', "inertial of link 'link_0': xyz="),
        ("<robot", "<robots", "not XML"),
        ('link="link_0"/><axis', 'link="link_1"/><axis', "link 'link_1' is the child of several joints"),
    ],
)
def test_what_is_no_tree_of_turning_joints_is_refused_by_name(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = tmp_path / "robot.urdf"
    text = random_urdf(7, 2)
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(UrdfError, match=message) as raised:
        read_urdf(path)
    assert str(raised.value).startswith(str(path))


def test_what_slides_mimics_or_is_held_is_fixed_at_its_position(tmp_path: Path) -> None:
    path, text = tmp_path / "robot.urdf", random_urdf(8, 3)
    path.write_text(text)
    free = read_urdf(path)
    turned = read_urdf(path, held={"j2": 0.7})
    assert turned.held == {"j2": 0.7}
    assert turned.chain.serials == ("j0", "j1")
    rng = default_rng(1)
    q, qd, qdd = rng.uniform(-1.0, 1.0, (3, 5, 3))
    q[:, 2], qd[:, 2], qdd[:, 2] = 0.7, 0.0, 0.0
    assert free.phi is not None
    assert turned.phi is not None
    whole = inverse_dynamics(free.chain, free.phi, q, qd, qdd)
    held = inverse_dynamics(turned.chain, turned.phi, q[:, :2], qd[:, :2], qdd[:, :2])
    np.testing.assert_allclose(held, whole[:, :2], atol=1e-9)
    path.write_text(re.sub(r'(name="j2" type=)"\w+"', r'\1"prismatic"', text))
    closed, opened = read_urdf(path), read_urdf(path, held={"j2": 0.05})
    assert (closed.held, opened.held) == ({"j2": 0.0}, {"j2": 0.05})
    assert closed.phi is not None
    assert opened.phi is not None
    moved = (opened.phi - closed.phi).reshape(-1, PER_BODY)
    # The sliding link's mass stays, its first moment moves by mass times 5 cm.
    carrier = int(np.argmax(np.abs(moved).max(axis=1)))
    assert moved[carrier, 0] == 0.0
    assert np.linalg.norm(moved[carrier, 1:4]) > 0.0


def test_a_urdf_without_inertias_claims_none(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(
        '<robot name="bare"><link name="a"/><link name="b"/><joint name="j" type="continuous">'
        '<parent link="a"/><child link="b"/></joint></robot>'
    )
    robot = read_urdf(path)
    assert robot.phi is None
    np.testing.assert_array_equal(robot.chain.axis, [[1.0, 0.0, 0.0]])

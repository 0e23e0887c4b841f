import math

import numpy as np
import pytest

from sim.geometry.link_parts import STRUCTURE_LOSS_S, Part, Tube, placed
from sim.geometry.pose import Array, pose
from sim.geometry.rigid_body import joined, moved, parameters
from sim.physics.rigid_tree import RigidTree
from sim.physics.skeleton import build_skeleton
from sim.robot.robot_file import load_robot, parse_robot, shipped_robots
from sim.robot.robot_tree import build_tree
from sim.world.world import World

BASE = """name = "b"
[base.compliance]
mass_kg = 2.0
stiffness_n_m = [1e4, 0.0, 2e4]
damping_n_s_m = [5.0, 0.0, 0.0]
stiffness_nm_rad = [0.0, 500.0, 0.0]
[[module]]
serial = "one"
type = "X5-9"
parent = "base"
[[module]]
serial = "two"
type = "X5-4"
parent = "one"
link = { tube = { length_m = 0.3 } }
"""


@pytest.mark.parametrize("name", shipped_robots())
def test_a_rigid_skeleton_has_the_modules_joints_and_bodies(name: str) -> None:
    robot = load_robot(name)
    tree, skeleton = build_tree(robot), build_skeleton(robot)
    assert skeleton.names == tree.serials
    assert skeleton.parent == tree.parent
    assert skeleton.module == tuple(range(len(tree.serials)))
    assert skeleton.passive == ()
    parents = [tree.output[p] if p >= 0 else np.eye(4) for p in tree.parent]
    np.testing.assert_allclose(skeleton.origin, np.linalg.inv(parents) @ tree.output, atol=1e-15)
    carriers = [tree.output[b] if b >= 0 else np.eye(4) for b in skeleton.imu_body]
    imus = tree.housing @ np.array([pose(kind.imu_xyz) for kind in tree.types])
    np.testing.assert_allclose(skeleton.imu_pose, np.linalg.inv(carriers) @ imus, atol=1e-15)
    for body, wanted in zip(skeleton.bodies, tree.bodies, strict=True):
        np.testing.assert_allclose(parameters(body), parameters(wanted), atol=1e-14)


@pytest.mark.parametrize("name", ["arm6", "arm7", "tree_y", "thesis_350_vertical"])
def test_what_gives_is_at_rest_where_the_rigid_robot_is(name: str) -> None:
    robot = load_robot(name)
    rigid, giving = build_skeleton(robot), build_skeleton(robot, 1.0, 1.0)
    assert len(giving.names) > len(rigid.names)
    q = np.random.default_rng(3).uniform(-1.0, 1.0, len(rigid.names))
    full = np.zeros(len(giving.names))
    full[list(giving.module)] = q
    still = np.zeros(len(q))
    np.testing.assert_allclose(
        RigidTree(giving).imu_readings(full, np.zeros_like(full), np.zeros_like(full))[1],
        RigidTree(rigid).imu_readings(q, still, still)[1],
        atol=1e-12,
    )
    mass, _ = RigidTree(giving).mass_and_bias(full, np.zeros_like(full))
    own = list(giving.module)
    # But for intermediate bodies of a milligram the joints' block is the rigid robot's.
    wanted, _ = RigidTree(rigid).mass_and_bias(q, still)
    np.testing.assert_allclose(mass[np.ix_(own, own)], wanted, atol=1e-5)


def test_a_joint_is_made_only_where_a_stiffness_is_given() -> None:
    robot = parse_robot(BASE, "b.toml")
    names = ("base/x", "base/z", "base/ry", "one", "two/flex1-x", "two/flex1-y", "two/flex1-z", "two")
    skeleton = build_skeleton(robot, 1.0, 1.0)
    assert skeleton.names == names
    assert skeleton.prismatic == (True, True, *[False] * 6)
    assert skeleton.passive == (0, 1, 2, 4, 5, 6)
    np.testing.assert_allclose(skeleton.stiffness[:3], [1e4, 2e4, 500.0])
    np.testing.assert_allclose(skeleton.damping[:3], [5.0, 0.0, 0.0])
    assert build_skeleton(robot, 1.0, 0.0).names == ("base/x", "base/z", "base/ry", "one", "two")
    assert build_skeleton(robot, 0.0, 1.0).names == names[3:]


def test_half_the_compliance_is_twice_the_stiffness_at_the_same_damping_ratio() -> None:
    robot = parse_robot(BASE, "b.toml")
    whole, half = build_skeleton(robot, 1.0, 1.0), build_skeleton(robot, 0.5, 0.5)
    np.testing.assert_allclose(half.stiffness, 2.0 * whole.stiffness)
    np.testing.assert_allclose(half.damping**2 / half.stiffness, whole.damping**2 / whole.stiffness)


def _push(robot_text: str, module: str, force: Array) -> Array:
    """Deflect the passive joints of a robot by a force at a module's frame, by Jacobians of small motions."""
    robot = parse_robot(robot_text, "t.toml")
    skeleton = build_skeleton(robot, 1.0, 1.0)
    m = len(skeleton.names)

    def place(q: Array) -> Array:
        world: list[Array] = []
        for i in range(m):
            step = np.eye(4)
            c, s = math.cos(q[i]), math.sin(q[i])
            if skeleton.prismatic[i]:
                step[2, 3] = q[i]
            else:
                step[:2, :2] = [[c, -s], [s, c]]
            held = world[skeleton.parent[i]] if skeleton.parent[i] >= 0 else np.eye(4)
            world.append(held @ skeleton.origin[i] @ step)
        return world[skeleton.names.index(module)][:3, 3]

    jacobian = np.array([(place(1e-6 * e) - place(-1e-6 * e)) / 2e-6 for e in np.eye(m)]).T
    passive = jacobian[:, list(skeleton.passive)]
    sag: Array = passive @ ((passive.T @ force) / skeleton.stiffness)
    return sag


def test_a_tube_sags_under_a_force_at_its_end_as_a_clamped_beam() -> None:
    length, force = 0.4, 10.0
    tube = f"length_m = {length}, twist_rad = 3.141592653589793"
    text = 'name = "t"\n[[module]]\nserial = "a"\ntype = "X5-9"\nparent = "base"\n'
    text += f"link = {{ tube = {{ {tube} }} }}\n"
    # The output lies 31 mm beyond the tube's end, across it, which the twist moves a little too.
    sag = _push(text, "a", np.array([0.0, force, 0.0]))[1]
    # F L^3 / 3 E I with the published 0.4 kg/m and the radius of 16 mm; Howell's hinge is 3.7 % stiffer for
    # small deflections, as 0.85^2 / 2.25 is to a third.
    inner = math.sqrt(0.016**2 - 0.4 / 2700.0 / math.pi)
    area_moment = math.pi / 4 * (0.016**4 - inner**4)
    beam = force * length**3 / (3.0 * 69e9 * area_moment)
    assert sag == pytest.approx(beam, rel=0.06)


def test_a_tube_loses_two_percent_of_critical_at_forty_hertz() -> None:
    hinge = placed(Part(tube=Tube(length_m=0.3))).hinge
    assert hinge is not None
    omega = 2 * math.pi * 40.0
    np.testing.assert_allclose(hinge.damping_nm_s_rad / hinge.stiffness_nm_rad * omega / 2.0, 0.02)
    assert STRUCTURE_LOSS_S * omega / 2.0 == pytest.approx(0.02)


def test_a_base_rocks_about_its_pivot() -> None:
    text = BASE.replace(
        "stiffness_n_m = [1e4, 0.0, 2e4]\ndamping_n_s_m = [5.0, 0.0, 0.0]\n", "pivot_m = [0, 0, -0.5]\n"
    )
    force = np.array([3.0, 0.0, 0.0])
    height = 0.5 + 0.03105
    # A force at a height h over a hinge of 500 Nm/rad: F h^2 / k.
    assert _push(text, "one", force)[0] == pytest.approx(3.0 * height**2 / 500.0, rel=1e-6)


def test_all_mass_is_in_the_skeleton_and_what_the_base_holds_only_if_it_shakes() -> None:
    robot = parse_robot(BASE, "b.toml")
    rigid, giving = build_skeleton(robot), build_skeleton(robot, 1.0, 1.0)
    light = 1e-6 * sum(body.mass_kg < 1e-5 for body in giving.bodies)
    masses = [sum(b.mass_kg for b in s.bodies) for s in (rigid, giving)]
    held = build_tree(robot).segments[0][-1].body.mass_kg
    assert masses[1] - light == pytest.approx(masses[0] + 2.0 + held, rel=1e-12)


def test_an_explicit_flex_replaces_that_of_the_tubes_and_zero_makes_them_rigid() -> None:
    for stiffness, wanted in (("[0.0, 900.0, 0.0]", ("two/flex1-y",)), ("[0, 0, 0]", ())):
        robot = parse_robot(BASE + f"flex = {{ stiffness_nm_rad = {stiffness} }}\n", "b.toml")
        skeleton = build_skeleton(robot, 0.0, 1.0)
        assert tuple(skeleton.names[i] for i in skeleton.passive) == wanted
        # Cut in segments or not, a link weighs the same.
        link = joined(s.body for s in build_tree(robot).segments[1])
        whole = joined(moved(s.body, np.eye(4)) for s in build_tree(parse_robot(BASE, "b.toml")).segments[1])
        np.testing.assert_allclose(parameters(link), parameters(whole), atol=1e-15)


def test_a_rigid_profile_and_a_robot_without_compliance_are_the_same_world() -> None:
    text = BASE[: BASE.index("[base.compliance]")] + BASE[BASE.index("[[module]]") :]
    plants = []
    for file in (BASE, text):
        world = World(parse_robot(file, "b.toml"), seed=1, noise="ideal")
        for k in range(200):
            world.step([0.2 * math.sin(0.05 * k), 0.1])
        plants.append(world.plant)
        world.close()
    np.testing.assert_array_equal(plants[0].q_rad, plants[1].q_rad)

import numpy as np
import pytest

from module_agent.model.catalogue import CATALOGUE, module_type
from module_agent.model.forward_kinematics import imu_poses
from sim.geometry.link_parts import BRACKETS, Part, Tube, placed
from sim.geometry.pose import pose
from sim.geometry.rigid_body import about_origin, joined, moved, parameters, tensor
from sim.physics.rigid_tree import RigidTree
from sim.physics.skeleton import build_skeleton
from sim.robot.robot_file import load_robot, parse_robot, shipped_robots
from sim.robot.robot_tree import FLANGE, build_tree, housing, true_chain, true_inertia


@pytest.mark.parametrize("name", CATALOGUE)
def test_housing_and_flange_together_are_the_module_of_the_catalogue(name: str) -> None:
    kind = module_type(name)
    whole = joined([housing(kind), moved(FLANGE, pose(kind.output_xyz))])
    assert whole.mass_kg == pytest.approx(kind.mass_kg, rel=1e-12)
    np.testing.assert_allclose(whole.com_m, kind.com_xyz, atol=1e-15)
    np.testing.assert_allclose(whole.inertia_kg_m2, tensor(*kind.inertia), rtol=1e-9, atol=1e-15)


def test_two_half_rods_make_one_rod() -> None:
    def rod(length: float, middle: float) -> tuple[float, np.ndarray, np.ndarray]:
        return length, np.array([middle, 0.0, 0.0]), np.diag([0.0, length**3 / 12, length**3 / 12])

    whole = joined([type(housing(module_type("X5-1")))(*rod(0.5, x)) for x in (0.25, 0.75)])
    np.testing.assert_allclose(whole.com_m, [0.5, 0.0, 0.0])
    np.testing.assert_allclose(whole.inertia_kg_m2, np.diag([0.0, 1.0, 1.0]) / 12, atol=1e-15)
    # About its end: m L^2 / 3.
    np.testing.assert_allclose(about_origin(whole), np.diag([0.0, 1.0, 1.0]) / 3, atol=1e-15)


@pytest.mark.parametrize("name", shipped_robots())
def test_all_mass_of_a_robot_is_either_moving_or_fixed_to_the_base(name: str) -> None:
    robot = load_robot(name)
    modules = sum(module_type(m.type).mass_kg for m in robot.modules)
    links = sum(placed(p).body.mass_kg for m in robot.modules for p in m.link)
    fixed = housing(module_type(robot.modules[0].type)).mass_kg
    assert true_inertia(robot)[:, 0].sum() == pytest.approx(modules + links - fixed, rel=1e-12)


@pytest.mark.parametrize("name", shipped_robots())
def test_every_body_has_an_inertia_that_a_solid_can_have(name: str) -> None:
    for body in build_tree(load_robot(name)).bodies:
        moments = np.linalg.eigvalsh(body.inertia_kg_m2)
        assert moments[0] > 0.0
        # With margin: the physics engine zeroes a tensor that misses the triangle inequality by rounding.
        assert moments[0] + moments[1] > moments[2] * 1.0001


def test_the_output_of_a_tube_follows_the_published_formula() -> None:
    for twist in (0.0, 0.4, np.pi):
        found = placed(Part(tube=Tube(length_m=0.325, twist_rad=twist)))
        np.testing.assert_allclose(
            found.output[:3, 3], [0.325, -0.02 * np.sin(twist), 0.02 * (1 + np.cos(twist))], atol=1e-15
        )
        assert found.output[2, 2] == pytest.approx(np.cos(twist))
        assert found.body.mass_kg == pytest.approx(0.4 * 0.325 + 0.199)


def test_a_right_bracket_turns_the_next_axis_to_minus_y_and_a_left_one_to_plus_y() -> None:
    for name in BRACKETS:
        z_axis = placed(Part(bracket=name)).output[:3, 2]
        np.testing.assert_allclose(z_axis, [0.0, -1.0 if "Right" in name else 1.0, 0.0], atol=1e-15)
    assert placed(Part(bracket="HeavyRightInside")).output[1, 3] == pytest.approx(0.0225)
    assert placed(Part(bracket="HeavyRightOutside")).output[1, 3] == pytest.approx(-0.0375)


REVERSED = """name = "r"
[[module]]
serial = "one"
type = "X5-9"
parent = "base"
[[module]]
serial = "two"
type = "X5-4"
parent = "one"
mounted = "reversed"
link = { pose = { xyz_m = [0.2, 0.0, 0.0] } }
"""


def test_a_reversed_module_is_held_by_its_output_and_turns_its_housing_the_other_way() -> None:
    chain = true_chain(parse_robot(REVERSED, "r.toml"))
    thickness = module_type("X5-4").output_xyz[2]
    top = module_type("X5-9").output_xyz[2]
    np.testing.assert_allclose(chain.point[1], [0.2, 0.0, top], atol=1e-15)
    np.testing.assert_allclose(chain.axis[1], [0.0, 0.0, -1.0], atol=1e-15)
    np.testing.assert_allclose(
        chain.imu_home[1][:3, 3], np.array([0.225, 0.0, top - thickness + 0.003]), atol=1e-15
    )
    # Its IMU goes round with its own joint: a quarter turn takes it from +x to -y of its axis.
    turned = imu_poses(chain, [[0.0, np.pi / 2]])[0, 1]
    np.testing.assert_allclose(turned[:3, 3], [0.2, -0.025, top - thickness + 0.003], atol=1e-12)


def test_a_reversed_module_lends_its_flange_to_the_parent_and_moves_its_housing() -> None:
    inertia = true_inertia(parse_robot(REVERSED, "r.toml"))
    four = module_type("X5-4")
    assert inertia[0, 0] == pytest.approx(2 * FLANGE.mass_kg)
    assert inertia[1, 0] == pytest.approx(housing(four).mass_kg)


def test_the_inertial_parameters_are_in_the_order_of_equation_25() -> None:
    body = joined([type(housing(module_type("X5-1")))(2.0, np.array([0.1, 0.2, 0.3]), np.zeros((3, 3)))])
    # A point mass: I = m (|c|^2 1 - c c^T).
    expected = [2.0, 0.2, 0.4, 0.6, 0.26, -0.04, -0.06, 0.20, -0.12, 0.10]
    np.testing.assert_allclose(parameters(body), expected, atol=1e-12)


def _largest_load(name: str, simultaneously: bool) -> float:
    """Static torque over the largest effort, worst over joints and poses within half a radian of home."""
    robot = load_robot(name)
    limit = np.array([t.max_effort_nm for t in build_tree(robot).types])
    n = len(limit)
    tree = RigidTree(build_skeleton(robot))
    still = np.zeros(n)
    rng = np.random.default_rng(3)
    poses = [d * row for row in np.eye(n) for d in np.linspace(-0.5, 0.5, 9)]
    if simultaneously:
        poses += [rng.uniform(-0.5, 0.5, n) for _ in range(100)] + [
            rng.choice([-0.5, 0.5], n) for _ in range(200)
        ]
    return max(float(np.max(np.abs(tree.mass_and_bias(q, still)[1]) / limit)) for q in poses)


@pytest.mark.parametrize("name", shipped_robots())
def test_a_robot_can_hold_itself_at_sixty_percent_of_its_effort_with_every_joint_moved_alone(
    name: str,
) -> None:
    assert _largest_load(name, simultaneously=False) < 0.6


@pytest.mark.parametrize("name", [n for n in shipped_robots() if n != "snake16"])
def test_a_robot_can_hold_itself_at_sixty_percent_with_all_joints_moved(name: str) -> None:
    assert _largest_load(name, simultaneously=True) < 0.6


def test_the_snake_can_hold_itself_with_all_joints_moved() -> None:
    # No sixteen modules of the catalogue in a row stay below 60 % at every such pose.
    assert _largest_load("snake16", simultaneously=True) < 1.0

from pathlib import Path

import numpy as np
import pytest

from module_agent.model.catalogue import CATALOGUE
from sim.robot.robot_file import BASE, RobotFileError, load_robot, parse_robot, shipped_robots
from sim.robot.robot_tree import true_chain

GOOD = """name = "pair"
noise = "ideal"

[base]
mount = "wall"

[[module]]
serial = "one"
type = "X5-9"
parent = "base"

[[module]]
serial = "two"
type = "X5-4"
parent = "one"
link = [
    { bracket = "HeavyRightOutside" },
    { tube = { length_m = 0.3, twist_rad = 0.0 } },
]
"""


@pytest.mark.parametrize("name", shipped_robots())
def test_a_shipped_robot_is_called_as_its_file_and_lists_parents_first(name: str) -> None:
    robot = load_robot(name)
    assert robot.name == name
    assert all(parent < i for i, parent in enumerate(robot.parents))


def test_the_shipped_robots_are_the_announced_ones() -> None:
    arms = {f"thesis_{mm}_{way}" for mm in (484, 350, 245, 171) for way in ("horizontal", "vertical")}
    others = {"a2085_03", "a2085_04", "a2085_06", "arm6", "arm7", "snake16", "tree_y"}
    assert arms | others <= set(shipped_robots())


@pytest.mark.parametrize("millimetres", [484, 350, 245, 171])
@pytest.mark.parametrize("way", ["horizontal", "vertical"])
def test_the_imu_of_a_thesis_arm_is_as_far_from_the_axis_as_its_name_says(millimetres: int, way: str) -> None:
    chain = true_chain(load_robot(f"thesis_{millimetres}_{way}"))
    imu = chain.imu_home[1]
    across = np.cross(chain.axis[0], imu[:3, 3] - chain.point[0])
    assert np.linalg.norm(across) == pytest.approx(millimetres / 1000, abs=1e-12)
    # As in the thesis: z of the IMU is the axis, x points away from it; gravity lies along it or across it.
    np.testing.assert_allclose(imu[:3, 2], chain.axis[0], atol=1e-12)
    np.testing.assert_allclose(imu[:3, 0], [1.0, 0.0, 0.0], atol=1e-12)
    along = chain.gravity @ chain.axis[0]
    assert along == pytest.approx(9.81 if way == "horizontal" else 0.0, abs=1e-12)


def test_a_vertical_thesis_arm_starts_hanging() -> None:
    robot = load_robot("thesis_484_vertical")
    chain = true_chain(robot)
    c, s = np.cos(robot.start_rad[0]), np.sin(robot.start_rad[0])
    reach = np.array([c, s, 0.0])
    assert reach @ chain.gravity == pytest.approx(-9.81)


def test_modules_are_ordered_depth_first_whatever_their_order_in_the_file() -> None:
    text = 'name = "t"\n' + "".join(
        f'[[module]]\nserial = "{serial}"\ntype = "X5-1"\nparent = "{parent}"\n'
        for serial, parent in (("a2", "a1"), ("b1", "root"), ("a1", "root"), ("root", BASE), ("b2", "b1"))
    )
    assert parse_robot(text, "t.toml").serials == ("root", "b1", "b2", "a1", "a2")


def test_a_good_file_is_read_from_a_path(tmp_path: Path) -> None:
    path = tmp_path / "pair.toml"
    path.write_text(GOOD)
    robot = load_robot(path)
    assert robot.serials == ("one", "two")
    assert [p.bracket for p in robot.modules[1].link] == ["HeavyRightOutside", None]
    assert robot.network == "none"


def test_an_unknown_robot_is_answered_with_the_shipped_ones() -> None:
    with pytest.raises(FileNotFoundError, match="arm6"):
        load_robot("arm66")


@pytest.mark.parametrize(
    ("old", "new", "line", "says"),
    [
        ('mount = "wall"', "mount = wall", 5, "not TOML"),
        ('mount = "wall"', 'mount = "wall', 5, "not TOML"),
        ('noise = "ideal"', 'nose = "ideal"', 2, "nose: unknown key"),
        ('noise = "ideal"', 'noise = "quiet"', 2, "unknown noise profile 'quiet'; known are ideal, x5"),
        ('noise = "ideal"', 'network = "carrier-pigeon"', 2, "unknown network profile"),
        ('name = "pair"', 'name = "a pair"', 1, "cannot be part of a key"),
        ('mount = "wall"', 'mount = "tree"', 5, "base.mount: "),
        ('mount = "wall"', 'mount = "wall"\nrpy_deg = [0, 0, 0]', 4, "not both"),
        ('type = "X5-4"', 'type = "X5-5"', 14, "unknown module type 'X5-5'"),
        ('type = "X5-4"', 'type = "X5-4"\ncolour = "red"', 15, "module[1].colour: unknown key"),
        ('serial = "two"', 'serial = "t/w/o"', 13, "cannot be part of a key"),
        ('serial = "two"', 'serial = "base"', 13, "base's own name"),
        ('serial = "two"', 'serial = "one"', 13, "already that of module[0]"),
        ('parent = "one"', 'parent = "three"', 15, "unknown parent 'three'; known are base, one, two"),
        ('parent = "one"', 'parent = "two"', 15, "its own parent"),
        ('parent = "base"', 'parent = "two"', 10, "one -> two -> one"),
        ('parent = "one"', "", 12, "module[1].parent: is missing"),
        ("HeavyRightOutside", "HeavyMiddle", 17, "unknown bracket 'HeavyMiddle'"),
        ("length_m = 0.3", "length_m = -0.3", 18, "more than 0"),
        ("length_m = 0.3", "length_m = nan", 18, "finite"),
        ("length_m = 0.3", "lenght_m = 0.3", 18, "lenght_m: unknown key"),
        ('{ bracket = "HeavyRightOutside" }', "{ }", 16, "exactly one of: tube, bracket, pose"),
        (
            '{ bracket = "HeavyRightOutside" }',
            "{ pose = { mass_kg = 1.0, inertia = [1.0, 1.0, 3.0, 0.0, 0.0, 0.0] } }",
            17,
            "no solid",
        ),
        ('parent = "one"', 'parent = "one"\nmounted = "sideways"', 16, "module[1].mounted"),
        ('mount = "wall"', 'mount = "wall"\n[base.compliance]\nmass_kg = 1.0', 6, "every direction is rigid"),
        (
            'mount = "wall"',
            'mount = "wall"\n[base.compliance]\nstiffness_n_m = [9.0, 0, 0]\ndamping_n_s_m = [1.0, 2.0, 0.0]',
            6,
            "translation along y has a damping of 2.0 but a stiffness of 0",
        ),
        (
            'mount = "wall"',
            'mount = "wall"\n[base.compliance]\nstiffness_nm_rad = [1e4, -1.0, 0.0]',
            7,
            "base.compliance.stiffness_nm_rad[1]: ",
        ),
        (
            'mount = "wall"',
            'mount = "wall"\n[base.compliance]\nstifness_nm_rad = [1e4, 1.0, 0.0]',
            7,
            "base.compliance.stifness_nm_rad: unknown key",
        ),
        (
            'mount = "wall"',
            'mount = "wall"\n[base.compliance]\nstiffness_nm_rad = [9.0, 0, 0]\ninertia = [1, 1, 1, 0, 0, 0]',
            6,
            "an inertia needs a mass_kg",
        ),
        (
            'parent = "one"',
            'parent = "one"\nflex = { stiffness_nm_rad = [1.0, 0, 1.0], damping_nm_s_rad = [0, 3.0, 0] }',
            16,
            "rotation about y has a damping of 3.0",
        ),
        ('parent = "one"', 'parent = "one"\nflex = { stiffness_nm_rad = [1.0, inf, 1.0] }', 16, "finite"),
    ],
)
def test_a_wrong_file_is_refused_with_its_line_and_key(old: str, new: str, line: int, says: str) -> None:
    assert old in GOOD
    with pytest.raises(RobotFileError) as refusal:
        parse_robot(GOOD.replace(old, new, 1), "pair.toml")
    messages = str(refusal.value).splitlines()
    assert any(m.startswith(f"pair.toml:{line}:") and says in m for m in messages), messages


def test_every_type_of_the_catalogue_can_stand_in_a_file() -> None:
    for name in CATALOGUE:
        assert parse_robot(GOOD.replace("X5-4", name), "pair.toml").modules[1].type == name

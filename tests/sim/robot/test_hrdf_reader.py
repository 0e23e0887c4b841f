"""HRDF goes in as the robot that it describes: against our own kit arm, and against hebi-py's kinematics."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.description.hrdf_writer import write_hrdf
from module_agent.hardware import hebi_library
from module_agent.model.errors import UsageError
from module_agent.model.forward_kinematics import body_displacements
from sim.robot.hrdf_reader import read_hrdf
from sim.robot.robot_file import RobotFileError, load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia

# hebi-py calculates with 32-bit numbers where rotations are formulas.
F4 = 2e-6
# What of a simulated module turns with its output.
OUTPUT_KG = 0.03

KIT = """<robot version="1.6.0">
  <!-- The kit arm, with words as people write them. -->
  <actuator type="x5-4" tag="shoulder-yaw"/>
  <bracket type="X5HeavyRightOutside"/>
  <actuator type="X5-9" tag="shoulder-lift"/>
  <link type="X5" extension="0.65/2" twist="2*pi - (pi)"/>
  <actuator type="X5-4" tag="elbow"/>
  <link type="x5" extension="0.325" twist="pi" input="rightangle"/>
  <actuator type="X5-1" tag="wrist"/>
</robot>"""

TREE = """<robot version="1.6.0" rot="Rx(pi/2)">
  <actuator type="X5-9" tag="waist"/>
  <bracket type="x5LightLeft"/>
  <rigid-body mass="0.5" com_trans="0.05 0 0.01" com_rot="Rz(pi/2)" ixx="2e-3" iyy="1e-3" izz="2.5e-3">
    <output trans="0.1 0.05 0" rot="Rz(pi/4)*Rx(-pi/2)">
      <actuator type="X5-4" tag="left"/>
      <rigid-body mass="0.2" com_trans="0 0 0.1" ixx="1e-3" iyy="1e-3" izz="1e-4" output_trans="0 0 0.2"/>
      <end-effector type="custom" mass="0.1" com_trans="0 0 0.02" output_trans="0 0 0.04"/>
    </output>
    <output trans="0.1 -0.05 0" rot="1 0 0 0 0 1 0 -1 0">
      <link type="X5" extension="0.2" twist="pi/3"/>
      <actuator type="X5-1" tag="right"/>
    </output>
  </rigid-body>
</robot>"""


def file(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "my arm.hrdf"
    path.write_text(text)
    return path


def test_the_kit_arm_is_the_shipped_one(tmp_path: Path) -> None:
    robot, shipped = load_robot(file(tmp_path, KIT)), load_robot("a2085_04")
    assert robot.name == "my-arm"
    assert robot.serials == shipped.serials
    assert [one.type for one in robot.modules] == [one.type for one in shipped.modules]
    ours, theirs = true_chain(robot), true_chain(shipped)
    for name in ("axis", "point", "imu_home", "gravity"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-12)
    np.testing.assert_allclose(true_inertia(robot), true_inertia(shipped), atol=1e-12)


def test_branches_share_what_carries_them_and_its_mass_counts_once(tmp_path: Path) -> None:
    robot = read_hrdf(file(tmp_path, TREE))
    assert robot.serials == ("waist", "left", "right")
    assert robot.parents == (-1, 0, 0)
    masses = true_inertia(robot)[:, 0]
    own = [one.mass_kg for one in build_tree(robot).types]
    tube = 0.4 * 0.2 + 0.199
    # A forward module's housing belongs to what carries it, but for its output.
    housings = own[1] + own[2] - 2 * OUTPUT_KG
    carried = [OUTPUT_KG + 0.1 + 0.5 + tube + housings, OUTPUT_KG + 0.3, OUTPUT_KG]
    np.testing.assert_allclose(masses, carried, atol=1e-12)


def compared(hebi: Any, path: Path, robot: Any, ends: int) -> None:
    """Compare the displacement of every end from its place at q = 0 with hebi-py's, over random positions.

    A chain without an end effector, `ends` of 0, ends at its last output.
    """
    model = hebi.robot_model.import_from_hrdf(str(path))
    chain = true_chain(robot)
    rng = np.random.default_rng(3)
    base = np.asarray(model.base_frame)

    def theirs(q: Any) -> Any:
        if ends:
            return [np.asarray(f) for f in model.get_forward_kinematics("endeffector", q)]
        return [np.asarray(model.get_forward_kinematics("output", q)[-1])]

    rest = theirs(np.zeros(len(robot.serials)))
    assert len(rest) == max(ends, 1)
    up = base[:3, :3] @ (chain.gravity / np.linalg.norm(chain.gravity))
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=F4)
    leaves = [k for k in range(len(robot.serials)) if k not in robot.parents]
    for q in rng.uniform(-3.0, 3.0, (5, len(robot.serials))):
        displaced = body_displacements(chain, q[None])[0]
        for leaf, now, home in zip(leaves, theirs(q), rest, strict=True):
            # The chain's frame is that of the first module's housing, which sits on the base.
            expected = base @ displaced[leaf] @ np.linalg.inv(base)
            np.testing.assert_allclose(now @ np.linalg.inv(home), expected, atol=F4)


# The manufacturer's four-joint kit and its SCARA arm with a gripper, in the forms in which its files have
# them: no version or names, pi in decimals, and mass that is mounted on a tube.
ARM_KIT = """<robot>
  <actuator type="X5-4"/><bracket type="X5HeavyRightOutside"/>
  <actuator type="X5-9"/><link type="X5" extension="0.325" twist="3.14159265358979323846264338327950288"/>
  <actuator type="X5-4"/><link type="X5" extension="0.325" twist="3.14159265358979323846264338327950288"/>
  <actuator type="X5-1"/>
</robot>"""
SCARA = """<?xml version="1.0" encoding="UTF-8"?>
<robot version="1.2.0">
  <actuator type="X5-4"/><bracket type="X5HeavyRightOutside"/>
  <actuator type="X5-9"/><link type="X5" extension="0.325" twist="-pi/2" mass_offset="0.5"/>
  <actuator type="X5-4"/><link type="X5" extension="0.325" twist="pi"/>
  <actuator type="X5-1"/><end-effector type="X5Parallel"/>
</robot>"""
INLINE = """<robot version="1.6.0">
  <actuator type="X5-9"/><link type="X5" input="Inline" extension="0.325" twist="-pi/3"/>
  <actuator type="X5-4"/><link type="X5" output="Inline" extension="0.2" twist="pi/2"/>
  <actuator type="X5-4"/><link type="X5" input="Inline" output="Inline" extension="0.15" twist="1"/>
  <actuator type="X5-1"/><end-effector type="X5Parallel"/>
</robot>"""


WITH_ENDS = TREE.replace(
    '<actuator type="X5-1" tag="right"/>', '<actuator type="X5-1" tag="right"/><end-effector type="Custom"/>'
)


@pytest.mark.parametrize(
    ("text", "ends"),
    [
        (KIT.replace("</robot>", '<end-effector type="Custom"/></robot>'), 1),
        (WITH_ENDS, 2),
        (ARM_KIT, 0),
        (SCARA, 1),
        (INLINE, 1),
    ],
    ids=["kit", "tree", "arm kit", "SCARA", "inline"],
)
def test_hebi_py_moves_it_as_we_do_before_and_after_our_writer(tmp_path: Path, text: str, ends: int) -> None:
    try:
        hebi: Any = hebi_library.library()
    except UsageError:
        pytest.skip("hebi-py is not installed")
    path = file(tmp_path, text)
    robot = read_hrdf(path)
    compared(hebi, path, robot, ends)
    model = hebi.robot_model.import_from_hrdf(str(path))
    # The first housing stands on the base, and its output moves.
    standing = build_tree(robot).types[0].mass_kg - OUTPUT_KG
    assert np.sum(model.masses) == pytest.approx(true_inertia(robot)[:, 0].sum() + standing, rel=1e-5)
    chain, types = true_chain(robot), build_tree(robot).types
    write_hrdf(tmp_path / "again.hrdf", chain, types)
    compared(hebi, tmp_path / "again.hrdf", robot, ends)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot><actuator type='X8-9'/></robot>", "<actuator> of type 'X8-9'; known are X5-1"),
        ("<robot><actuator type='X5-9' mass='0'/></robot>", "a module's mass is its type's"),
        ("<robot><actuator type='X5-9' tag='a'/><actuator type='X5-9' tag='a'/></robot>", "the tag 'a'"),
        ("<robot><joint axis='rz'/></robot>", "<joint> is not known"),
        ("<robot><link type='X5' extension='1+' twist='0'/></robot>", "extension '1+' is no number"),
        ("<robot><link type='X5' extension='__import__(1)' twist='0'/></robot>", "is no number or formula"),
        (
            "<robot><link type='X5' extension='.3' twist='0' output='Up'/></robot>",
            "known are RightAngle, Inline",
        ),
        (
            "<robot><link type='X5' extension='-1' twist='0'/></robot>",
            "<link>: extension: expected more than 0, found -1.0",
        ),
        ("<robot><bracket type='X5LightLeft' mass_offset='-0.1'/></robot>", "expected at least 0"),
        ("<robot><end-effector type='X5Parallel' mass='1'/></robot>", "which only those of type Custom have"),
        ("<robot><bracket type='X9'/></robot>", "<bracket> of type 'X9'; known are X5LightRight"),
        ("<robot><rigid-body mass='1' output_rot='1 0 0'/></robot>", "is no rotation"),
        ("<robot rot='1 0 0 0 1 0 0 0 -1'><actuator type='X5-9'/></robot>", "is no rotation"),
        ("<robot><link type='X5' extension='Rx(pi)' twist='0'/></robot>", "is a rotation, not a number"),
        ("<robot><rigid-body mass='1' output_trans='1 0'/></robot>", "has 2 numbers, not 3"),
        ("<robot><rigid-body mass='-1'/></robot>", "expected at least 0"),
        ("<robot><end-effector type='R8Parallel'/></robot>", "known are Custom, X5Parallel"),
        ("<robot/>", "it has no actuator"),
        ("<urdf/>", "its root is <urdf>"),
        ("<robot>", "no HRDF can be read"),
    ],
)
def test_what_the_simulator_has_not_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = file(tmp_path, text)
    with pytest.raises(RobotFileError) as error:
        read_hrdf(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)

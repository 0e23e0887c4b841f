"""An SRDF next to the URDF: planners load the two without edits, and begin at zero without a collision."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from coordinator.description.srdf_writer import UncheckedPair, unchecked_pairs, write_srdf
from coordinator.description.urdf_reader import read_urdf
from coordinator.description.urdf_shapes import read_shapes
from coordinator.description.urdf_writer import write_urdf
from module_agent.model.chain import Chain
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia

# All turn about z of the base, one on the other: `b` is about the base's ball, `c`, `d` and `e` go around it.
STEM = """<robot name="stem"><link name="base">{ball}</link><link name="body_a"/>
<link name="body_b">{ball}</link><link name="body_c">{near}</link><link name="body_d">{near}</link>
<link name="body_e">{aside}</link>{joints}</robot>"""
SHAPE = '<collision><origin xyz="{}"/><geometry><sphere radius="{}"/></geometry></collision>'
JOINT = """<joint name="joint_{child}" type="continuous"><parent link="{parent}"/><child link="body_{child}"/>
<axis xyz="0 0 1"/></joint>"""


def stem(path: Path) -> Path:
    turns = (("base", "a"), ("body_a", "b"), ("body_b", "c"), ("body_a", "d"), ("body_a", "e"))
    path.write_text(
        STEM.format(
            ball=SHAPE.format("0 0 0", 0.1),
            near=SHAPE.format("0.3 0 0", 0.05),
            aside=SHAPE.format("0 0.3 0", 0.05),
            joints="".join(JOINT.format(parent=parent, child=child) for parent, child in turns),
        )
    )
    return path


def written(name: str, folder: Path) -> tuple[Path, Path, Chain]:
    robot = load_robot(name)
    chain, urdf, srdf = true_chain(robot), folder / "robot.urdf", folder / "robot.srdf"
    write_urdf(urdf, chain, true_inertia(robot), name, build_tree(robot).types)
    write_srdf(srdf, urdf)
    return urdf, srdf, chain


class Planner:
    """What pinocchio makes of the two files, with all pairs that are left to be checked."""

    def __init__(self, urdf: Path, srdf: Path):
        self.model = pin.buildModelFromUrdf(str(urdf))
        self.shapes = pin.buildGeomFromUrdf(self.model, str(urdf), pin.GeometryType.COLLISION)
        self.shapes.addAllCollisionPairs()
        self.all = self.names()
        pin.removeCollisionPairs(self.model, self.shapes, str(srdf))
        pin.loadReferenceConfigurations(self.model, str(srdf))

    def names(self) -> set[frozenset[str]]:
        """The links of all pairs of shapes that are checked."""
        frames = [self.model.frames[shape.parentFrame].name for shape in self.shapes.geometryObjects]
        return {frozenset((frames[pair.first], frames[pair.second])) for pair in self.shapes.collisionPairs}

    def touches(self, q: np.ndarray) -> bool:
        data = pin.GeometryData(self.shapes)
        return bool(pin.computeCollisions(self.model, self.model.createData(), self.shapes, data, q, True))


@pytest.mark.parametrize("name", ["a2085_04", "tree_y", "snake16"])
def test_a_planner_loads_both_files_and_is_clear_of_itself_at_zero(name: str, tmp_path: Path) -> None:
    urdf, srdf, chain = written(name, tmp_path)
    planner, document = Planner(urdf, srdf), ElementTree.parse(srdf).getroot()
    zero = planner.model.referenceConfigurations["zero"]
    np.testing.assert_allclose(zero, pin.neutral(planner.model), atol=1e-12)
    assert not planner.touches(zero)
    disabled = {
        frozenset((pair.get("link1"), pair.get("link2"))) for pair in document.iter("disable_collisions")
    }
    # Pairs within one link are none of the planner's.
    assert {pair for pair in planner.all if len(pair) == 2} - planner.names() <= disabled
    assert not disabled & planner.names()
    # What is left to check is worth it: most pairs come near each other somewhere.
    assert len(planner.names()) > 0
    assert document.get("name") == ElementTree.parse(urdf).getroot().get("name")
    tips = [chain_.get("tip_link") for chain_ in document.iter("chain")]
    assert tips == [f"tip_{chain.serials[k]}" for k in chain.leaves]
    assert all(planner.model.existFrame(tip) for tip in tips)


@pytest.mark.parametrize("name", ["a2085_04", "tree_y"])
def test_what_is_not_checked_never_touches(name: str, tmp_path: Path) -> None:
    """By another implementation of distances, and at other positions than those that were drawn."""
    urdf, srdf, _ = written(name, tmp_path)
    never = {
        frozenset((pair.get("link1"), pair.get("link2")))
        for pair in ElementTree.parse(srdf).getroot().iter("disable_collisions")
        if pair.get("reason") == "Never"
    }
    planner, whole = Planner(urdf, srdf), Planner(urdf, srdf)
    frames = [planner.model.frames[shape.parentFrame].name for shape in planner.shapes.geometryObjects]
    whole.shapes.removeAllCollisionPairs()
    for i in range(len(frames)):
        for k in range(i):
            if frozenset((frames[i], frames[k])) in never:
                whole.shapes.addCollisionPair(pin.CollisionPair(k, i))
    pin.seed(4)
    touching = [pin.randomConfiguration(planner.model) for _ in range(300)]
    assert not any(whole.touches(q) for q in touching)
    # These positions are no empty test: elsewhere arms do touch themselves.
    assert any(planner.touches(q) for q in touching)


def test_pairs_that_touch_always_at_zero_or_never_are_told_from_those_that_may(tmp_path: Path) -> None:
    robot = read_urdf(stem(tmp_path / "stem.urdf"))
    found = unchecked_pairs(robot, read_shapes(robot))
    assert set(found) == {
        UncheckedPair("base", "body_a", "Adjacent"),
        *(UncheckedPair("body_a", f"body_{other}", "Adjacent") for other in "bde"),
        UncheckedPair("body_b", "body_c", "Adjacent"),
        UncheckedPair("base", "body_b", "Always"),
        UncheckedPair("body_c", "body_d", "Default"),
        # The rings of radius 0.3 m stay 0.15 m off the balls in the middle.
        *(UncheckedPair("base", f"body_{other}", "Never") for other in "cde"),
        *(UncheckedPair("body_b", f"body_{other}", "Never") for other in "de"),
    }


def test_nothing_is_said_of_two_trees_whose_places_are_not_known(tmp_path: Path) -> None:
    text = stem(tmp_path / "stem.urdf").read_text()
    (tmp_path / "two.urdf").write_text(
        text.replace(
            '<parent link="body_a"/><child link="body_d"/>', '<parent link="base"/><child link="body_d"/>'
        )
    )
    robot = read_urdf(tmp_path / "two.urdf")
    found = unchecked_pairs(robot, read_shapes(robot))
    assert {pair.reason for pair in found if "body_d" in (pair.one, pair.other)} == {"Adjacent"}
    assert not any(pair.reason != "Adjacent" and "base" in (pair.one, pair.other) for pair in found)
    write_srdf(tmp_path / "two.srdf", tmp_path / "two.urdf")
    groups = [group.get("name") for group in ElementTree.parse(tmp_path / "two.srdf").getroot().iter("group")]
    assert groups == ["arm_c", "arm_d", "arm_e"]

"""Errors of a link are those that a known change of its chain makes, and none that no sensor could see."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from module_agent.model.chain import Chain
from module_agent.model.perturbation import apply_perturbation
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.scoring.chain_score import LinkErrors, link_errors, link_length_m
from sim.scoring.gauge_alignment import reorder

TRUTH = true_chain(load_robot("thesis_350_horizontal"))
CHILD = 1
NONE = LinkErrors(0.0, 0.0, 0.0)


def moved(twist: np.ndarray) -> Chain:
    """The truth with its second module moved by a twist [turn, shift] in the root frame."""
    return apply_perturbation(TRUTH, np.concatenate([np.zeros(6), twist]))


def turned_about_axis(angle_rad: float) -> np.ndarray:
    """A turn of the second module about the first one's axis, which no circle can tell from none."""
    axis, point = TRUTH.axis[0], TRUTH.point[0]
    return angle_rad * np.concatenate([axis, np.cross(point, axis)])


def test_the_truth_has_no_errors() -> None:
    assert link_errors(TRUTH, TRUTH, CHILD) == pytest.approx(NONE, abs=1e-9)


def test_what_a_circle_cannot_tell_is_no_error_of_a_link() -> None:
    along = np.concatenate([np.zeros(3), 0.05 * TRUTH.axis[0]])
    for twist in (along, turned_about_axis(0.7)):
        assert link_errors(moved(twist), TRUTH, CHILD) == pytest.approx(NONE, abs=1e-6)


def test_a_link_that_is_longer_by_2_mm_is_off_by_2_mm_in_length_and_vector() -> None:
    arm = TRUTH.imu_home[CHILD, :3, 3] - TRUTH.point[0]
    outward = arm - TRUTH.axis[0] * (TRUTH.axis[0] @ arm)
    longer = moved(np.concatenate([np.zeros(3), 2e-3 * outward / np.linalg.norm(outward)]))
    found = link_errors(longer, TRUTH, CHILD)
    assert found == pytest.approx(LinkErrors(2e-3, 2e-3, 0.0), abs=1e-8)


def test_an_imu_askew_in_its_place_sees_axis_and_vector_turned_but_no_other_length() -> None:
    home = TRUTH.imu_home.copy()
    home[CHILD, :3, :3] = home[CHILD, :3, :3] @ Rotation.from_rotvec([0.0, 0.0, 0.01]).as_matrix()
    found = link_errors(TRUTH._replace(imu_home=home), TRUTH, CHILD)
    assert found is not None
    assert found.length_m == pytest.approx(0.0, abs=1e-12)
    own_z = TRUTH.imu_home[CHILD, :3, 2]
    # Turned about the IMU's own z: what lies across it is off by 0.01 rad times its size.
    arm = TRUTH.imu_home[CHILD, :3, 3] - TRUTH.point[0]
    vector = arm - TRUTH.axis[0] * (TRUTH.axis[0] @ arm)
    assert found.vector_m == pytest.approx(0.01 * np.linalg.norm(np.cross(own_z, vector)), rel=1e-3, abs=1e-9)
    tilt = 0.01 * np.linalg.norm(np.cross(own_z, TRUTH.axis[0]))
    assert found.axis_deg == pytest.approx(np.degrees(tilt), rel=1e-3, abs=1e-9)


def test_a_link_that_was_not_found_has_no_errors_to_tell() -> None:
    tree = true_chain(load_robot("tree_y"))
    child = tree.serials.index("left-2")
    other = tree.serials.index("right-1")
    wrong = tree._replace(parent=tuple(other if k == child else p for k, p in enumerate(tree.parent)))
    assert link_errors(wrong, tree, child) is None
    assert link_errors(tree, tree, child) == pytest.approx(NONE, abs=1e-9)


def test_modules_are_matched_by_serial() -> None:
    tree = true_chain(load_robot("tree_y"))
    shuffled = reorder(tree, ("root", "right-1", "left-1", "left-2", "right-2", "left-3"))
    for child, parent in enumerate(tree.parent):
        if parent >= 0:
            assert link_errors(shuffled, tree, child) == pytest.approx(NONE, abs=1e-9)


def test_the_arms_length_is_the_one_it_is_named_after() -> None:
    # The name is that of the thesis, which measured to the nearest millimetre.
    assert 1e3 * link_length_m(TRUTH, CHILD) == pytest.approx(350.0, abs=1.0)

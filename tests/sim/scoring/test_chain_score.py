"""Errors of a link are those that a known change of its chain makes, and none that no sensor could see."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from module_agent.model.chain import Chain
from module_agent.model.perturbation import apply_perturbation
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.scoring.chain_score import (
    LinkErrors,
    gravity_error_deg,
    link_errors,
    link_length_m,
    link_spread,
    tip_errors,
    tip_spread,
)
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


def test_the_spread_of_a_link_is_what_the_covariance_says_in_the_direction_of_its_error() -> None:
    """An error outward, where the place is known to 2 mm, and one across, where it is known to 30."""
    arm = TRUTH.imu_home[CHILD, :3, 3] - TRUTH.point[0]
    outward = arm - TRUTH.axis[0] * (TRUTH.axis[0] @ arm)
    outward /= np.linalg.norm(outward)
    across = np.cross(TRUTH.axis[0], outward)
    covariance = np.zeros((12, 12))
    covariance[9:, 9:] = 0.002**2 * np.outer(outward, outward) + 0.03**2 * np.outer(across, across)
    for direction, sigma_m in ((outward, 0.002), (across, 0.03)):
        off = moved(np.r_[np.zeros(3), 1e-4 * direction])
        spread = link_spread(off, TRUTH, CHILD, covariance)
        assert spread is not None
        assert spread.vector_m == pytest.approx(sigma_m, rel=1e-2)
        assert spread.axis_deg == pytest.approx(0.0, abs=1e-9)


def test_errors_drawn_from_a_covariance_are_as_large_as_its_spread() -> None:
    rng = np.random.default_rng(4)
    root = np.zeros((12, 6))
    root[6:] = rng.normal(size=(6, 6)) * np.r_[[4e-3] * 3, [1e-3] * 3][:, None]
    covariance, nothing = root @ root.T, np.zeros((12, 0))
    chains = [apply_perturbation(TRUTH, root @ rng.normal(size=6)) for _ in range(60)]
    ratios = []
    for chain in chains:
        errors, spread = link_errors(chain, TRUTH, CHILD), link_spread(chain, TRUTH, CHILD, covariance)
        assert errors is not None
        assert spread is not None
        ratios.append((errors.vector_m / spread.vector_m, errors.axis_deg / spread.axis_deg))
    # Its direction is mostly that in which it spreads most, so that it has one to two degrees of freedom.
    assert np.all(np.sqrt(np.mean(np.square(ratios), axis=0)) == pytest.approx(1.15, abs=0.35))
    tips = np.sqrt(np.mean(np.square([tip_errors(chain, TRUTH, nothing) for chain in chains]), axis=0))
    position_m, orientation_deg = tip_spread(TRUTH, covariance, nothing)
    assert tips == pytest.approx([1e3 * position_m, orientation_deg], rel=0.2)


def test_gravity_is_off_by_the_angle_between_its_directions_whatever_its_size() -> None:
    turned = Rotation.from_rotvec(np.radians(3.0) * np.cross(TRUTH.gravity, [0.6, 0.0, 0.8]) / 9.8)
    angle = np.degrees(turned.magnitude())
    assert gravity_error_deg(TRUTH, TRUTH) == pytest.approx(0.0, abs=1e-9)
    off = TRUTH._replace(gravity=0.9 * turned.as_matrix() @ TRUTH.gravity)
    assert gravity_error_deg(off, TRUTH) == pytest.approx(angle)
    assert gravity_error_deg(TRUTH._replace(serials=("another", TRUTH.serials[1])), TRUTH) is None

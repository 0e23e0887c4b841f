"""Modules differ from their types as drawn; robots stand anywhere on the Earth and feel its gravity."""

import numpy as np
import pytest

from module_agent.model.catalogue import GRAVITY_M_S2, GRAVITY_SIGMA_M_S2, module_type
from module_agent.model.chain import Chain
from sim.imperfections.noise_profile import noise_profile, switched
from sim.robot.robot_file import Build, load_robot
from sim.robot.robot_tree import build_tree, sensing_chain, true_chain, true_inertia
from sim.robot.variants import MAX_M_S2, MIN_M_S2, as_built, at_random_site
from sim.world.world import World


def test_what_is_believed_of_gravity_is_how_it_is_drawn() -> None:
    robot = load_robot("thesis_245_horizontal")
    drawn = np.array([at_random_site(robot, seed).base.gravity_m_s2 for seed in range(400)])
    assert MIN_M_S2 <= drawn.min() < drawn.max() <= MAX_M_S2
    # A uniform distribution's: 400 draws tell the mean to a twentieth of its sigma, and sigma to 4 %.
    np.testing.assert_allclose(drawn.mean(), GRAVITY_M_S2, atol=0.2 * GRAVITY_SIGMA_M_S2)
    np.testing.assert_allclose(drawn.std(), GRAVITY_SIGMA_M_S2, rtol=0.1)


BUILD = switched(
    noise_profile("x5"), on=("imu-place", "imu-mounting", "body-mass", "body-centre", "housing-axis")
)


def test_modules_are_built_as_their_seed_has_them_and_as_catalogued_without_the_effects() -> None:
    robot = load_robot("a2085_04")
    assert as_built(robot, 3, BUILD) == as_built(as_built(robot, 3, BUILD), 4, BUILD)
    assert as_built(robot, 3, BUILD) != as_built(robot, 4, BUILD)
    # A module is the same in every assembly.
    fewer = robot.model_copy(update={"modules": robot.modules[:2]})
    assert as_built(fewer, 3, BUILD).modules == as_built(robot, 3, BUILD).modules[:2]
    plain, ideal = build_tree(robot), build_tree(as_built(robot, 3, "ideal"))
    np.testing.assert_array_equal(plain.imu_home, ideal.imu_home)
    np.testing.assert_array_equal(true_inertia(robot), true_inertia(as_built(robot, 3, "ideal")))


def test_what_is_drawn_is_as_large_as_the_profile_has_it() -> None:
    robot, profile = load_robot("arm6"), BUILD
    builds = [module.build for seed in range(60) for module in as_built(robot, seed, BUILD).modules]
    # 360 modules of three axes: the scatter is known to 2 %, that of two axes to 3 %, of masses to 4 %.
    for field, sigma, axes in (
        ("imu_xyz_m", profile.imu_place_m, 3),
        ("imu_turn_rad", profile.imu_mounting_rad, 3),
        ("axis_xyz_m", profile.housing_axis_m, 2),
        ("axis_turn_rad", profile.housing_axis_rad, 2),
        ("com_xyz_m", profile.body_centre_m, 3),
    ):
        drawn = np.array([getattr(build, field) for build in builds])[:, :axes]
        np.testing.assert_allclose(drawn.std(), sigma, rtol=0.1)
    masses = np.array([build.mass_factor for build in builds if build is not None])
    np.testing.assert_allclose(masses.std(), profile.body_mass, rtol=0.15)


def test_the_truth_is_where_the_axes_are_and_not_where_the_imus_sit() -> None:
    robot = load_robot("a2085_04")
    build = Build(imu_xyz_m=(0.003, -0.002, 0.001), imu_turn_rad=(0.01, 0.0, 0.0), mass_factor=1.1)
    moved = robot.model_copy(
        update={
            "modules": (
                *robot.modules[:2],
                robot.modules[2].model_copy(update={"build": build}),
                robot.modules[3],
            )
        }
    )
    for name, before, after in zip(Chain._fields, true_chain(robot), true_chain(moved), strict=True):
        np.testing.assert_array_equal(before, after, err_msg=name)
    there, here = build_tree(moved).imu_home[2], build_tree(robot).imu_home[2]
    np.testing.assert_allclose((np.linalg.inv(here) @ there)[:3, 3], build.imu_xyz_m, atol=1e-15)
    catalogued, sensing = true_chain(moved).imu_home, sensing_chain(moved).imu_home
    np.testing.assert_allclose(
        (np.linalg.inv(catalogued[2]) @ sensing[2])[:3, 3], build.imu_xyz_m, atol=1e-15
    )
    np.testing.assert_allclose(sensing[[0, 1, 3]], catalogued[[0, 1, 3]], atol=1e-15)
    # The third module's body of 0.3 kg weighs a tenth more, wherever it is.
    heavier = true_inertia(moved)[:, 0] - true_inertia(robot)[:, 0]
    assert heavier.sum() == pytest.approx(0.1 * module_type(robot.modules[2].type).mass_kg, rel=1e-9)
    tilted = Build(axis_xyz_m=(0.001, 0.0, 0.0), axis_turn_rad=(0.0, 0.002, 0.0))
    changed = robot.model_copy(
        update={
            "modules": (
                *robot.modules[:2],
                robot.modules[2].model_copy(update={"build": tilted}),
                robot.modules[3],
            )
        }
    )
    turned = np.degrees(np.arccos(np.sum(true_chain(changed).axis * true_chain(robot).axis, axis=1)))
    # Its IMU stays where it is on its housing, of which the chain has the axis only.
    displaced = np.linalg.inv(true_chain(changed).imu_home[2]) @ sensing_chain(changed).imu_home[2]
    assert np.linalg.norm(displaced[:3, 3]) == pytest.approx(0.001, abs=2e-4)
    # Its own axis turns against those before it; the last module turns along with it.
    np.testing.assert_allclose(turned, np.degrees([0.0, 0.0, 0.002, 0.002]), atol=1e-6)


def test_the_same_seed_stands_at_the_same_place_and_feels_it() -> None:
    robot = at_random_site(load_robot("thesis_245_horizontal"), 5)
    assert robot == at_random_site(load_robot("thesis_245_horizontal"), 5)
    world = World(robot, seed=1, noise="ideal")
    for _ in range(200):
        samples = world.step([0.0, 0.0])
    world.close()
    still = samples[0]
    felt = float(np.linalg.norm([still.accel_x_m_s2, still.accel_y_m_s2, still.accel_z_m_s2]))
    # An ideal IMU counts in steps and on a fixed base that is all.
    assert abs(felt - robot.base.gravity_m_s2) < 1e-3

"""The world against an independent implementation of rigid-body dynamics."""

from typing import Any

import numpy as np
import pinocchio
import pytest

from module_agent.hardware.hardware import SensorSample
from module_agent.model.forward_kinematics import imu_poses
from sim.geometry.pose import Array, inverse
from sim.geometry.rigid_body import RigidBody, parameters
from sim.physics.rigid_tree import RigidTree
from sim.physics.skeleton import build_skeleton
from sim.physics.skeleton_urdf import urdf_text
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import build_tree, true_chain, true_inertia
from sim.robot.variants import at_random_site
from sim.world.world import World

ROBOTS = ["arm6", "tree_y", "a2085_04"]


class Reference:
    """The robot in Pinocchio, its joints in the robot's order."""

    def __init__(self, robot: Robot):
        self.tree = build_tree(robot)
        self.skeleton = build_skeleton(robot)
        self.model = pinocchio.buildModelFromXML(urdf_text(robot.name, self.skeleton))
        self.data = self.model.createData()
        self.model.gravity.linear[:] = [0.0, 0.0, -self.tree.gravity_m_s2]
        self.ids = [self.model.getJointId(f"joint-{s}") for s in self.tree.serials]
        self.rows = [self.model.joints[i].idx_v for i in self.ids]

    def configuration(self, q: Array) -> Array:
        # A continuous joint is (cos q, sin q) there.
        full = np.zeros(self.model.nq)
        for i, angle in zip(self.ids, q, strict=True):
            at = self.model.joints[i].idx_q
            full[at : at + 2] = np.cos(angle), np.sin(angle)
        return full

    def ordered(self, values: Array) -> Array:
        full = np.zeros(self.model.nv)
        full[self.rows] = values
        return full

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        args = self.configuration(q), self.ordered(qd), self.ordered(qdd)
        return np.array(pinocchio.rnea(self.model, self.data, *args))[self.rows]

    def imu(self, i: int) -> tuple[Any, int]:
        pose, body = self.skeleton.imu_pose[i], self.skeleton.imu_body[i]
        return pinocchio.SE3(pose[:3, :3], pose[:3, 3]), self.ids[body] if body >= 0 else 0

    def felt(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Gyro and specific force of every IMU, (n, 6)."""
        args = self.configuration(q), self.ordered(qd), self.ordered(qdd)
        pinocchio.forwardKinematics(self.model, self.data, *args)
        rows = []
        for i in range(len(self.ids)):
            placement, joint = self.imu(i)
            rate = placement.actInv(self.data.v[joint])
            change = placement.actInv(self.data.a[joint])
            rotation = (self.data.oMi[joint] * placement).rotation
            force = (
                change.linear
                + np.cross(rate.angular, rate.linear)
                + rotation.T @ [0.0, 0.0, self.tree.gravity_m_s2]
            )
            rows.append(np.concatenate([rate.angular, force]))
        return np.array(rows)


def _read(samples: list[SensorSample]) -> Array:
    return np.array([s[-7:-1] for s in samples])


def _moving(world: World, ticks: int, amplitude: float) -> Any:
    phase = np.random.default_rng(5).uniform(0.0, 6.0, len(world.modules))
    for k in range(ticks):
        samples = world.step(list(amplitude * np.sin(2.0 * np.pi * k * 1e-3 + phase)))
        if k % 4 == 0:
            yield samples, world.plant


@pytest.mark.parametrize("name", [*ROBOTS, "snake16"])
def test_moving_imus_feel_what_newton_and_euler_say(name: str) -> None:
    robot = at_random_site(load_robot(name), 4)
    reference, world = Reference(robot), World(robot, seed=1, noise="ideal")
    errors = [
        _read(samples) - reference.felt(plant.q_rad, plant.qd_rad_s, plant.qdd_rad_s2)
        for samples, plant in _moving(world, 400, 0.2)
    ]
    rms = np.sqrt(np.mean(np.square(errors), axis=(0, 1)))
    world.close()
    # Both evaluate the same state, so only rounding remains.
    assert rms[:3].max() < 1e-12
    assert rms[3:].max() < 1e-11


@pytest.mark.parametrize("name", ROBOTS)
def test_the_springs_exert_what_the_motion_needs(name: str) -> None:
    robot = at_random_site(load_robot(name), 4)
    reference, world = Reference(robot), World(robot, seed=1, noise="ideal")
    errors, torques = [], []
    for _, plant in _moving(world, 600, 0.15):
        needed = reference.torque(plant.q_rad, plant.qd_rad_s, plant.qdd_rad_s2)
        errors.append(needed - plant.spring_torque_nm)
        torques.append(needed)
    world.close()
    # Measured at most 3e-6: velocity forces are of the same instant but for a prediction of second order.
    assert np.sqrt(np.mean(np.square(errors))) < 1e-5 * np.sqrt(np.mean(np.square(torques)))


@pytest.mark.parametrize("name", [*ROBOTS, "snake16"])
def test_the_compiled_equations_have_the_same_mass_matrix_and_bias(name: str) -> None:
    robot = at_random_site(load_robot(name), 4)
    reference = Reference(robot)
    rng = np.random.default_rng(2)
    n = len(robot.modules)
    q, qd = rng.uniform(-2.0, 2.0, n), rng.uniform(-2.0, 2.0, n)
    zero = np.zeros(n)
    columns = [reference.torque(q, zero, e) - reference.torque(q, zero, zero) for e in np.eye(n)]
    mass, bias = RigidTree(reference.skeleton).mass_and_bias(q, qd)
    np.testing.assert_allclose(mass, np.array(columns).T, atol=1e-12)
    np.testing.assert_allclose(bias, reference.torque(q, qd, zero), atol=1e-10)


@pytest.mark.parametrize("name", [*ROBOTS, "snake16"])
def test_the_true_chain_puts_every_imu_where_the_physics_has_it(name: str) -> None:
    robot = at_random_site(load_robot(name), 4)
    reference, chain = Reference(robot), true_chain(robot)
    to_root = inverse(reference.tree.housing[0])
    q = np.random.default_rng(4).uniform(-2.0, 2.0, (3, len(robot.modules)))
    found = imu_poses(chain, q)
    for row, pose in zip(q, found, strict=True):
        pinocchio.forwardKinematics(reference.model, reference.data, reference.configuration(row))
        for i in range(len(row)):
            placement, joint = reference.imu(i)
            wanted = to_root @ (reference.data.oMi[joint] * placement).homogeneous
            np.testing.assert_allclose(pose[i], wanted, atol=1e-12)


@pytest.mark.parametrize("name", [*ROBOTS, "snake16"])
def test_the_true_inertia_is_that_of_the_physics_at_home(name: str) -> None:
    robot = at_random_site(load_robot(name), 4)
    reference = Reference(robot)
    to_root = inverse(reference.tree.housing[0])
    shift = pinocchio.SE3(to_root[:3, :3], to_root[:3, 3])
    home = reference.configuration(np.zeros(len(robot.modules)))
    pinocchio.forwardKinematics(reference.model, reference.data, home)
    for row, joint in zip(true_inertia(robot), reference.ids, strict=True):
        body = (shift * reference.data.oMi[joint]).act(reference.model.inertias[joint])
        wanted = parameters(RigidBody(body.mass, body.lever, body.inertia))
        np.testing.assert_allclose(row, wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_world_begins_with_its_springs_carrying_the_weight(name: str) -> None:
    robot = at_random_site(load_robot(name), 4)
    reference, world = Reference(robot), World(robot, seed=1, noise="ideal")
    zero = np.zeros(len(robot.modules))
    samples = world.step(list(zero))
    world.close()
    np.testing.assert_allclose(
        [s.effort_nm for s in samples], reference.torque(robot.start_rad, zero, zero), atol=1e-12
    )
    # Unpowered motors begin to give way; with slack springs the arms would fall at 10 rad/s^2 and more.
    assert np.abs(world.plant.qdd_rad_s2).max() < 1.0

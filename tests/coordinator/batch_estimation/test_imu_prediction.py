"""IMU readings agree with pinocchio's frame velocities and classical accelerations on random trees."""

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from coordinator.batch_estimation.imu_prediction import imu_readings
from module_agent.model.chain import Array, Chain
from module_agent.model.forward_kinematics import imu_poses


class Reference:
    """The same robot in pinocchio: joint frames parallel to the root frame at q = 0, origins on the axes."""

    def __init__(self, chain: Chain):
        self.model = pin.Model()
        self.gravity = chain.gravity
        joints: list[int] = []
        for i, parent in enumerate(chain.parent):
            below = np.zeros(3) if parent < 0 else chain.point[parent]
            joint = pin.JointModelRevoluteUnaligned(chain.axis[i])
            place = pin.SE3(np.eye(3), chain.point[i] - below)
            joints.append(
                self.model.addJoint(0 if parent < 0 else joints[parent], joint, place, chain.serials[i])
            )
        self.frames: list[int] = []
        for k, home in enumerate(chain.imu_home):
            body = chain.carrier(k)
            origin = np.zeros(3) if body < 0 else chain.point[body]
            place = pin.SE3(home[:3, :3], home[:3, 3] - origin)
            joint_id = 0 if body < 0 else joints[body]
            frame = pin.Frame(f"imu{k}", joint_id, 0, place, pin.FrameType.OP_FRAME)
            self.frames.append(self.model.addFrame(frame))
        self.data = self.model.createData()

    def read(self, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
        """Gyros and specific forces of one sample, (n, 3) each."""
        pin.forwardKinematics(self.model, self.data, q, qd, qdd)
        pin.updateFramePlacements(self.model, self.data)
        gyro, accel = [], []
        for frame in self.frames:
            turn = self.data.oMf[frame].rotation
            gyro.append(pin.getFrameVelocity(self.model, self.data, frame, pin.LOCAL).angular)
            moved = pin.getFrameClassicalAcceleration(self.model, self.data, frame, pin.LOCAL).linear
            accel.append(moved + turn.T @ self.gravity)
        return np.array(gyro), np.array(accel)


@pytest.mark.parametrize("seed", range(8))
def test_imus_of_random_trees_read_what_pinocchio_says(robots: Any, seed: int) -> None:
    chain, _ = robots.random(seed, joints=1 + seed, roots=1 + seed // 6)
    rng = np.random.default_rng(100 + seed)
    q, qd, qdd = rng.uniform(-3, 3, (3, 15, len(chain.serials)))
    reference = Reference(chain)
    found = imu_readings(chain, q, qd, 5 * qdd)
    for sample in range(15):
        gyro, accel = reference.read(q[sample], qd[sample], 5 * qdd[sample])
        # Both evaluate one formula in another order: rounding of readings of up to 100 m/s^2.
        np.testing.assert_allclose(found.gyro_rad_s[sample], gyro, atol=1e-12)
        np.testing.assert_allclose(found.accel_m_s2[sample], accel, atol=1e-11)


def test_the_random_trees_hold_modules_of_both_mountings(robots: Any) -> None:
    mounted = [r for seed in range(8) for r in robots.random(seed, joints=1 + seed)[0].reversed]
    assert {True, False} == set(mounted)


@pytest.mark.parametrize("seed", range(4))
def test_readings_are_the_derivatives_of_the_imus_own_path(robots: Any, seed: int) -> None:
    chain, _ = robots.random(20 + seed, joints=4)
    rng = np.random.default_rng(seed)
    size, phase = rng.uniform(0.2, 1.0, 4), rng.uniform(0, 6, 4)
    step = 1e-4
    t = np.arange(-2, 3)[:, None] * step

    def path(at: Array) -> Array:
        return np.asarray(size * np.sin(2.0 * at + phase))

    poses = imu_poses(chain, path(t))
    # Fourth-order central differences of positions: rounding 1e-16 / 1e-8 = 1e-8, truncation below it.
    weights = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / (12 * step**2)
    moved = np.einsum("s,skj->kj", weights, poses[:, :, :3, 3])
    read = np.einsum("kji,kj->ki", poses[2, :, :3, :3], moved + chain.gravity)
    now = np.zeros((1, 1))
    found = imu_readings(
        chain, path(now), 2.0 * size * np.cos(2.0 * now + phase), -4.0 * size * np.sin(2.0 * now + phase)
    )
    np.testing.assert_allclose(found.accel_m_s2[0], read, atol=1e-6)


def test_at_rest_every_imu_reads_gravity_turned_into_its_frame(robots: Any) -> None:
    chain, _ = robots.random(3, joints=6)
    q = np.random.default_rng(3).uniform(-3, 3, (4, 6))
    still = np.zeros_like(q)
    found = imu_readings(chain, q, still, still)
    turns = imu_poses(chain, q)[..., :3, :3]
    np.testing.assert_array_equal(found.gyro_rad_s, 0.0)
    np.testing.assert_allclose(found.accel_m_s2, np.einsum("mkji,j->mki", turns, chain.gravity), atol=1e-12)


def test_a_module_that_is_mounted_by_its_housing_does_not_feel_its_own_joint(robots: Any) -> None:
    chain, _ = robots.random(5, joints=6)
    q, qd = np.zeros((1, 6)), np.zeros((1, 6))
    for k in range(6):
        spun = imu_readings(chain, q, qd + np.eye(6)[k], np.eye(6)[[k]])
        read = float(np.abs(spun.gyro_rad_s[0, k]).max())
        assert (read > 0.1) == chain.reversed[k]

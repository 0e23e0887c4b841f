"""The shake under a joint, on drawn samples of the IMU in the joint's own housing."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from module_agent.estimate.base_shake import ACCELERATION, FORCE, RATE, BaseMotion
from module_agent.estimate.windows import ImuWindow, JointWindow

T_S = np.arange(0.0, 5.6, 0.004)
T_NS = (1e9 * T_S).astype(np.int64)
WINDOW = np.exp(-0.5 * (T_S - 2.8) ** 2)
ANGLE = 0.4 + 0.2 * WINDOW * np.sin(4 * np.pi * T_S)
SPEED = np.gradient(ANGLE, T_S)
STILL = np.array([0.01, -0.02, 0.03, 2.0, 9.0, 1.0])


def housing(shake: float, seed: int = 0, swing: float = 0.0) -> BaseMotion:
    """A housing that is pushed along x and swings by shares of the joint's motion, and feels its gears."""
    rng = np.random.default_rng(seed)
    acceleration = np.gradient(SPEED, T_S)
    noise = rng.normal(size=(T_S.size, 6)) * (0.2 + np.abs(SPEED))[:, None]
    gyro = STILL[:3] + 4e-3 * noise[:, :3] + np.outer(swing * SPEED, [0.0, 0.0, 1.0])
    accel = STILL[3:] + 0.1 * noise[:, 3:] + np.outer(shake * acceleration, [1.0, 0.0, 0.0])
    return BaseMotion(JointWindow(T_NS, ANGLE, SPEED), ImuWindow(T_NS, gyro, accel), STILL)


@pytest.mark.parametrize("seed", range(12))
def test_the_noise_of_gears_that_grows_with_the_speed_is_no_shake(seed: int) -> None:
    assert not housing(0.0, seed).shakes


def test_a_push_of_two_centimetres_a_radian_is_seen_and_its_size() -> None:
    base = housing(0.02)
    assert base.shakes
    # Noise of 0.1 m/s^2 at 1 rad/s leaves 1 mm.
    assert base.push_m == pytest.approx(0.02, abs=4e-3)
    np.testing.assert_allclose(base.gravity, STILL[3:5])


def test_a_swing_of_one_percent_is_seen() -> None:
    assert housing(0.0, swing=0.01).shakes


def test_a_module_on_the_moving_side_does_not_measure_its_base() -> None:
    assert not housing(0.0, swing=1.0).shakes


def test_a_dead_imu_reports_no_shake() -> None:
    dead = ImuWindow(T_NS, np.zeros((T_S.size, 3)), np.zeros((T_S.size, 3)))
    assert not BaseMotion(JointWindow(T_NS, ANGLE, SPEED), dead, np.zeros(6)).shakes


def test_readings_are_in_axes_that_turn_with_the_child() -> None:
    """Independent: rotations by scipy, the derivative of the rate by differences in the housing."""
    rate = np.stack([0.02 * np.sin(8 * T_S), 0.03 * np.cos(7 * T_S), 0.01 * np.sin(6 * T_S)], axis=1)
    force = np.stack([np.sin(5 * T_S), np.cos(4 * T_S), 0.5 * np.sin(3 * T_S)], axis=1)
    imu = ImuWindow(T_NS, STILL[:3] + rate, STILL[3:] + force)
    base = BaseMotion(JointWindow(T_NS, ANGLE, SPEED), imu, STILL, smooth_s=0.01)
    inner = slice(100, 1300, 40)
    turned = Rotation.from_rotvec(np.outer(-ANGLE, [0.0, 0.0, 1.0]))
    found = base.values(T_S[inner])
    # The low-pass of 10 ms takes 0.4 % of 1.4 Hz.
    np.testing.assert_allclose(found[:, FORCE], turned.apply(force)[inner], atol=1e-2)
    np.testing.assert_allclose(found[:, RATE], turned.apply(rate)[inner], atol=3e-4)
    slope = np.gradient(rate, T_S, axis=0)
    np.testing.assert_allclose(found[:, ACCELERATION], turned.apply(slope)[inner], atol=3e-3)


def test_without_a_direction_only_what_is_about_and_along_the_axis_is_left() -> None:
    base = housing(0.02, swing=0.01)
    at = T_S[200:1200:50]
    whole, axial = base.values(at), base.about_the_axis().values(at)
    np.testing.assert_array_equal(axial[:, [2, 5, 8]], whole[:, [2, 5, 8]])
    assert not axial[:, [0, 1, 3, 4, 6, 7]].any()

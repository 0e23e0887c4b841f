from collections.abc import Callable

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from module_agent.estimate.base_shake import BaseMotion
from module_agent.estimate.joint_model import (
    BASE_HEADING,
    COMPLIANCE,
    DELAY,
    GRAVITY,
    GYRO_AXIS,
    HEIGHT,
    HINGE,
    PIVOT,
    RADIAL,
    Motion,
    predict,
)
from module_agent.estimate.smoothing import SmoothMotion
from module_agent.estimate.windows import ImuWindow, JointWindow

T_S = np.linspace(0.5, 2.5, 60)


@pytest.fixture
def motion() -> SmoothMotion:
    t_s = np.arange(0.0, 3.0, 0.004)
    angle = 0.3 + 0.2 * np.sin(2 * np.pi * 2 * t_s) + 0.1 * np.sin(2 * np.pi * 0.7 * t_s)
    return SmoothMotion(JointWindow((1e9 * t_s).astype(np.int64), angle, np.zeros_like(angle)))


def parameters(compliance: float = 0.0) -> np.ndarray:
    p = np.random.default_rng(3).normal(0.0, 1e-3, DELAY + 1)
    p[:2] = 0.0
    p[RADIAL], p[GRAVITY] = (0.2, -0.1), (3.0, 8.0, 4.0)
    p[COMPLIANCE], p[HINGE] = compliance, 0.1
    return p


def numeric(read: Callable[[np.ndarray], np.ndarray], p: np.ndarray, column: int, step: float) -> np.ndarray:
    up, down = p.copy(), p.copy()
    up[column] += step
    down[column] -= step
    return (read(up) - read(down)) / (2 * step)


def test_derivatives_are_those_of_the_readings(motion: SmoothMotion) -> None:
    p = parameters()
    _, jacobian = predict(Motion(motion, None), T_S, p, DELAY)
    for column in [*range(2, BASE_HEADING), DELAY]:
        step = 1e-6 if column == COMPLIANCE else 1e-4
        expected = numeric(lambda at: predict(Motion(motion, None), T_S, at, DELAY)[0], p, column, step)
        # Differences of readings of 10 m/s^2 over such steps are good to 1e-8; the compliance's are of 1e3.
        scale = max(1.0, float(np.abs(expected).max()))
        assert np.allclose(jacobian[:, :, column], expected, atol=2e-6 * scale), column


def shaking(motion: SmoothMotion) -> Motion:
    """The joint on a housing that is pushed and turned every way, slowly enough for the low-pass."""
    t_s = np.arange(0.0, 3.0, 0.004)
    t_ns = (1e9 * t_s).astype(np.int64)
    angle = 0.3 + 0.2 * np.sin(2 * np.pi * 2 * t_s) + 0.1 * np.sin(2 * np.pi * 0.7 * t_s)
    rate = np.stack([0.1 * np.sin(8 * t_s), 0.2 * np.cos(7 * t_s), 0.1 * np.sin(6 * t_s)], axis=1)
    force = np.stack([np.sin(5 * t_s), np.cos(4 * t_s), 0.5 * np.sin(3 * t_s)], axis=1)
    joint = JointWindow(t_ns, angle, np.zeros_like(angle))
    return Motion(motion, BaseMotion(joint, ImuWindow(t_ns, rate, force), np.zeros(6)))


def test_derivatives_are_those_of_the_readings_on_a_base_that_shakes(motion: SmoothMotion) -> None:
    p, carried = parameters(), shaking(motion)
    p[BASE_HEADING], p[PIVOT], p[HEIGHT] = 0.7, (0.02, -0.03), 0.06
    _, jacobian = predict(carried, T_S, p, DELAY)
    for column in range(2, DELAY + 1):
        step = 1e-6 if column == COMPLIANCE else 1e-4
        expected = numeric(lambda at: predict(carried, T_S, at, DELAY)[0], p, column, step)
        scale = max(1.0, float(np.abs(expected).max()))
        assert np.allclose(jacobian[:, :, column], expected, atol=1e-5 * scale), column


def test_on_a_base_that_turns_the_imu_reads_the_motion_of_a_rigid_body() -> None:
    """Independent: where the IMU is in the world, differentiated twice; rotations by scipy."""
    t_s = np.arange(0.0, 3.0, 0.001)
    t_ns = (1e9 * t_s).astype(np.int64)
    q = 0.3 * np.sin(6 * t_s)
    # The squares of such turns and of their rates, which the model leaves out, are 2e-3 of the rest.
    turn = 2e-3 * np.stack([np.sin(8 * t_s), np.cos(7 * t_s), np.sin(6.5 * t_s)], axis=1)
    shift = 2e-4 * np.stack([np.sin(5 * t_s), np.cos(4 * t_s), np.sin(3 * t_s)], axis=1)
    housing, joint = Rotation.from_rotvec(turn), Rotation.from_rotvec(np.outer(q, [0.0, 0.0, 1.0]))
    pivot, height, radial, bearing = np.array([0.02, -0.03]), 0.06, np.array([0.2, -0.1]), 0.7

    def second(x: np.ndarray) -> np.ndarray:
        return np.asarray(CubicSpline(t_s, x)(t_s, 2))

    def rate_of(way: Rotation) -> np.ndarray:
        step = (way[:-1].inv() * way[1:]).as_rotvec() / 1e-3
        return np.asarray(CubicSpline(t_s[:-1] + 5e-4, step)(t_s))

    # e1 is at q = 0 where the housing's x is but for the bearing, from e1 to x.
    child = housing * joint * Rotation.from_rotvec([0.0, 0.0, -bearing])
    imu = shift + housing.apply([*pivot, height]) + child.apply([*radial, 0.0])
    felt, turned = child.inv().apply(second(imu)), rate_of(child)
    carrier = ImuWindow(t_ns, rate_of(housing), housing.inv().apply(second(shift)))
    window = JointWindow(t_ns, q, np.zeros_like(q))
    p = np.zeros(DELAY + 1)
    p[RADIAL], p[BASE_HEADING], p[PIVOT], p[HEIGHT] = radial, bearing, pivot, height
    moves = Motion(SmoothMotion(window, 0.006), BaseMotion(window, carrier, np.zeros(6), 0.006))
    still = Motion(moves.joint, None)
    inner = slice(300, 2700, 40)
    alone, _ = predict(still, t_s[inner], p, DELAY)
    found, _ = predict(moves, t_s[inner], p, DELAY)
    expected = np.hstack([turned, felt])[inner]
    # What the base adds; the low-pass of 6 ms takes 0.2 % of it, and as much of what the joint does alone.
    own = Rotation.from_rotvec(np.outer(q, [0.0, 0.0, 1.0])) * Rotation.from_rotvec([0.0, 0.0, -bearing])
    steady = np.hstack([rate_of(own), own.inv().apply(second(own.apply([*radial, 0.0])))])[inner]
    added = expected - steady
    np.testing.assert_allclose((found - alone)[:, :3], added[:, :3], atol=0.01 * np.abs(added[:, :3]).max())
    np.testing.assert_allclose((found - alone)[:, 3:], added[:, 3:], atol=0.01 * np.abs(added[:, 3:]).max())


def test_a_bending_link_changes_the_other_derivatives_by_what_is_left_out_at_most(
    motion: SmoothMotion,
) -> None:
    p = parameters(compliance=3e-5)
    _, jacobian = predict(Motion(motion, None), T_S, p, DELAY)
    for column in (2, 3, 4, 5, 6, GYRO_AXIS.start, COMPLIANCE, HINGE, DELAY):
        expected = numeric(lambda at: predict(Motion(motion, None), T_S, at, DELAY)[0], p, column, 1e-7)
        scale = float(np.abs(expected).max())
        # The load's own dependence on gravity and radius is c g / d: 2e-3 of the readings' derivatives.
        assert np.abs(jacobian[:, :, column] - expected).max() < 5e-3 * scale, column


def test_turning_the_frame_turns_both_sensors(motion: SmoothMotion) -> None:
    predicted, jacobian = predict(Motion(motion, None), T_S, parameters(), DELAY)
    for column, direction in ((0, (1.0, 0.0, 0.0)), (1, (0.0, 1.0, 0.0))):
        for sensor in (slice(0, 3), slice(3, 6)):
            assert np.allclose(jacobian[:, sensor, column], np.cross(direction, predicted[:, sensor]))


def test_a_point_mass_on_a_bent_link_obeys_newton() -> None:
    """Independent: integrate c delta'' + delta = -c q'', and differentiate the true circle of the IMU."""
    c, distance, rate = 2.5e-5, 0.48, 2000.0
    t_s = np.arange(0.0, 4.0, 1.0 / rate)
    omega = 2 * np.pi * 2.0
    q = 0.1 * np.sin(omega * t_s)
    # The steady answer of that spring to a sine: the body turns by 1 / (1 - c omega^2) of the encoder.
    theta = q / (1.0 - c * omega**2)
    tangential = distance * -(omega**2) * theta
    radial = -distance * (0.1 * omega * np.cos(omega * t_s) / (1.0 - c * omega**2)) ** 2
    slow = slice(None, None, 8)
    joint = SmoothMotion(JointWindow((1e9 * t_s[slow]).astype(np.int64), q[slow], q[slow]), smooth_s=0.012)
    p = np.zeros(DELAY + 1)
    p[RADIAL], p[COMPLIANCE] = (distance, 0.0), c
    at = t_s[2000:6000:8]
    predicted, _ = predict(Motion(joint, None), at, p, DELAY)
    # The low-pass of 12 ms takes 1.1 % of 2 Hz and 4.4 % of 4 Hz.
    gain = np.exp(-0.5 * (omega * 0.012) ** 2)
    assert np.allclose(predicted[:, 4], gain * tangential[2000:6000:8], atol=1e-4 * np.abs(tangential).max())
    mean = radial.mean()
    expected = mean + gain**4 * (radial[2000:6000:8] - mean)
    assert np.allclose(predicted[:, 3], expected, atol=1e-3 * np.abs(radial).max())

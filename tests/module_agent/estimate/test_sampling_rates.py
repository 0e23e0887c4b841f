"""Estimates of one joint where rows and IMU samples come at other rates than 250 Hz, or not evenly."""

import tracemalloc
from typing import Any

import numpy as np
import pytest

from module_agent.estimate.circle_point_analysis import circle_point_analysis, rest_reading
from module_agent.estimate.clock_delay import clock_delay
from module_agent.estimate.joint_regression import regress_joint
from module_agent.estimate.observed_motion import MotionWindows, observed_motions
from module_agent.estimate.windows import STEP_NS, ImuWindow, JointWindow, align, even
from module_agent.model.errors import DataError
from module_agent.model.imu_prior import CALIBRATED

D_M = 0.245
RATES_HZ = (50.0, 100.0, 250.0, 500.0, 1000.0)


def _at(link: Any, imu_hz: float, joint_hz: float) -> list[tuple[ImuWindow, JointWindow]]:
    """Slow and fast motion; an IMU's white noise has one density, whatever its rate."""
    # Gravity of 9.80665 m/s^2, as the prior has it.
    link = link._replace(gravity=link.gravity * 9.80665 / np.linalg.norm(link.gravity))
    imus = link._replace(rate_hz=imu_hz, noise=np.sqrt(imu_hz / 250.0))
    joints = link._replace(rate_hz=joint_hz)
    return [
        (imus.constant(1.0, 1)[0], joints.constant(1.0, 2)[1]),
        (imus.sine(0.1, 3)[0], joints.sine(0.1, 4)[1]),
    ]


@pytest.mark.parametrize("joint_hz", RATES_HZ)
@pytest.mark.parametrize("imu_hz", RATES_HZ)
def test_the_distance_is_right_within_its_sigma_at_any_rate(
    horizontal_link: Any, imu_hz: float, joint_hz: float
) -> None:
    motions = _at(horizontal_link, imu_hz, joint_hz)
    still = horizontal_link._replace(rate_hz=imu_hz).rest(np.random.default_rng(5))
    evened = [(even(imu), even(joint)) for imu, joint in motions]
    delays = [clock_delay(*pair, 0) for pair in evened]
    assert all(abs(delay.delay_s) < 1e-3 for delay in delays)
    aligned = [align(*pair, 0) for pair in evened]
    circle = circle_point_analysis(still, *aligned)
    # Known biases of the thesis' circle are some millimetres (docs/theory.md), at any rate the same.
    assert circle.distance_m == pytest.approx(D_M, abs=4e-3)
    base = [imu._replace(gyro_rad_s=0 * imu.gyro_rad_s, accel_m_s2=0 * imu.accel_m_s2) for imu, _ in motions]
    windows = [MotionWindows(*pair, carrier, 0) for pair, carrier in zip(motions, base, strict=True)]
    fit = regress_joint(observed_motions(windows), rest_reading(still), CALIBRATED)
    assert abs(fit.distance_m - D_M) < 3.0 * fit.sigma_distance_m
    assert fit.sigma_distance_m < 1e-3


def test_samples_at_even_steps_are_left_as_they_are(horizontal_link: Any) -> None:
    imu, joint = horizontal_link.sine(0.1, 1)
    assert even(imu) is imu
    assert even(joint) is joint


def test_missing_rows_are_bridged_and_a_long_hole_is_refused(horizontal_link: Any) -> None:
    _, joint = horizontal_link._replace(noise=0.0).sine(0.1, 1)
    keep = np.ones(joint.t_ns.size, dtype=bool)
    keep[700:710] = False
    bridged = even(JointWindow(*(signal[keep] for signal in joint)))
    assert set(np.diff(bridged.t_ns)) == {STEP_NS}
    np.testing.assert_allclose(bridged.position_rad, joint.position_rad, atol=1e-5)
    keep[700:730] = False
    with pytest.raises(DataError, match="a hole of 124 ms; at most 100 are bridged"):
        even(JointWindow(*(signal[keep] for signal in joint)))


def test_an_imu_that_is_too_slow_is_refused_with_its_rate(horizontal_link: Any) -> None:
    pair = _at(horizontal_link, 30.0, 250.0)[1]
    with pytest.raises(DataError, match=r"the IMU has 30\.0 samples per second; .* at least 35\.7"):
        observed_motions([MotionWindows(*pair, pair[0], 0)])


def test_times_further_apart_than_63_bits_are_refused(horizontal_link: Any) -> None:
    _, joint = horizontal_link._replace(noise=0.0).sine(0.1, 1)
    t_ns = joint.t_ns.copy()
    t_ns[: len(t_ns) // 2] -= np.int64(2**62 + 2**61)
    t_ns[len(t_ns) // 2 :] += np.int64(2**62)
    with pytest.raises(DataError):
        even(joint._replace(t_ns=t_ns))


@pytest.mark.parametrize("step_ns", [20, 100_000])
def test_times_that_would_make_millions_of_samples_are_refused_before_they_do(
    horizontal_link: Any, step_ns: int
) -> None:
    """Most samples of the motion that another module sends lie close together, the others far apart."""
    imu, joint = horizontal_link._replace(noise=0.0).sine(0.1, 1)
    steps = np.where(np.arange(joint.t_ns.size) % 5 < 3, step_ns, 40_000_000)
    hostile = joint._replace(t_ns=joint.t_ns[0] + np.cumsum(steps))
    carrier = imu._replace(t_ns=imu.t_ns[0] + np.cumsum(steps[: imu.t_ns.size]))
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"samples over .* at most 65536 even ones are made of them"):
            observed_motions([MotionWindows(imu, hostile, carrier, 0)])
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()

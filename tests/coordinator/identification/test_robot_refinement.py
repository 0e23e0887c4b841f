"""How large an error of an IMU must be to doubt the catalogue depends on how many there are."""

import numpy as np
import pytest

from coordinator.batch_estimation.imu_intrinsics import ImuIntrinsics, beyond
from coordinator.identification.robot_refinement import DOUBTED_SHARE, SUSPICIOUS, suspicious_beyond
from module_agent.model.imu_prior import UNCALIBRATED, ImuPrior

ROBOTS = 2000


@pytest.mark.parametrize("count", [4, 16, 64])
def test_as_many_healthy_robots_are_doubted_whatever_their_size(count: int) -> None:
    rng = np.random.default_rng(count)
    errors = rng.normal(size=(ROBOTS * count, len(UNCALIBRATED.sigmas))) * UNCALIBRATED.sigmas
    largest = beyond(ImuIntrinsics(errors), UNCALIBRATED).reshape(ROBOTS, count).max(axis=1)
    doubted = np.mean(largest > suspicious_beyond(count, UNCALIBRATED))
    # Five standard deviations of a share of so many robots.
    assert doubted == pytest.approx(DOUBTED_SHARE, abs=5.0 * np.sqrt(0.2 * 0.8 / ROBOTS))


def test_a_small_robot_is_not_doubted_for_less_than_three_sigmas() -> None:
    assert suspicious_beyond(2, UNCALIBRATED) == SUSPICIOUS
    known = ImuPrior(*(0.0 for _ in ImuPrior._fields))
    assert suspicious_beyond(16, known) == SUSPICIOUS

"""The motion itself must tell the offset of two clocks, far below a sample."""

from typing import Any

import numpy as np
import pytest

from module_agent.estimate.clock_delay import clock_delay
from module_agent.estimate.windows import JointWindow, align
from module_agent.model.errors import DataError

OFFSET_NS = 7_300_000_000


def shifted(hinge: Any, **changes: Any) -> Any:
    return hinge._replace(imu_ahead_s=1e-9 * OFFSET_NS, **changes)


@pytest.mark.parametrize("rough_error_ms", [-60.0, -13.0, 0.0, 37.0, 60.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_windowed_sine_gives_the_offset_to_a_tenth_of_a_millisecond(
    horizontal_link: Any, rough_error_ms: float, seed: int
) -> None:
    imu, joint = shifted(horizontal_link).sine(0.1, seed)
    found = clock_delay(imu, joint, OFFSET_NS + round(1e6 * rough_error_ms))
    # Noise of 1.2 mrad/s and 5 mrad/s on a rate of 0.5 rad/s rms and 1400 samples: about 10 us; bound 100 us.
    assert found.determined
    assert abs(found.offset_ns - OFFSET_NS) < 100_000
    assert found.delay_s == pytest.approx(-1e-3 * rough_error_ms, abs=1e-4)


def test_a_constant_motion_gives_the_offset_below_a_millisecond(horizontal_link: Any) -> None:
    for seed in range(5):
        imu, joint = shifted(horizontal_link).constant(-0.8, seed)
        found = clock_delay(imu, joint, OFFSET_NS - 40_000_000)
        assert abs(found.offset_ns - OFFSET_NS) < 1_000_000


def test_the_stated_sigma_is_that_of_the_errors(horizontal_link: Any) -> None:
    errors, sigmas = [], []
    for seed in range(30):
        imu, joint = shifted(horizontal_link).sine(0.05, seed)
        found = clock_delay(imu, joint, OFFSET_NS + 20_000_000)
        errors.append(1e-9 * (found.offset_ns - OFFSET_NS))
        sigmas.append(found.sigma_s)
    # 30 draws: the scatter of a standard deviation is 13 %; a factor of two either way is 4 sigma of that.
    assert 0.5 < np.std(errors) / np.mean(sigmas) < 2.0
    assert abs(np.mean(errors)) < 4 * np.mean(sigmas) / np.sqrt(30) + 5e-6


def test_a_clock_that_drifts_by_100_ppm_is_found_as_its_mean(horizontal_link: Any) -> None:
    imu, joint = shifted(horizontal_link, drift=1e-4).sine(0.1, 3)
    found = clock_delay(imu, joint, OFFSET_NS)
    # The middle of the motion lies at 2.8 s, where the clocks have moved apart by 0.28 ms.
    assert found.offset_ns - OFFSET_NS == pytest.approx(280_000, abs=100_000)


def test_the_sign_and_size_of_the_gain_do_not_matter(horizontal_link: Any) -> None:
    mirrored = shifted(horizontal_link, carried=-0.3)
    found = clock_delay(*mirrored.sine(0.1, 5), OFFSET_NS + 30_000_000)  # type: ignore[call-arg]
    assert abs(found.offset_ns - OFFSET_NS) < 200_000


def test_an_imu_that_does_not_move_leaves_the_rough_offset_as_it_is(horizontal_link: Any) -> None:
    found = clock_delay(*shifted(horizontal_link, carried=0.0).sine(0.1, 6), OFFSET_NS + 30_000_000)  # type: ignore[call-arg]
    assert not found.determined
    assert found.offset_ns == OFFSET_NS + 30_000_000
    assert found.sigma_s == float("inf")


def test_a_joint_that_reports_at_another_rate_and_with_gaps_still_tells_the_offset(
    horizontal_link: Any,
) -> None:
    imu, joint = shifted(horizontal_link).sine(0.1, 7)
    keep = np.arange(joint.t_ns.size) % 2 == 0
    keep[200:210] = False
    found = clock_delay(imu, JointWindow(*(column[keep] for column in joint)), OFFSET_NS - 25_000_000)
    assert abs(found.offset_ns - OFFSET_NS) < 200_000


def test_windows_that_do_not_overlap_are_refused(horizontal_link: Any) -> None:
    imu, joint = horizontal_link.sine(0.1, 8)
    with pytest.raises(DataError, match="inside the joint's window"):
        clock_delay(imu, joint, 60_000_000_000)
    with pytest.raises(DataError, match="Check the offset"):
        align(imu, joint, 60_000_000_000)


def test_a_joint_at_rest_has_no_delay_to_find(horizontal_link: Any) -> None:
    quiet = horizontal_link._replace(noise=0.0)
    assert not clock_delay(*quiet.sine(0.0, 9), 0).determined  # type: ignore[call-arg]


def test_aligned_positions_are_those_of_the_same_instant(horizontal_link: Any) -> None:
    imu, joint = shifted(horizontal_link, noise=0.0).sine(0.1, 10)
    motion = align(imu, joint, OFFSET_NS)
    # The gyro is the joint's rate about the axis at the same instant, interpolation error apart.
    along = (motion.gyro_rad_s - horizontal_link.gyro_offset) @ horizontal_link.axis
    np.testing.assert_allclose(motion.velocity_rad_s, along, atol=1e-5)
    np.testing.assert_allclose(np.gradient(motion.position_rad, motion.t_s)[1:-1], along[1:-1], atol=5e-3)

"""Being carried by a joint must be told from shaking and from the give of the joints in between."""

from typing import Any

import numpy as np
import pytest

from module_agent.estimate.motion_detection import detect_motion
from module_agent.estimate.windows import AlignedMotion, align
from module_agent.model.errors import DataError


def motions(hinge: Any, seed: int = 0) -> list[AlignedMotion]:
    return [align(*hinge.constant(1.0, seed), 0), align(*hinge.sine(0.1, seed + 1), 0)]  # type: ignore[call-arg]


def test_a_rigidly_carried_imu_answers_one_to_one_about_the_axis(horizontal_link: Any) -> None:
    found = detect_motion(motions(horizontal_link), horizontal_link.gyro_offset)
    assert found.moved
    assert found.rate_ratio == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(found.coefficient, horizontal_link.axis, atol=1e-3)


def test_an_imu_at_rest_does_not_move(horizontal_link: Any) -> None:
    found = detect_motion(motions(horizontal_link._replace(carried=0.0)), horizontal_link.gyro_offset)
    assert not found.moved
    assert found.rate_ratio < 5 * np.sqrt(3) * found.sigma


@pytest.mark.parametrize(("follows", "moved"), [(0.3, False), (-0.3, False), (0.75, True), (1.25, True)])
def test_the_give_of_held_joints_is_not_taken_for_being_carried(
    horizontal_link: Any, follows: float, moved: bool
) -> None:
    found = detect_motion(motions(horizontal_link._replace(carried=follows)), horizontal_link.gyro_offset)
    assert found.moved is moved
    assert found.rate_ratio == pytest.approx(abs(follows), abs=2e-3)


def test_shaking_as_strong_as_the_motion_itself_is_not_taken_for_it(horizontal_link: Any) -> None:
    shaken = []
    for motion in motions(horizontal_link._replace(carried=0.0)):
        size = np.sqrt(np.mean(motion.velocity_rad_s**2))
        shake = 2 * size * np.sin(2 * np.pi * 9 * motion.t_s)  # a structure ringing at 9 Hz
        shaken.append(motion._replace(gyro_rad_s=motion.gyro_rad_s + shake[:, None]))
    assert not detect_motion(shaken, horizontal_link.gyro_offset).moved


def test_a_constant_motion_alone_is_enough(horizontal_link: Any) -> None:
    assert detect_motion(motions(horizontal_link)[:1], horizontal_link.gyro_offset).moved


def test_a_joint_at_rest_is_refused(horizontal_link: Any) -> None:
    still = align(*horizontal_link._replace(noise=0.0).sine(0.0, 0), 0)  # type: ignore[call-arg]
    with pytest.raises(DataError, match="turned at only"):
        detect_motion([still], horizontal_link.gyro_offset)
    with pytest.raises(DataError, match="no motion"):
        detect_motion([], horizontal_link.gyro_offset)

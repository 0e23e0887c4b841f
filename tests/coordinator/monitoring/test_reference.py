"""A run tells how torques add up if several joints moved at once in it."""

import numpy as np

from coordinator.monitoring.reference import moved_together

STILL = np.full((125, 2), 0.01)
FIRST, SECOND = (
    STILL + np.array(column) * np.sin(np.arange(125) / 20.0)[:, None] for column in ([1, 0], [0, 1])
)


def test_joints_that_move_one_after_the_other_do_not_move_together() -> None:
    assert not moved_together([STILL, FIRST, STILL, SECOND])


def test_one_stretch_in_which_two_move_is_enough() -> None:
    assert moved_together([STILL, FIRST, FIRST + SECOND])


def test_a_single_joint_has_none_to_move_with() -> None:
    assert moved_together([FIRST[:, :1]])

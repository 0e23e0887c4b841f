"""A run tells how torques add up if several joints moved at once in it."""

import numpy as np

from coordinator.monitoring.reference import moved_together

STILL = np.full((125, 2), 0.01)
FIRST, SECOND = (
    STILL + np.array(column) * np.sin(np.arange(125) / 20.0)[:, None] for column in ([1, 0], [0, 1])
)


def test_joints_that_move_one_after_the_other_do_not_move_together() -> None:
    assert not moved_together([STILL, FIRST, STILL, SECOND])


def test_a_tenth_of_the_stretches_in_which_half_of_the_joints_move_is_enough() -> None:
    assert moved_together([*[STILL, FIRST, SECOND] * 3, FIRST + SECOND])
    assert not moved_together([*[STILL, FIRST, SECOND] * 4, FIRST + SECOND])


def test_two_of_six_joints_that_move_at_once_do_not_show_how_all_of_them_move() -> None:
    two = np.hstack([FIRST + SECOND, STILL, STILL])
    assert not moved_together([two])
    assert moved_together([np.hstack([FIRST + SECOND, FIRST, STILL])])


def test_a_single_joint_has_none_to_move_with() -> None:
    assert moved_together([FIRST[:, :1]])

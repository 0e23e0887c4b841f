"""Axes of the first pass serve the second only near the joint positions at which they were measured."""

import numpy as np
import pytest

from coordinator.identification.topology_observations import TURNED_RAD, Axes, MotionFeedback, by_feedback
from coordinator.recording.journal import JournalEvent
from coordinator.topology.topology import MotionObservation

NAMES = ("held", "moving", "observing")
SAMPLES = 60
GIVE = 0.8


def feedback(held_rad: float, turned_rad: float) -> MotionFeedback:
    """`moving` moves, `held` gives by 0.8 of it and carries `observing`, about an axis that has turned."""
    t = np.arange(SAMPLES) / 50.0
    rate = np.zeros((SAMPLES, 3))
    rate[:, 1] = np.clip(np.minimum(t, t[-1] - t) / 0.15, 0.0, 1.0)
    rate[:, 0] = GIVE * rate[:, 1]
    gyro = np.zeros((SAMPLES, 3, 3))
    gyro[:, 2] = rate[:, :1] * np.array([np.cos(turned_rad), np.sin(turned_rad), 0.0])
    event = JournalEvent(t_ns=0, what="motion", serial="moving", purpose="constant")
    return MotionFeedback(event, NAMES, np.array([held_rad, 0.0, 0.0]), rate, gyro, np.zeros((3, 3)))


def second_pass(turned_rad: float, held_rad: float) -> MotionObservation:
    axes = Axes({("held", "observing"): np.array([1.0, 0.0, 0.0])}, dict.fromkeys(NAMES, 0.0))
    return by_feedback(feedback(held_rad, turned_rad), axes)["observing"]


def test_the_contribution_of_a_held_joint_is_subtracted_at_the_usual_pose() -> None:
    first_pass = by_feedback(feedback(0.0, 0.0), None)["observing"]
    assert first_pass.rate_ratio == pytest.approx(GIVE)
    observation = second_pass(0.0, held_rad=0.0)
    assert observation.rate_ratio == pytest.approx(0.0, abs=1e-9)
    assert observation.log_odds < first_pass.log_odds - 2.0


def test_away_from_that_pose_nothing_is_subtracted() -> None:
    """An axis 1 rad off would increase the error, and the confidence in it."""
    away = second_pass(1.0, held_rad=1.5 * TURNED_RAD)
    untouched = by_feedback(feedback(1.5 * TURNED_RAD, 1.0), None)["observing"]
    assert (away.rate_ratio, away.sigma, away.give) == (untouched.rate_ratio, untouched.sigma, untouched.give)
    assert abs(away.log_odds) < 3.0

"""What a first look was sure of serves the second only where the joints are where it was seen."""

import numpy as np
import pytest

from coordinator.identification.topology_observations import TURNED_RAD, Axes, Heard, by_feedback
from coordinator.recording.journal import JournalEvent
from coordinator.topology.topology import MotionObservation

NAMES = ("held", "moving", "watching")
SAMPLES = 60
GIVE = 0.8


def heard(held_rad: float, turned_rad: float) -> Heard:
    """`moving` moves, `held` gives by 0.8 of it and carries `watching`, about an axis that has turned."""
    t = np.arange(SAMPLES) / 50.0
    rate = np.zeros((SAMPLES, 3))
    rate[:, 1] = np.clip(np.minimum(t, t[-1] - t) / 0.15, 0.0, 1.0)
    rate[:, 0] = GIVE * rate[:, 1]
    gyro = np.zeros((SAMPLES, 3, 3))
    gyro[:, 2] = rate[:, :1] * np.array([np.cos(turned_rad), np.sin(turned_rad), 0.0])
    event = JournalEvent(t_ns=0, what="motion", serial="moving", purpose="constant")
    return Heard(event, NAMES, np.array([held_rad, 0.0, 0.0]), rate, gyro, np.zeros((3, 3)))


def seen(turned_rad: float, held_rad: float) -> MotionObservation:
    axes = Axes({("held", "watching"): np.array([1.0, 0.0, 0.0])}, dict.fromkeys(NAMES, 0.0))
    return by_feedback(heard(held_rad, turned_rad), axes)["watching"]


def test_what_a_held_joint_gave_is_taken_off_at_the_usual_pose() -> None:
    without = by_feedback(heard(0.0, 0.0), None)["watching"]
    assert without.rate_ratio == pytest.approx(GIVE)
    found = seen(0.0, held_rad=0.0)
    assert found.rate_ratio == pytest.approx(0.0, abs=1e-9)
    assert found.log_odds < without.log_odds - 2.0


def test_where_joints_have_been_turned_nothing_is_taken_off() -> None:
    """An axis that is 1 rad from where it was seen would make the error larger, and surer of itself."""
    away = seen(1.0, held_rad=1.5 * TURNED_RAD)
    untouched = by_feedback(heard(1.5 * TURNED_RAD, 1.0), None)["watching"]
    assert (away.rate_ratio, away.sigma, away.give) == (untouched.rate_ratio, untouched.sigma, untouched.give)
    assert abs(away.log_odds) < 3.0

"""A doubt asks for another motion of the right joint and kind, a limited number of times."""

import numpy as np
import pytest

from coordinator.topology.next_motion import MAX_REPEATS, next_motions
from coordinator.topology.topology import Doubt, MotionObservation, combined_observation, likely_topology
from module_agent.model.errors import DataError
from module_agent.wire.messages import ConstantMotion

CHAIN = ("A", "B", "C")
SLOW = ConstantMotion(velocity_rad_s=1.0, duration_s=0.75)


def watch(**changed: MotionObservation) -> dict[tuple[str, str], MotionObservation]:
    """A chain A - B - C; `changed` is keyed by joint and observer, as in BC."""
    seen = {(i, k): MotionObservation(i < k, float(i < k)) for i in CHAIN for k in CHAIN}
    return seen | {(pair[0], pair[1]): value for pair, value in changed.items()}


def test_without_a_doubt_nothing_moves_again() -> None:
    seen = watch()
    assert next_motions(likely_topology(seen).doubts, seen, {}) == ()


def test_a_joint_that_others_gave_way_to_moves_more_slowly() -> None:
    seen = watch(BC=MotionObservation(True, 0.55, sigma=0.3, give=0.45))
    (motion,) = next_motions(likely_topology(seen).doubts, seen, {"B": 0})
    assert (motion.joint, motion.others_rad) == ("B", 0.0)
    again = motion.pattern(SLOW)
    assert again.velocity_rad_s == pytest.approx(0.5 * SLOW.velocity_rad_s)
    assert motion.travel_rad(SLOW) == pytest.approx(0.9)
    assert "gave way" in motion.summary
    assert "C is mounted on" in motion.summary


def test_a_joint_that_was_seen_through_noise_moves_farther() -> None:
    seen = watch(AA=MotionObservation(True, 0.55, sigma=0.3, give=0.01))
    (motion,) = next_motions(likely_topology(seen).doubts, seen, {})
    assert motion.joint == "A"
    assert motion.pattern(SLOW).velocity_rad_s == SLOW.velocity_rad_s
    assert motion.travel_rad(SLOW) == pytest.approx(1.5 * 0.9)
    assert "forward or reversed" in motion.summary


def test_the_last_try_is_in_another_pose_and_then_the_joint_is_given_up() -> None:
    seen = watch(BC=MotionObservation(True, 0.55, sigma=0.3))
    doubts = likely_topology(seen).doubts
    (last,) = next_motions(doubts, seen, {"B": MAX_REPEATS - 1})
    assert last.others_rad > 0.3
    assert next_motions(doubts, seen, {"B": MAX_REPEATS}) == ()


def test_an_observation_that_was_missed_is_asked_for_as_it_was() -> None:
    seen = watch()
    del seen["B", "C"]
    (motion,) = next_motions(likely_topology(seen).doubts, seen, {})
    assert motion.pattern(SLOW) == SLOW
    assert "C has missed it" in motion.summary


def test_every_joint_is_asked_for_once_the_most_doubtful_first() -> None:
    seen = watch(
        BC=MotionObservation(True, 0.6, sigma=0.3),
        BB=MotionObservation(False, 0.49),
        AB=MotionObservation(True, 0.8, sigma=0.2),
    )
    doubts = likely_topology(seen).doubts
    motions = next_motions(doubts, seen, {})
    assert [m.joint for m in motions] == list(dict.fromkeys(d.joint for d in doubts))
    assert motions[0].joint == "B"


def test_the_range_of_a_motion_is_kept() -> None:
    """Half of the range either side of home; a joint of +-90 degrees must not run into its stop."""
    doubt = Doubt("mounting", "A", 0.0, "A", "A", "")
    (motion,) = next_motions([doubt], watch(AA=MotionObservation(True, 0.5)), {})
    assert motion.travel_rad(SLOW) / 2.0 < np.pi / 2.0 - 0.5


def test_a_motion_that_went_wrong_is_outvoted_by_two_that_did_not() -> None:
    wrong, right = MotionObservation(True, 1.0), MotionObservation(False, 0.02)
    assert abs(combined_observation([wrong, right]).log_odds) < 0.5
    both = combined_observation([wrong, right, right])
    assert not both.moved
    assert both.rate_ratio == 0.02
    assert both.log_odds == pytest.approx(right.log_odds, abs=0.5)
    with pytest.raises(DataError, match="no motion"):
        combined_observation([])

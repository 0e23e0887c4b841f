"""What a run tells of a robot that is well: how its torques add up, and its torque sensors' offsets."""

import numpy as np
import pytest

from coordinator.monitoring.likelihood_ratio import Evidence, evidence_of, joined, tempered, without_own
from coordinator.monitoring.reference import (
    MARGIN,
    calibrated_test,
    fitted_torques,
    moved_together,
    session_spans,
)
from coordinator.monitoring.segments import DataSegment
from coordinator.parameter_fit.least_squares import solve_weighted
from coordinator.recording.journal import JournalEvent
from coordinator.synchronisation.motion_windows import joined_motions
from module_agent.model.chain import Array
from module_agent.model.information import gather
from module_agent.model.regressor import inverse_dynamics
from module_agent.signals.filtering import JointMotion
from tests.coordinator.monitoring.moving_arm import CHAIN, JOINTS, KINDS, PHI, segments


def _motions(*steps: str) -> list[JournalEvent]:
    """Return the motions of steps, each given by the letters of its joints."""
    return [
        JournalEvent(t_ns=0, what="motion", step=f"dynamic/{k}", serial=serial, purpose="dynamic")
        for k, serials in enumerate(steps)
        for serial in serials
    ]


def test_joints_that_move_one_after_the_other_do_not_move_together() -> None:
    assert not moved_together(_motions("A", "B"), 2)


def test_joints_that_move_at_once_in_half_of_the_motions_move_together() -> None:
    assert moved_together(_motions("A", "AB"), 2)
    assert not moved_together(_motions("A", "AB", "B"), 2)


def test_two_of_six_joints_that_move_at_once_do_not_show_how_all_of_them_move() -> None:
    assert not moved_together(_motions("AB", "CD", "EF"), 6)
    assert moved_together(_motions("ABC", "DEF"), 6)


def test_a_single_joint_has_none_to_move_with() -> None:
    assert moved_together(_motions("A"), 1)


def _session(from_ns: int, *whats: str) -> list[JournalEvent]:
    """Return a session's events, a nanosecond apart."""
    return [
        JournalEvent(t_ns=from_ns + k, what=what)  # type: ignore[arg-type]
        for k, what in enumerate(("session", *whats))
    ]


def test_a_session_spans_its_first_step_to_the_last_that_was_done() -> None:
    """What broke off is not how a robot usually moves, nor is a session that completed nothing."""
    broken_off = _session(0, "motion", "begin", "motion", "done", "begin", "motion", "failed")
    nothing_done = _session(100, "begin", "motion", "failed")
    whole = _session(200, "begin", "motion", "done", "begin", "done", "finished")
    assert session_spans([*broken_off, *nothing_done, *whole]) == [(1, 4), (201, 205)]


# Of four parameters the first two may change: by any size, or by some hundredths.
CHANGE = np.eye(4)[:, :2]
SMALL_CHANGE = 0.05 * CHANGE
NONE = np.zeros(0)


def _noisy_windows(noise: float, rows: int = 60) -> list[Evidence]:
    """Return windows of one robot whose samples scatter by so many times what they are taken to."""
    rng = np.random.default_rng(4)
    windows = []
    for _ in range(20):
        slopes = rng.normal(size=(rows, 4))
        windows.append(evidence_of(slopes, slopes @ np.ones(4) + noise * rng.normal(size=rows)))
    return windows


def test_what_a_model_leaves_is_noise_by_which_windows_agree() -> None:
    """Chance sets the largest of twenty gains, within a factor of two nearly always."""
    wide = np.full(4, 10.0)
    assert calibrated_test(_noisy_windows(0.5), NONE, wide, (CHANGE,)).inflation == MARGIN
    inflation = calibrated_test(_noisy_windows(5.0), NONE, wide, (CHANGE,)).inflation
    assert inflation == pytest.approx(25.0 * MARGIN, rel=0.5)


def test_what_is_a_windows_own_drifts_no_farther_for_noise_that_is_inflated() -> None:
    """Of an own parameter that is known to 0.01, five times the noise takes nothing."""
    own = np.array([0.01])
    found = calibrated_test(_noisy_windows(5.0), own, np.full(3, 10.0), (CHANGE[:, 1:],))
    parts = [without_own(tempered(one, found.inflation), own) for one in _noisy_windows(5.0)]
    np.testing.assert_allclose(found.evidence.matrix, joined(parts).matrix, rtol=1e-9)
    np.testing.assert_allclose(found.evidence.vector, joined(parts).vector, rtol=1e-9, atol=1e-9)


def test_a_window_that_cannot_tell_so_small_a_change_inflates_nothing() -> None:
    """With a sigma of a third it says that a parameter changed by four, where hundredths are likely."""
    odd = evidence_of(3.0 * np.eye(4)[:1], [15.0])
    windows = [*_noisy_windows(0.5), odd]
    assert calibrated_test(windows, NONE, np.full(4, 10.0), (SMALL_CHANGE,)).inflation == MARGIN
    # Were a change of any size as likely, all windows would count for less.
    assert calibrated_test(windows, NONE, np.full(4, 10.0), (10.0 * CHANGE,)).inflation > 10.0 * MARGIN


# What sensors of the first joint, which carries all, and of the last read of nothing [Nm].
OFFSETS_NM = np.array([0.08, 0.0, -0.08])


def test_offsets_of_torque_sensors_are_measured_and_not_taken_for_weight() -> None:
    # In this motion gravity turns in the last joint's frame by some tenths of a radian, later by much more.
    known = [one._replace(tau_nm=one.tau_nm + OFFSETS_NM) for one in segments(11, 40)]
    _, offsets = fitted_torques(CHAIN, KINDS, _joined(known))
    # Noise of 0.05 Nm in 5,000 samples is 1 mNm, and gravity hides as much again.
    np.testing.assert_allclose(offsets, OFFSETS_NM, atol=5e-3)
    assert _wrong_elsewhere(fitted_torques(CHAIN, KINDS, _joined(known))[0]) < 0.01
    # The control: a fit that has no offsets is wrong by about as much as they are.
    motion = _joined(known)
    information = gather(CHAIN, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2, motion.tau_nm)
    assert _wrong_elsewhere(solve_weighted(information).phi) > 0.04


def test_what_no_motion_shows_is_by_the_catalogue_and_the_weight() -> None:
    # An arm at rest does not show its inertia about the vertical.
    still = [
        one._replace(qd_rad_s=0.0 * one.qd_rad_s, qdd_rad_s2=0.0 * one.qdd_rad_s2) for one in segments(12, 10)
    ]
    motion = _joined([one._replace(tau_nm=_torques(PHI, one)) for one in still])
    # Its weight says how much heavier it is than the catalogue's modules without links: a fifth here.
    assert _about_the_vertical(fitted_torques(CHAIN, KINDS, motion)[0]) == pytest.approx(
        _about_the_vertical(PHI), rel=0.1
    )
    # The control: least squares have no inertia at all.
    information = gather(CHAIN, motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2, motion.tau_nm)
    assert abs(_about_the_vertical(solve_weighted(information).phi)) < 1e-3


def _about_the_vertical(phi: Array) -> float:
    """Return the arm's inertia about the axis of its first joint."""
    turning = np.zeros((1, JOINTS)), np.zeros((1, JOINTS)), np.array([[1.0, 0.0, 0.0]])
    return float(inverse_dynamics(CHAIN, phi, *turning)[0, 0])


def _torques(phi: Array, one: DataSegment) -> Array:
    return inverse_dynamics(CHAIN, phi, one.q_rad, one.qd_rad_s, one.qdd_rad_s2)


def _joined(parts: list[DataSegment]) -> JointMotion:
    """Return stretches as one motion."""
    return joined_motions(
        [JointMotion(*(getattr(one, name) for name in JointMotion._fields)) for one in parts]
    )


def _wrong_elsewhere(phi: Array) -> float:
    """Return how wrong the torque of the last joint is in other poses: its largest error but its mean."""
    others = [one._replace(q_rad=one.q_rad * 4.0) for one in segments(13)]
    error = np.concatenate([_torques(phi, one) - _torques(PHI, one) for one in others])[:, -1]
    return float(np.abs(error - error.mean()).max())

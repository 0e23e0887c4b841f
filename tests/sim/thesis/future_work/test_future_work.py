"""Chapter 7.2: gains are measured with a feature and without, and a missing gain is not counted."""

from typing import Any

import numpy as np
import pytest

from module_agent.signals.filtering import JointMotion
from sim.robot.noise_choice import NoiseChoice
from sim.thesis.experiment import Scope, Unit
from sim.thesis.future_work.arm_sessions import ArmSessions, ChainErrors, single_joint_torques
from sim.thesis.future_work.experiment import FUTURE_WORK, items
from sim.thesis.future_work.joint_trials import AlignedTrial, aligned_trial
from sim.thesis.kinematics.amplitude_sweep import AmplitudeTrial, Series

SCOPE = Scope(seed=0, noise=NoiseChoice("x5"), quick=True)
NAMES = (
    "homogeneous modules",
    "sturdier setup",
    "alignment by the IMU",
    "amplitudes by length",
    "repeats",
    "model of several joints",
    "dynamics of several joints",
    "distal sensors",
    "whole-manipulator motion",
    "moving frames",
)


def trial(series: Series, number: int, error_mm: float) -> AmplitudeTrial:
    """A trial of which both methods err alike, with a stroke that varies as the length does."""
    length = float(series.length_mm)
    return AmplitudeTrial(
        purpose=series.purpose, alignment=series.alignment, length_mm=series.length_mm, rig=series.rig,
        trial=number, amplitude_rad=series.amplitudes_rad[number], true_mm=length,
        estimated_mm=length + error_mm, sigma_mm=1.0, unfiltered_mm=length, commanded_rad_s=1.0,
        reached_rad_s=1.0, saturated=False, stroke=1.0 + 1e-3 * error_mm, note="",
        printed_mm=length + error_mm, ours_mm=length + error_mm,
        ours_sigma_mm=1.0 / series.amplitudes_rad[number],
    )  # fmt: skip


def gains_everywhere(unit: Unit) -> Any:
    """Results in which all that is asked makes figures four times smaller."""
    if unit.kind is ArmSessions:
        good, bad = ChainErrors(1.0, 2.0), ChainErrors(4.0, 8.0)
        own = ChainErrors(16.0, 32.0)
        return ArmSessions(bad, own, bad, own, good, ChainErrors(0.25, 0.5), 40.0, 10.0, 0.16, 0.04, 0.01)
    if unit.kind is AlignedTrial:
        alignment, length = unit.arguments[:2]
        return AlignedTrial(alignment, length, 0.1 if alignment == "horizontal" else 89.9, 20.0, 1.0, 4.0)
    series: Series = unit.arguments[0]
    if series.purpose == "repeats":
        # The rms is four times the mean; the first is four times better than the sweep.
        return [trial(series, k, error) for k, error in enumerate((1.0, 2.5818, -2.0818))]
    if len(series.amplitudes_rad) == 1:
        return [trial(series, 0, (1.0 + series.rig) / (4.0 if series.noise.off else 1.0))]
    return [trial(series, k, 4.0 / (1.0 + 3.0 * (k == 3))) for k in range(len(series.amplitudes_rad))]


def measured() -> list[Any]:
    return [gains_everywhere(unit) for unit in FUTURE_WORK.units(SCOPE)]


def test_every_item_has_its_gains_and_all_of_them_are_seen() -> None:
    own = items(measured())
    assert tuple(item.name for item in own) == NAMES
    for item in own:
        for gain in item.gains:
            assert gain.ratio == pytest.approx(4.0, rel=1e-3), (item.name, gain.figure)
    assert FUTURE_WORK.result(measured()).outcome == "seen"


def test_the_outcome_counts_gains_of_more_than_chance_only() -> None:
    known = measured()
    for one in known:
        if isinstance(one, list) and one[0].purpose == "repeats":
            one[:] = [each._replace(estimated_mm=each.true_mm + 1.0) for each in one]
    result = FUTURE_WORK.result(known)
    # All trials alike: the mean of several is no better than one.
    assert result.outcome == "seen in part"
    assert "repeats: error of the length, rms 1 mm in place of 1 mm" in result.reason.partition("Does not")[2]
    assert result.reason.count(" in place of ") == len(NAMES)


def test_a_method_without_a_chain_has_nothing_to_compare() -> None:
    without = [
        one._replace(circles=None, own_circles=None) if isinstance(one, ArmSessions) else one
        for one in measured()
    ]
    result = FUTURE_WORK.result(without)
    assert "distal sensors: nothing to compare" in result.reason.partition("Does not hold")[2]


def test_the_alignment_is_seen_and_a_base_that_rocks_is_taken_off() -> None:
    vertical = aligned_trial("vertical", 484, NoiseChoice("x5"), 0)
    assert vertical.seen == "vertical"
    # The post rocks by 3 % of the motion; the bar of one joint's length is 1 mm.
    assert abs(vertical.fixed_base_mm) > 5.0
    assert abs(vertical.moving_base_mm) < 1.0
    horizontal = aligned_trial("horizontal", 171, NoiseChoice("x5"), 0)
    assert horizontal.seen == "horizontal"
    assert horizontal.axis_to_gravity_deg < 1.0


def motion(rng: np.random.Generator, joints: int = 2) -> JointMotion:
    """Random motion of joints that each obey their own eq. 28."""
    q, qd, qdd = rng.normal(size=(3, 200, joints))
    tau = np.array([0.1, 0.3]) * qdd + np.array([2.0, 0.5]) * np.cos(q) + np.array([-0.4, 0.1]) * np.sin(q)
    return JointMotion(np.arange(200, dtype=np.int64), q, qd, qdd, tau)


def test_joints_that_do_not_act_on_each_other_are_predicted_by_single_joint_models() -> None:
    fitted, other = motion(np.random.default_rng(0)), motion(np.random.default_rng(1))
    np.testing.assert_allclose(single_joint_torques(fitted, other), other.tau_nm, atol=1e-9)


def test_torques_of_a_joint_that_stands_are_not_fitted() -> None:
    fitted, other = motion(np.random.default_rng(0)), motion(np.random.default_rng(1))
    standing = np.arange(200) % 2 == 0
    qd, tau = fitted.qd_rad_s.copy(), fitted.tau_nm.copy()
    qd[standing], tau[standing] = 0.0, 99.0
    spoilt = fitted._replace(qd_rad_s=qd, tau_nm=tau)
    np.testing.assert_allclose(single_joint_torques(spoilt, other), other.tau_nm, atol=1e-9)

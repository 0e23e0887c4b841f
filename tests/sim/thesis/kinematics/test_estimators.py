"""The comparison of estimators: what they make of one recording, and what is concluded from many."""

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from module_agent.estimate.windows import JointWindow
from sim.imperfections.noise_profile import NOISE_PROFILES, switched
from sim.robot.noise_choice import NoiseChoice
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import sensing_chain
from sim.scoring.chain_score import link_length_m
from sim.test_bench.one_joint_rig import OneJointRig
from sim.thesis.kinematics.estimator_experiments import ESTIMATORS, arm_rows
from sim.thesis.kinematics.estimator_variants import (
    VARIANTS,
    Arm,
    Comparison,
    Estimate,
    EstimatorRow,
    _commanded,
    compare_estimators,
    estimator_rows,
)

SOLID = switched(NOISE_PROFILES["x5"], off=("base-shake",))


def test_every_source_of_the_motion_gives_the_same_length_within_its_interval() -> None:
    with OneJointRig(load_robot("thesis_171_horizontal"), 2, SOLID) as rig:
        trial = rig.trial(Plan(sine_amplitude_rad=0.2))
        true_m = link_length_m(sensing_chain(rig.world.robot), child=1)
    compared = compare_estimators(trial, SOLID, true_m)
    assert set(compared.estimates) == set(VARIANTS)
    assert compared.estimates["thesis"].error_m > 2e-3  # its filter alone makes 171 mm 1.3 mm too long
    for name in set(VARIANTS) - {"thesis"}:
        found = compared.estimates[name]
        assert abs(found.error_m) < 4.0 * found.sigma_m, name
        assert found.sigma_m < 4.0 * compared.bound_m, name


def test_a_command_that_the_joint_follows_late_explains_it_without_the_counts() -> None:
    t_s = np.arange(0.0, 4.0, 0.004)
    command = 0.1 * np.sin(2 * np.pi * 2 * t_s)
    late = 0.095 * np.sin(2 * np.pi * 2 * (t_s - 0.02)) + 0.01
    counted = np.rint(late / 1e-3) * 1e-3
    told = _commanded(JointWindow((1e9 * t_s).astype(np.int64), counted, late), command).position_rad
    # Counts of 1 mrad have 0.29 mrad rms.
    assert np.sqrt(np.mean((told - late)[50:] ** 2)) < 1e-4


def test_rows_are_means_and_roots_of_what_was_found() -> None:
    found = [
        Comparison({"thesis": Estimate(2e-3, 1e-3), "encoder": Estimate(error, 1e-4)}, 1e-4)
        for error in (3e-4, -1e-4)
    ]
    thesis, ours = estimator_rows(Arm("vertical", 245), found)
    assert (thesis.estimator, ours.estimator, ours.trials) == ("thesis", "encoder", 2)
    assert thesis.mean_error_mm == pytest.approx(2.0)
    assert ours.mean_error_mm == pytest.approx(0.2)
    assert ours.bias_mm == pytest.approx(0.1)
    assert ours.ratio == pytest.approx(np.sqrt(5.0))
    assert ours.covered == 0.5


def test_the_trials_of_an_arm_depend_on_its_seed_alone() -> None:
    rows = arm_rows(Arm("vertical", 171), 1, NoiseChoice("x5", off=("base-shake",)), 0)
    assert rows == arm_rows(Arm("vertical", 171), 1, NoiseChoice("x5", off=("base-shake",)), 0)
    by_name = {row.estimator: row for row in rows}
    assert set(by_name) == set(VARIANTS)
    assert by_name["encoder"].mean_error_mm < 0.6 < by_name["thesis"].mean_error_mm


def test_estimates_that_err_more_or_claim_too_little_are_not_seen() -> None:
    def row(estimator: str, rms_mm: float, covered: float) -> EstimatorRow:
        return EstimatorRow(
            "vertical", 171, estimator, 5, rms_mm, 0.0, rms_mm, 0.1, 0.1, rms_mm / 0.1, covered
        )

    def outcome(rms_mm: float, covered: float) -> str:
        horizontal = [each._replace(alignment="horizontal") for each in (row("thesis", 2.0, 1.0),)]
        own = row("encoder", rms_mm, covered)
        return ESTIMATORS.result(
            [[row("thesis", 2.0, 1.0), own], [*horizontal, own._replace(alignment="horizontal")]]
        ).outcome

    assert outcome(0.1, 0.8) == "seen"
    assert outcome(0.1, 0.7) == outcome(2.1, 0.8) == "seen in part"
    assert outcome(2.1, 0.7) == "not seen"

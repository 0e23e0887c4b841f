"""The comparison of estimators: what they make of one recording, the table, and the command."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from coordinator.excitation.plan import Plan
from module_agent.estimate.windows import JointWindow
from sim.commands.estimators import estimator_table
from sim.imperfections.noise_profile import NOISE_PROFILES, switched
from sim.main import app
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import sensing_chain
from sim.scoring.chain_score import link_length_m
from sim.test_bench.one_joint_rig import OneJointRig
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
    assert estimator_table([thesis, ours]).row_count == 2


def test_the_command_prints_the_table_and_writes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = Arm("vertical", 171)
    monkeypatch.setattr("sim.commands.estimators.ARMS", (arm,))
    file = tmp_path / "table.json"
    arguments = [
        "estimators",
        "--trials",
        "1",
        "--processes",
        "1",
        "--without",
        "base-shake",
        "--json",
        str(file),
    ]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "171 mm vertical" in result.output
    written = json.loads(file.read_text(encoding="utf-8"))
    assert written["settings"]["without"] == ["base-shake"]
    rows = {row["estimator"]: EstimatorRow(**row) for row in written["rows"]}
    assert set(rows) == set(VARIANTS)
    assert rows["encoder"].mean_error_mm < 0.6 < rows["thesis"].mean_error_mm


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--noise", "loud"], "unknown noise profile 'loud'"),
        (["--without", "rain"], "unknown effect 'rain'"),
        (["--json", "/no/such/folder/x.json"], "there is no folder /no/such/folder"),
    ],
)
def test_wrong_usage_says_what_is_wrong(arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(app, ["estimators", *arguments])
    assert result.exit_code == 2
    assert words in result.output

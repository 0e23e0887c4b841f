"""What is written of a fit: torques as they were predicted, and matrices from which anybody can go on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.arm_fit.fit_dynamics import ArmFit, fit_dynamics
from coordinator.arm_fit.predictions import write_matrices, write_predictions
from coordinator.arm_fit.problem import ModelChoice


@pytest.fixture(scope="module")
def fit(recording: Any) -> ArmFit:
    return fit_dynamics(
        recording.urdf, recording.npz, choice=ModelChoice(coupled=((1, 2),), tried=()), cutoff_hz=10.0
    )


def test_the_file_of_torques_has_the_errors_of_the_report(fit: ArmFit, tmp_path: Path) -> None:
    write_predictions(tmp_path / "torques.csv", fit.torques)
    table = np.genfromtxt(tmp_path / "torques.csv", delimiter=",", names=True)
    assert table.dtype.names[:6] == (
        *("t_s", "piece", "tau_waist_nm", "tau_waist_filtered_nm"),
        *("tau_waist_fitted_nm", "tau_waist_held_out_nm"),
    )
    np.testing.assert_allclose(np.diff(table["t_s"]), 1.0 / fit.report.recording.kept_hz, rtol=1e-4)
    # The low-pass loses two periods of 10 Hz.
    assert table["t_s"][0] == pytest.approx(0.2)
    error = next(e for e in fit.report.errors("fitted") if (e.tried_on, e.samples) == ("both", "all"))
    for i, joint in enumerate(("waist", "elbow", "wrist")):
        tau, held_out = table[f"tau_{joint}_filtered_nm"], table[f"tau_{joint}_held_out_nm"]
        tested = ~np.isnan(held_out)
        assert 0 < (~tested).sum() <= fit.report.recording.kept_hz * 0.25
        off = np.linalg.norm((held_out - tau)[tested]) / np.linalg.norm(tau[tested])
        assert off == pytest.approx(error.per_joint[i], rel=1e-4)
        # A fit to the whole is no worse than one to a half.
        assert np.linalg.norm((table[f"tau_{joint}_fitted_nm"] - tau)[tested]) < 1.01 * off * np.linalg.norm(
            tau[tested]
        )


def test_the_matrices_are_those_of_the_report(fit: ArmFit, tmp_path: Path) -> None:
    write_matrices(tmp_path / "fit.npz", fit.base)
    with np.load(tmp_path / "fit.npz") as file:
        parts = fit.report.fit.base_parameters
        assert file["summary"].tolist() == [part.summary for part in parts]
        np.testing.assert_allclose(np.sqrt(np.diagonal(file["covariance"])), [part.sigma for part in parts])
        assert file["grouping"].shape == (fit.report.fit.rank, fit.report.fit.parameters)
        assert file["parameters"][-1] == "Fc2+3"

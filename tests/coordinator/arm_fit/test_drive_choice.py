"""Terms that are tried: kept where they are true, with their value, and left out where they are not."""

from typing import Any

import numpy as np
import pytest

from coordinator.arm_fit.cross_validation import fit_part
from coordinator.arm_fit.data_file import read_log
from coordinator.arm_fit.drive_choice import candidates, choose_drives, pairs
from coordinator.arm_fit.filtered_log import filtered_log
from coordinator.arm_fit.problem import ModelChoice, Problem, problem
from coordinator.description.urdf_reader import read_urdf
from tests.coordinator.arm_fit.conftest import Recorded, recorded


def posed(some: Recorded, choice: ModelChoice) -> Problem:
    robot = read_urdf(some.urdf)
    log = filtered_log(read_log(some.npz, robot.chain.serials), 10.0)
    return problem(robot, log, choice._replace(extra=candidates(choice, 3)))


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return recorded(tmp_path_factory.mktemp("loaded"), load=(0.0, 0.25, 0.1))


def test_friction_that_grows_with_the_load_and_a_shared_drive_are_found(loaded: Recorded) -> None:
    chosen, trials = choose_drives(posed(loaded, ModelChoice(tried=("load",))))
    assert {drive.name for drive in chosen.choice.extra} == {"Fl2", "Fl3"}
    assert chosen.choice.coupled == ((1, 2),)
    assert next(trial.name for trial in trials if trial.kept).endswith("2+3")
    fit = fit_part(chosen, slice(0, len(chosen.log.tau_nm)))
    for name, truth in (("Fl2", 0.25), ("Fl3", 0.1), ("Fc2", 1.2), ("Fv3", 0.3)):
        at = chosen.columns.names.index(name)
        # 3 standard deviations, and 2 % for the plain sign, which the model rounds at reversals.
        assert abs(fit.parameters[at] - truth) < 3.0 * np.sqrt(fit.covariance[at, at]) + 0.02 * truth, name


def test_terms_that_are_not_there_are_left_out(recording: Any) -> None:
    chosen, trials = choose_drives(posed(recording, ModelChoice(tried=("load", "asymmetry"))))
    assert chosen.choice.extra == ()
    assert not any(trial.kept for trial in trials if "+" not in trial.name)
    for trial in trials:
        assert (trial.after is None) == (trial.chance >= 0.01)


def test_the_model_is_linearised_at_the_parameters(loaded: Recorded) -> None:
    some = posed(loaded, ModelChoice(coupled=(), tried=("load",)))
    whole, step = slice(0, 200), 1e-5
    x = 0.1 + 0.01 * np.arange(len(some.columns.names))
    slope, shift = some.linearised(x, some.regressor[whole])
    np.testing.assert_allclose(slope @ x - shift, some.predicted(x, whole))
    for column in (0, 13, 25, *(column for column, _ in some.loads)):
        change = step * np.eye(len(x))[column]
        numeric = (some.predicted(x + change, whole) - some.predicted(x - change, whole)) / (2.0 * step)
        np.testing.assert_allclose(slope[..., column], numeric, atol=1e-6)


def test_given_drives_are_not_tried() -> None:
    assert pairs(ModelChoice(coupled=()), 3) == ()
    assert pairs(ModelChoice(), 3) == ((0, 1), (1, 2))
    only = candidates(ModelChoice(terms=("load",), coupled=(), tried=("load", "stribeck")), 2)
    assert [drive.name for drive in only] == ["Fs1", "Fs2"]

"""What a known robot weighs, read from the folder of a run."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from coordinator.baseline.baseline_robot import BaselineError
from coordinator.excitation.plan import Plan
from coordinator.identification.identified import Identified
from coordinator.identification.identify import identify
from coordinator.identification.result import write_result
from coordinator.recording.run_folder import RESULT
from coordinator.recording.versions import Versions
from coordinator.torque_control.gravity_model import gravity_model
from module_agent.model.regressor import inverse_dynamics
from module_agent.network_emulation.profile import PROFILES
from sim.robot.robot_file import load_robot
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session


@cache
def identified() -> Identified:
    """Return what a short session on an upright arm finds out."""
    plan = Plan(imu="calibrated", sine_centre_s=1.4, sine_sigma_s=0.5, rest_s=1.0, dynamic_repeats=2)
    robot = load_robot("thesis_484_vertical")
    return identify(record_session(VirtualSettings(robot, PROFILES["lan"], 3, "x5"), plan))


def written(folder: Path, **changes: object) -> Path:
    write_result(folder / RESULT, identified().result)
    if changes:
        document = json.loads((folder / RESULT).read_text())
        document.update(changes)
        (folder / RESULT).write_text(json.dumps(document))
    return folder


def test_the_weight_read_back_is_that_of_the_real_bodies_that_were_found(tmp_path: Path) -> None:
    model, found = gravity_model(written(tmp_path)), identified()
    assert model.chain.serials == found.kinematics.fit.chain.serials
    assert model.types == tuple(found.result.types[s] for s in model.chain.serials)
    assert found.real_phi is not None
    q, rate = np.array([0.3, -0.4]), np.array([0.5, 1.0])
    wanted = inverse_dynamics(
        found.kinematics.fit.chain, found.real_phi, q[None], rate[None], np.zeros((1, 2))
    )
    # Through centres and inertias about them and back, in decimal.
    np.testing.assert_allclose(model.effort_nm(q, rate), wanted[0], atol=1e-9)


def test_the_weight_of_the_upright_arm_is_what_the_simulated_one_weighs(tmp_path: Path) -> None:
    from sim.robot.robot_tree import true_chain, true_inertia

    robot = load_robot("thesis_484_vertical")
    q = np.array([[0.3, 0.0]])
    still = np.zeros((1, 2))
    true = inverse_dynamics(true_chain(robot), true_inertia(robot), q, still, still)[0]
    found = gravity_model(written(tmp_path)).effort_nm(q[0], still[0])
    assert abs(true[0]) > 0.5
    # The motions were short, and the torque sensor's scale is only as known as it is.
    np.testing.assert_allclose(found[0], true[0], rtol=0.1)


def test_the_next_start_takes_the_version_of_the_model_that_holds_now(
    known_folder: Callable[..., Path],
) -> None:
    folder = known_folder("thesis_171_horizontal")
    first, versions = gravity_model(folder), Versions(folder)
    document = json.loads((folder / RESULT).read_text())
    document["dynamics"]["phi"] = (2.0 * first.phi).tolist()
    versions.next_run().mkdir(parents=True)
    (versions.run_folder(2) / RESULT).write_text(json.dumps(document))
    assert np.array_equal(gravity_model(folder).phi, first.phi)
    versions.replace(2, "2026-01-05T10:00:00+00:00", ["a payload stays"], ["twice as heavy"])
    assert np.array_equal(gravity_model(folder).phi, 2.0 * first.phi)
    versions.choose(1, "2026-01-05T11:00:00+00:00")
    assert np.array_equal(gravity_model(folder).phi, first.phi)


def test_a_run_without_dynamics_does_not_tell_the_weight(tmp_path: Path) -> None:
    with pytest.raises(BaselineError, match=r"has no inertial parameters: the run had --no-dynamics"):
        gravity_model(written(tmp_path, dynamics=None))


def test_a_model_that_is_not_believed_is_taken_only_on_demand(tmp_path: Path) -> None:
    folder = written(tmp_path, suspicions=["X-1: its IMU is sick"])
    with pytest.raises(BaselineError, match=r"not to be believed as usual: X-1: its IMU is sick\. Identify"):
        gravity_model(folder)
    assert list(gravity_model(folder, suspect=True).chain.serials) == identified().result.serials


def test_a_folder_without_a_result_or_with_another_file_in_its_place_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BaselineError, match=r"holds no result.json: give the folder of a run that has"):
        gravity_model(tmp_path)
    (tmp_path / RESULT).write_text("{}")
    with pytest.raises(BaselineError, match=r"result.json is no result of a run: robot: is missing"):
        gravity_model(tmp_path)

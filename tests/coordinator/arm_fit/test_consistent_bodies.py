"""Real bodies from a recording, and the URDF that has them: both predict what the torques were."""

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from coordinator.arm_fit.consistent_bodies import (
    USUAL_TRUST,
    ConsistentBodies,
    NoPriorError,
    consistent_bodies,
    lacking,
    urdf_drives,
    urdf_prior,
)
from coordinator.arm_fit.cross_validation import (
    by_consistent_bodies,
    by_urdf,
    fit_part,
    fitted,
    held_out_errors,
    overall,
)
from coordinator.arm_fit.data_file import read_log
from coordinator.arm_fit.filtered_log import filtered_log
from coordinator.arm_fit.problem import ModelChoice, Problem, problem
from coordinator.description.urdf_reader import read_urdf
from coordinator.description.urdf_update import fitted_urdf_text
from coordinator.dynamics.pseudo_inertia import is_consistent, pseudo_inertia

SHARED = ModelChoice(coupled=((1, 2),), tried=())


@pytest.fixture
def wrong(recording: Any, tmp_path: Path) -> Path:
    """The robot's URDF with masses that are half as large again, a comment, and a plate fixed to the hand."""
    text: str = recording.urdf.read_text()
    for mass in ("3.0", "2.0"):
        assert f'<mass value="{mass}"/>' in text
        text = text.replace(f'<mass value="{mass}"/>', f'<mass value="{1.5 * float(mass)}"/>')
    plate = (
        '<!-- the plate --><link name="plate"><inertial><mass value="0.1"/><inertia ixx="1e-4" ixy="0" '
        'ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial></link><joint name="screw" type="fixed">'
        '<parent link="hand"/><child link="plate"/><origin xyz="0 0 0.1"/></joint></robot>'
    )
    path = tmp_path / "wrong.urdf"
    path.write_text(text.replace("</robot>", plate))
    return path


def found_in(urdf: Path, npz: Path) -> tuple[Problem, ConsistentBodies]:
    robot = read_urdf(urdf)
    posed = problem(robot, filtered_log(read_log(npz, robot.chain.serials), 8.0), SHARED)
    fit = fit_part(posed, slice(0, len(posed.log.tau_nm)))
    return posed, consistent_bodies(posed, fit, urdf_prior(robot), USUAL_TRUST)


def test_bodies_from_wrong_masses_can_exist_and_explain_the_torques(recording: Any, wrong: Path) -> None:
    posed, found = found_in(wrong, recording.npz)
    for phi in found.phi.reshape(-1, 10):
        assert is_consistent(pseudo_inertia(phi))
    free = overall(held_out_errors(posed, fitted(posed)))[0]
    prior = urdf_prior(posed.robot)
    real = overall(held_out_errors(posed, by_consistent_bodies(posed, prior, USUAL_TRUST)))[0]
    # What bodies may cost: 0.1 percentage points.
    assert real < free + 1e-3
    # The wrong masses themselves are off by far more.
    assert posed.robot.phi is not None
    claimed = posed.regressor[..., : posed.inertial] @ (posed.robot.phi - found.phi)
    assert np.linalg.norm(claimed) > 0.1 * np.linalg.norm(posed.log.tau_nm)


def test_the_fitted_urdf_gives_another_program_the_same_torques(
    recording, wrong: Path, tmp_path: Path
) -> None:
    posed, found = found_in(wrong, recording.npz)
    out = tmp_path / "fitted.urdf"
    whole = slice(0, len(posed.log.tau_nm))
    x = np.concatenate([found.phi, found.drives])
    drives = urdf_drives(posed, x, whole)
    out.write_text(fitted_urdf_text(posed.robot, found.bodies, drives, lacking(posed)), encoding="utf-8")
    model = pin.buildModelFromUrdf(str(out))
    data = model.createData()
    log = posed.log
    for k in range(0, len(log.q_rad), 200):
        theirs = pin.rnea(model, data, log.q_rad[k], log.qd_rad_s[k], log.qdd_rad_s2[k])
        ours = posed.regressor[k, :, : posed.inertial] @ found.phi
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-9 * np.abs(ours).max())
    rng = np.random.default_rng(1)
    for q in rng.uniform(-3.0, 3.0, (200, 3)):
        assert np.linalg.eigvalsh(pin.crba(model, data, q))[0] > 0.0
    text = out.read_text()
    assert "the plate" in text
    # The plate is within the hand.
    assert text.count("<inertial>") == 3
    assert f'damping="{float(drives[0][1])!r}"' in text
    assert "not in this file: offset1, offset2, offset3, Ia2+3, Fv2+3, Fc2+3." in text
    # Of the robot in conftest.py: 0.8 Nm s/rad and 1.5 Nm at the waist.
    assert drives[0][1:] == pytest.approx((0.8, 1.5), rel=0.02)
    assert not list(tmp_path.glob("*.part"))
    again = read_urdf(out)
    assert again.phi is not None
    np.testing.assert_allclose(again.phi, found.phi, atol=1e-9)
    np.testing.assert_allclose(again.drives, drives, atol=1e-12)
    # Written again, nothing is doubled.
    twice = fitted_urdf_text(again, found.bodies, drives)
    assert twice.count("<drake:rotor_inertia") == twice.count("<transmission") == 3


def test_a_urdf_alone_predicts_as_well_as_the_fit_if_it_can_hold_it(recording: Any) -> None:
    robot = read_urdf(recording.urdf)
    log = filtered_log(read_log(recording.npz, robot.chain.serials), 8.0)
    # Torques without the shared drive and without offsets.
    shared = problem(robot, log, SHARED)
    fit = fit_part(shared, slice(0, len(log.tau_nm)))
    x = np.where([name in lacking(shared) for name in shared.columns.names], fit.parameters, 0.0)
    plain = log._replace(tau_nm=log.tau_nm - shared.regressor @ x)
    posed = problem(robot, plain, ModelChoice(coupled=(), tried=()))
    prior = urdf_prior(robot)
    bodies, alone = (
        overall(held_out_errors(posed, by(posed, prior, USUAL_TRUST)))
        for by in (by_consistent_bodies, by_urdf)
    )
    assert alone == pytest.approx(bodies, rel=0.05)
    # What a URDF has no place for costs it more than a tenth of the torque here.
    without = overall(held_out_errors(shared, by_urdf(shared, prior, USUAL_TRUST)))
    assert without[0] > 10.0 * alone[0]


def test_where_torques_are_silent_a_body_is_as_claimed(recording: Any) -> None:
    posed, found = found_in(recording.urdf, recording.npz)
    assert posed.robot.phi is not None
    # The first joint stands upright: its body's mass and centre have no effect on any torque.
    np.testing.assert_allclose(found.phi[:4], posed.robot.phi[:4], rtol=1e-3)
    # True masses claimed and true torques: hardly anything is to be moved.
    assert found.divergence.max() < 0.1


def test_a_claim_of_bodies_that_cannot_exist_is_made_real(recording: Any, tmp_path: Path) -> None:
    text: str = recording.urdf.read_text()
    path = tmp_path / "thin.urdf"
    # No triangle of moments: 0.9 is more than the sum of the others.
    path.write_text(text.replace('ixx="0.02"', 'ixx="0.9"', 1))
    robot = read_urdf(path)
    assert robot.phi is not None
    assert not is_consistent(pseudo_inertia(robot.phi[:10]))
    for pseudo in urdf_prior(robot):
        assert is_consistent(pseudo)


def test_a_body_without_mass_is_named(recording: Any, tmp_path: Path) -> None:
    text: str = recording.urdf.read_text()
    path = tmp_path / "light.urdf"
    path.write_text(text.replace('<mass value="2.0"/>', '<mass value="0"/>'))
    with pytest.raises(NoPriorError, match="gives no mass to 'fore'"):
        urdf_prior(read_urdf(path))

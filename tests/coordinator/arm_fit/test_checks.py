"""Recordings that are not what their columns are called: each is refused by name and number."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.arm_fit.checks import wrong_motion
from coordinator.arm_fit.data_file import DataFileError, JointLog, read_log
from coordinator.arm_fit.fit_dynamics import fit_dynamics
from coordinator.arm_fit.problem import ModelChoice
from coordinator.description.urdf_reader import read_urdf
from module_agent.model.regressor import inverse_dynamics

TX40 = Path(__file__).resolve().parents[3] / ".." / "shared" / "data" / "tx40"
SHARED = ModelChoice(coupled=((1, 2),), tried=())


def refusal(urdf: Path, log: JointLog, choice: ModelChoice = SHARED, **options: Any) -> str:
    with pytest.raises(DataFileError) as raised:
        fit_dynamics(urdf, log, choice=choice, **{"cutoff_hz": 10.0, **options})
    return str(raised.value)


@pytest.fixture(scope="module")
def log(recording: Any) -> JointLog:
    return read_log(recording.npz, read_urdf(recording.urdf).chain.serials)


def test_degrees_are_refused_for_the_joints_that_have_them(recording: Any, log: JointLog) -> None:
    q = log.q_rad.copy()
    q[:, 2] = np.degrees(q[:, 2])
    text = refusal(recording.urdf, log._replace(q_rad=q))
    assert text.count("\n") == 0
    assert text.startswith(f"{recording.npz}: position_rad of wrist: up to {np.abs(q[:, 2]).max():.4g} rad")
    assert "the URDF allows 3 rad and 9 rad/s" in text
    assert "degrees must be multiplied by pi / 180" in text


def test_milliseconds_are_refused(recording: Any, log: JointLog) -> None:
    text = refusal(recording.urdf, log._replace(rate_hz=0.4, file="log.csv"))
    assert text.startswith("log.csv: column t_s: a sample every 2.5 s")
    assert "milliseconds must be divided by 1000" in text


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (57.29578, "57.3 times the derivative .* degrees per second"),
        (-1.0, "-1 times the derivative .* opposite sign"),
        (0.001, "0.001 times the derivative .* per ms"),
        (
            1.3,
            "1.3 times the derivative of its position, correlation 1.00; rad/s of the same joint are needed$",
        ),
    ],
)
def test_a_velocity_that_is_not_the_derivative_is_refused(
    recording: Any, log: JointLog, factor: float, words: str
) -> None:
    qd = np.gradient(log.q_rad, axis=0) * log.rate_hz
    robot = read_urdf(recording.urdf)
    assert not list(wrong_motion(robot, log._replace(qd_rad_s=qd)))
    qd[:, 1] *= factor
    with pytest.raises(DataFileError, match=f"velocity_rad_s of elbow: {words}"):
        fit_dynamics(recording.urdf, log._replace(qd_rad_s=qd), choice=SHARED, cutoff_hz=10.0)


@pytest.mark.parametrize("joints", [[0], [1], [2], [0, 1, 2]])
def test_a_flipped_sign_is_refused_joint_by_joint(recording: Any, log: JointLog, joints: list[int]) -> None:
    tau = log.tau_nm.copy()
    tau[:, joints] *= -1.0
    lines = refusal(recording.urdf, log._replace(tau_nm=tau)).split("\n")
    names = [("waist", "elbow", "wrist")[j] for j in joints]
    assert [line.split(" of ")[1].split(":")[0] for line in lines] == names
    assert all("W to the motion; the sign of the torque is flipped" in line for line in lines)


def test_torques_without_friction_show_a_flipped_sign_by_the_masses(recording: Any, log: JointLog) -> None:
    robot = read_urdf(recording.urdf)
    assert robot.phi is not None
    qd = np.gradient(log.q_rad, axis=0) * log.rate_hz
    tau = inverse_dynamics(robot.chain, robot.phi, log.q_rad, qd, np.gradient(qd, axis=0) * log.rate_hz)
    text = refusal(recording.urdf, log._replace(tau_nm=-tau))
    assert "negate the tau columns" in text


def test_another_direction_of_gravity_is_refused_with_the_right_one(recording: Any, log: JointLog) -> None:
    text = refusal(recording.urdf, log, gravity=(9.81, 0.0, 0.0))
    assert "given is (9.81, 0, 0): the base is mounted otherwise" in text
    shown = np.array([float(x) for x in text.split("--gravity ")[1].split(" ")[0].split(",")])
    np.testing.assert_allclose(shown, [0.0, 0.0, 9.81], atol=0.3)


def test_currents_are_refused(recording: Any, log: JointLog) -> None:
    text = refusal(recording.urdf, log._replace(tau_nm=0.05 * log.tau_nm))
    assert "the tau columns are 0.05 times the torque [Nm] of those masses; currents need --gain" in text


def test_a_recording_too_short_is_refused(recording: Any, log: JointLog) -> None:
    short = log._replace(q_rad=log.q_rad[:700], tau_nm=log.tau_nm[:700])
    assert "half of 1.75 s it does not turn both ways; the recording is too short" in refusal(
        recording.urdf, short
    )
    # It may be fitted all the same.
    fit_dynamics(recording.urdf, short, choice=SHARED, cutoff_hz=10.0, checked=False)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        ("none", ""),
        ("milliseconds", "t_s or sample_rate_hz: a sample every 0.2 s"),
        ("degrees", "position_rad of joint_1: up to 120 rad"),
        ("flipped", "torque of joint_1: its friction would add"),
        ("one flipped", "torque of joint_6: its friction would add"),
    ],
)
def test_the_staubli_tx40_is_refused_under_wrong_names_only(damage: str, words: str) -> None:
    if not TX40.is_dir():
        pytest.skip("the data of the Staubli TX40 is not next to the project")
    log = read_log(TX40 / "motion.npz", [f"joint_{i}" for i in range(1, 7)])
    log = {
        "none": log,
        "milliseconds": log._replace(rate_hz=log.rate_hz / 1000.0),
        "degrees": log._replace(q_rad=np.degrees(log.q_rad)),
        "flipped": log._replace(tau_nm=-log.tau_nm),
        "one flipped": log._replace(tau_nm=log.tau_nm * [1, 1, 1, 1, 1, -1]),
    }[damage]
    choice, options = ModelChoice(coupled=((4, 5),), tried=()), {"cutoff_hz": 16.0}
    if words:
        assert words in refusal(TX40 / "tx40.urdf", log, choice, **options)
    else:
        fit_dynamics(TX40 / "tx40.urdf", log, choice=choice, **options)
        fit_dynamics(TX40 / "tx40.urdf", log, **options)

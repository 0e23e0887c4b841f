"""Several recordings in one fit, joints that stand still, grippers, and currents in the place of torques."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.arm_fit.data_file import DataFileError, JointLog, read_log
from coordinator.arm_fit.fit_dynamics import fit_dynamics
from coordinator.arm_fit.problem import ModelChoice
from coordinator.arm_fit.recordings import read_recordings
from coordinator.description.urdf_reader import read_urdf
from module_agent.model.errors import UsageError
from tests.coordinator.arm_fit.conftest import JOINTS, RATE_HZ, recorded

SHARED = ModelChoice(coupled=((1, 2),), tried=())
FINGER = """<link name="finger"><inertial><mass value="0.4"/><origin xyz="0 0 0"/>
<inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial></link>
<joint name="grip" type="prismatic"><parent link="hand"/><child link="finger"/><axis xyz="0 1 0"/></joint>
</robot>"""


def test_two_recordings_of_two_rates_are_one_fit(recording: Any, another: Any) -> None:
    robot = read_urdf(recording.urdf)
    slow = JointLog(RATE_HZ / 2.0, another.q_rad[::2], None, another.tau_nm[::2])
    both = read_recordings(robot, [str(recording.npz), slow], {}, checked=True)
    assert both.log.rate_hz == RATE_HZ
    assert len(both.log.breaks) == 1
    assert both.log.duration_s == pytest.approx(34.0, abs=0.02)
    assert both.log.file == f"{recording.npz}, a recording in memory"
    options = {"choice": SHARED, "cutoff_hz": 10.0}
    one, two = (
        fit_dynamics(recording.urdf, data, **options).report
        for data in (recording.npz, [recording.npz, another.npz])
    )
    assert two.recording.pieces == 2
    assert two.fit.independent_samples > 1.2 * one.fit.independent_samples
    sigmas = [{part.name: part.sigma for part in report.fit.drives} for report in (one, two)]
    assert sigmas[1]["Fc1"] < sigmas[0]["Fc1"]


def test_a_joint_that_stands_still_is_held(tmp_path: Path) -> None:
    some = recorded(tmp_path, still=(0,))
    fit = fit_dynamics(some.urdf, some.npz, choice=SHARED, cutoff_hz=10.0)
    assert fit.report.recording.joints == ["elbow", "wrist"]
    assert fit.report.recording.held == {"waist": pytest.approx(0.3)}
    assert fit.report.fit.coupled == [["elbow", "wrist"]]
    values = {part.name: (part.value, part.sigma) for part in fit.report.fit.drives}
    for name, truth in (("Fv1", 0.6), ("Fc2", 0.5), ("Fc1+2", 0.4)):
        assert abs(values[name][0] - truth) < 4.0 * values[name][1] + 0.005, name
    assert fit.urdf is not None
    assert 'name="waist"' in fit.urdf
    moved = recorded(tmp_path, seed=5)
    with pytest.raises(UsageError, match=r"position_rad of waist: .* it stood still in the other recording"):
        fit_dynamics(
            some.urdf,
            recorded(tmp_path, still=(0,)).npz,
            held_out=JointLog(RATE_HZ, moved.q_rad, None, moved.tau_nm, file="b.npz"),
            cutoff_hz=10.0,
        )
    with pytest.raises(UsageError, match="no joint moves by more than"):
        fit_dynamics(some.urdf, recorded(tmp_path, still=(0, 1, 2)).npz)


def test_a_gripper_is_fixed_where_it_was_recorded(recording: Any, tmp_path: Path) -> None:
    path = tmp_path / "gripper.urdf"
    path.write_text(recording.urdf.read_text().replace("</robot>", FINGER))
    columns = [*(f"q_{j}_rad" for j in JOINTS), *(f"tau_{j}_nm" for j in JOINTS)]
    values = [recording.q_rad, recording.tau_nm]
    for extra, position in (([], 0.0), (["q_grip_m"], 0.04)):
        table = np.column_stack(
            [
                np.arange(len(recording.q_rad)) / RATE_HZ,
                *values,
                *[np.full(len(recording.q_rad), position) for _ in extra],
            ]
        )
        np.savetxt(
            tmp_path / "log.csv",
            table,
            delimiter=",",
            header=",".join(["t_s", *columns, *extra]),
            comments="",
        )
        found = read_recordings(read_urdf(path), [tmp_path / "log.csv"], {}, checked=True)
        assert found.robot.held == {"grip": pytest.approx(position)}
        assert found.robot.chain.serials == JOINTS
    np.savez(
        tmp_path / "log.npz",
        sample_rate_hz=RATE_HZ,
        joint_names=np.array(["grip", *JOINTS]),
        position_rad=np.column_stack([np.full(len(recording.q_rad), 0.02), recording.q_rad]),
        torque=np.column_stack([np.zeros(len(recording.q_rad)), recording.tau_nm]),
    )
    found = read_recordings(read_urdf(path), [tmp_path / "log.npz"], {}, checked=True)
    assert found.robot.held == {"grip": pytest.approx(0.02)}
    np.testing.assert_array_equal(found.log.tau_nm, recording.tau_nm)


def test_a_rail_that_moves_is_not_taken_as_fixed(recording: Any, tmp_path: Path) -> None:
    """It slides, and so has no place in the model: its motion would count as something else."""
    path = tmp_path / "rail.urdf"
    path.write_text(recording.urdf.read_text().replace("</robot>", FINGER))
    swing = 0.6 * np.sin(3.0 * np.arange(len(recording.q_rad)) / RATE_HZ)
    np.savez(
        tmp_path / "log.npz",
        sample_rate_hz=RATE_HZ,
        joint_names=np.array(["grip", *JOINTS]),
        position_rad=np.column_stack([swing, recording.q_rad]),
        torque=np.column_stack([np.zeros(len(recording.q_rad)), recording.tau_nm]),
    )
    with pytest.raises(UsageError, match=r"joint 'grip' moves by 1\.2 \(rad or m\), and is taken as fixed"):
        read_recordings(read_urdf(path), [tmp_path / "log.npz"], {}, checked=True)


def test_currents_become_torques_by_their_constants(recording: Any, tmp_path: Path) -> None:
    gains = {"elbow": 8.5, "waist": -12.0}
    current = recording.tau_nm / [gains["waist"], gains["elbow"], 1.0]
    columns = [*(f"q_{j}_rad" for j in JOINTS), "i_waist_a", "i_elbow_a", "tau_wrist_nm"]
    table = np.column_stack([np.arange(len(current)) / RATE_HZ, recording.q_rad, current])[:400]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(["t_s", *columns]), comments="")
    np.savez(
        tmp_path / "log.npz",
        sample_rate_hz=RATE_HZ,
        position_rad=recording.q_rad[:400],
        torque=recording.tau_nm[:400],
        current_a=current[:400],
    )
    for name in ("log.csv", "log.npz"):
        log = read_log(tmp_path / name, JOINTS, gains)
        np.testing.assert_allclose(log.tau_nm, recording.tau_nm[:400], atol=1e-9)
    with pytest.raises(DataFileError, match=r"no column tau_waist_nm.*i_waist_a needs --gain waist=NM_PER_A"):
        read_log(tmp_path / "log.csv", JOINTS)
    with pytest.raises(UsageError, match="gain of 'hip': the joints are waist, elbow, wrist"):
        read_recordings(read_urdf(recording.urdf), [tmp_path / "log.csv"], {"hip": 1.0}, checked=True)

"""The example scripts do what they say, in a process of their own and in another folder."""

import csv
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from coordinator import (
    denavit_hartenberg,
    export_hrdf,
    export_urdf,
    forward_kinematics,
    identify,
    inverse_dynamics,
    load_recording,
    load_run,
    read_urdf,
)
from coordinator.baseline.baseline_robot import BaselineError
from module_agent.model.forward_kinematics import imu_poses
from module_agent.model.perturbation import apply_perturbation
from sim import simulate

# Tests of this file share one run: they stay in one process.
pytestmark = pytest.mark.xdist_group("examples")

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
EXAMPLES = ROOT / "docs" / "examples"
ROBOT = "thesis_171_horizontal"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with dynamics, in virtual time."""
    out = tmp_path_factory.mktemp("examples") / "run"
    simulate(ROBOT, noise="x5", seed=1, out=out)
    return out


def run(tmp_path: Path, script: str, *arguments: str, warned: str = "") -> str:
    environment = {**os.environ, "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(EXAMPLES / script), *arguments]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert warned in done.stderr
    return done.stdout


def test_the_torque_of_a_joint_is_plotted(tmp_path: Path, folder: Path) -> None:
    run(tmp_path, "plot_torque.py", str(folder), "X-00010", "torque.png")
    assert (tmp_path / "torque.png").read_bytes().startswith(b"\x89PNG")


def test_the_readmes_lines_plot_a_joint_of_ones_own_run_in_under_15(tmp_path: Path, folder: Path) -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)
    assert len(block.splitlines()) < 15
    script = tmp_path / "readme.py"
    script.write_text(block.replace("runs/demo", str(folder)).replace('"elbow"', '"X-00010"'))
    run(tmp_path, str(script))
    assert (tmp_path / "elbow.png").stat().st_size > 10_000


def test_poses_are_printed_with_their_sigmas(tmp_path: Path, folder: Path) -> None:
    printed = run(tmp_path, "pose_with_covariance.py", str(folder))
    assert len(re.findall(r"X-00010 at \(.*\) mm, sigma \d+\.\d\d mm", printed)) == 5
    assert "not observable" in printed


def test_the_largest_effort_of_every_motion_is_printed(tmp_path: Path, folder: Path) -> None:
    printed = run(tmp_path, "effort_by_motion.py", str(folder))
    motions = load_run(folder).recording.motions("windowed_sine")
    for event in motions:
        assert event.motion is not None
        assert re.search(rf"^.*\b{event.motion.motion_id}\b.*\d\.\d+$", printed, flags=re.MULTILINE)
    assert len(motions) >= 2


def test_a_run_is_a_data_frame_in_one_line(folder: Path) -> None:
    frame = load_run(folder).frame()
    signals = load_run(folder).signals("X-00010")
    of_module = frame[frame["module"] == "X-00010"]
    np.testing.assert_array_equal(of_module["position_rad"], signals.position_rad)
    np.testing.assert_array_equal(of_module["t_s"], signals.t_s)


def test_gravity_torques_are_printed_over_a_turn_of_a_joint(tmp_path: Path, folder: Path) -> None:
    assert len(run(tmp_path, "gravity_torques.py", str(folder), "X-00010").splitlines()) == 10


def test_torques_of_a_suspect_run_come_with_the_reason(tmp_path: Path, folder: Path) -> None:
    document = json.loads((folder / "result.json").read_text()) | {"suspicions": ["a clock jumped"]}
    (tmp_path / "result.json").write_text(json.dumps(document))
    why = "not to be believed as usual: a clock jumped"
    assert len(run(tmp_path, "gravity_torques.py", str(tmp_path), "X-00010", warned=why).splitlines()) == 10
    assert repr(load_run(tmp_path)).endswith(", suspect)")
    assert load_run(folder).suspicions == ()


def test_a_simulated_robot_is_identified_and_compared_with_the_truth(tmp_path: Path) -> None:
    printed = run(tmp_path, "identify_simulated.py", ROBOT)
    (error_mm,) = map(float, re.findall(r"off by ([+-]\d+\.\d\d) mm", printed))
    # Modules as delivered: their IMUs are anywhere within a millimetre (one sigma) of their places.
    assert abs(error_mm) < 3.0


def test_ones_own_arm_is_fitted_from_urdf_and_log(tmp_path: Path, folder: Path) -> None:
    """The log is of the identified robot itself, rigid and with a little noise: the fit predicts it."""
    saved = load_run(folder)
    assert saved.phi is not None
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 12.0, 0.004)[:, None]
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    rates, size = 2.0 * np.pi * np.array([0.3, 0.7, 1.3]), np.array([0.5, 0.3, 0.15])

    def derivative(order: int) -> np.ndarray:
        angles = t[:, :, None] * rates + phases + 0.5 * np.pi * order
        return np.asarray(np.sum(size * rates**order * np.sin(angles), axis=2))

    q, qd, qdd = (derivative(order) for order in range(3))
    tau = inverse_dynamics(saved.chain, saved.phi, q, qd, qdd) + rng.normal(0.0, 0.002, q.shape)
    joints = read_urdf(folder / "robot.urdf").chain.serials
    log = tmp_path / "log.csv"
    with log.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t_s", *(f"{k}_{s}_{u}" for k, u in (("q", "rad"), ("tau", "nm")) for s in joints)])
        writer.writerows(np.column_stack([t, q, tau]).tolist())
    printed = run(tmp_path, "fit_own_arm.py", str(folder / "robot.urdf"), str(log), "fitted.urdf")
    assert "torque error" in printed
    assert (tmp_path / "fitted.urdf").stat().st_size > 0


# ---------------------------------------------------------------------- the library itself


def test_a_recording_is_identified_again_with_the_same_result(folder: Path) -> None:
    again = identify(load_recording(folder))
    assert again.result.trace_hash == load_run(folder).result.trace_hash
    assert again.result.links == load_run(folder).result.links


def test_signals_of_all_modules_share_a_time_base(folder: Path) -> None:
    saved = load_run(folder)
    for serial in saved.serials:
        signals = saved.signals(serial)
        assert np.all(np.diff(signals.t_s) > 0.0)
        assert np.median(np.diff(signals.t_s)) == pytest.approx(0.004, rel=1e-3)
        assert signals.gyro_rad_s.shape == (len(signals.t_s), 3)
    assert saved.held_out is not None
    last = saved.signals(saved.serials[-1])
    # The held-out motion is part of the recording: its positions are the encoder's there.
    measured = np.interp(saved.held_out.t_s, last.t_s, last.position_rad)
    np.testing.assert_allclose(saved.held_out.position_rad[:, -1], measured, atol=2e-3)


def test_the_covariance_of_a_pose_is_that_of_perturbed_chains(folder: Path) -> None:
    saved = load_run(folder)
    q = np.array([[0.3, -0.8]])
    poses = forward_kinematics(saved, q)
    assert poses.covariance is not None
    draws = np.random.default_rng(5).multivariate_normal(
        np.zeros(len(saved.covariance)), saved.covariance, 4000, method="eigh"
    )
    places = [imu_poses(apply_perturbation(saved.chain, d), q)[0, -1, :3, 3] for d in draws]
    # The sample variance of 4000 draws scatters by 2.2 %; 10 % is beyond four of its sigmas.
    sampled = np.trace(np.cov(np.array(places).T))
    assert np.trace(poses.covariance[0, -1, 3:, 3:]) == pytest.approx(sampled, rel=0.1)


def test_an_exported_urdf_is_read_back_with_its_masses(tmp_path: Path, folder: Path) -> None:
    saved = load_run(folder)
    export_urdf(saved, tmp_path / "robot.urdf")
    export_hrdf(saved, tmp_path / "robot.hrdf")
    robot = read_urdf(tmp_path / "robot.urdf")
    assert saved.phi is not None
    assert robot.phi is not None
    masses = np.asarray(robot.phi).reshape(-1, 10)[:, 0]
    np.testing.assert_allclose(masses, np.asarray(saved.phi).reshape(-1, 10)[:, 0], rtol=1e-6)
    assert (tmp_path / "robot.hrdf").read_text().startswith("<?xml")


def test_denavit_hartenberg_rows_name_the_joints(folder: Path) -> None:
    saved = load_run(folder)
    assert {row.serial for path in denavit_hartenberg(saved) for row in path.rows} <= {*saved.serials, ""}


def test_what_is_not_there_is_named(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(BaselineError, match=r"holds no result\.json"):
        load_run(tmp_path)
    with pytest.raises(KeyError, match="X-00009, X-00010"):
        load_run(folder).signals("elbow")
    with pytest.raises(ValueError, match="2 modules is \\(12, 12\\)"):
        forward_kinematics(load_run(folder), np.zeros((1, 2)), np.eye(3))

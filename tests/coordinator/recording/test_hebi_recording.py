"""A log of HEBI's programs is as good as the same session recorded by this one, where it holds enough."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify_kinematics
from coordinator.main import app
from coordinator.recording.hebi_recording import LoggedModule, recorded_log
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import load_recording
from coordinator.synchronisation.round_trips import map_clocks
from module_agent.hardware.hebi_log import HebiLogError
from module_agent.model.chain import Chain
from tests.rig import Rig

Log = SimpleNamespace
FIELDS = {
    "position_rad": "position",
    "velocity_rad_s": "velocity",
    "effort_nm": "effort",
    "position_command_rad": "position_command",
    "velocity_command_rad_s": "velocity_command",
    "effort_command_nm": "effort_command",
    "deflection_rad": "deflection",
    "motor_velocity_rad_s": "motor_velocity",
    "motor_current_a": "motor_winding_current",
    "winding_temperature_c": "motor_winding_temperature",
    "voltage_v": "voltage",
    "pwm": "pwm_command",
    "gyro_rad_s": "gyro",
    "accel_m_s2": "accelerometer",
}


def as_log(session: Recording, rng: np.random.Generator) -> Log:
    """Return the rows of a recording as `hebi.util.load_log` returns them: a message has one of each module.

    Requests and answers take some 0.2 ms, and one in a hundred 50 ms more.
    """
    modules = list(session.modules.values())
    clocks = map_clocks({each.serial: each.round_trips for each in modules})
    rows = [each.rows.rows(0, each.rows.end_row) for each in modules]
    count = min(map(len, rows))
    rows = [each[:count] for each in rows]
    read_ns = [clocks[m.serial].to_session(each["t_ns"]) for m, each in zip(modules, rows, strict=True)]
    way_us = 100.0 + rng.exponential(50.0, (2, count, 2)) + 5e4 * (rng.random((2, count, 2)) < 0.01)
    columns = {
        "hardware_transmit_time_us": np.stack([each["t_ns"] // 1000 for each in rows], axis=1),
        "transmit_time_us": 1e-3 * np.stack(read_ns, axis=1) + 1e12 - way_us[0],
        "receive_time_us": 1e-3 * np.stack(read_ns, axis=1) + 1e12 + way_us[1],
    }
    columns |= {name: np.stack([each[ours] for each in rows], axis=1) for ours, name in FIELDS.items()}
    return Log(number_of_modules=len(rows), **columns)


def relative_poses(chain: Chain) -> np.ndarray:
    """Return the poses (n - 1, 4, 4) of every IMU in the one before it, with all joints at zero."""
    return np.linalg.inv(chain.imu_home[:-1]) @ chain.imu_home[1:]


def load(log: Log) -> Callable[[str], Any]:
    """Return what opens this log."""
    names = [name for name in vars(log) if name != "number_of_modules"]
    count = len(log.position)
    fed = [Log(**{name: getattr(log, name)[k] for name in names}) for k in range(count)]
    return lambda path: Log(number_of_modules=log.number_of_modules, feedback_iterate=fed)


def imported(log: Log, names: tuple[str, ...] = ("lower", "upper")) -> Recording:
    """Return the recording of a log as it is read from its file."""
    modules = [LoggedModule(name, kind) for name, kind in zip(names, ("X5-9-old", "X5-9"), strict=False)]
    recording = Recording()
    for entry in recorded_log(Path("arm.hebilog"), "arm", modules, load(log), ("calibrated", "uncalibrated")):
        recording.add(entry)
    return recording


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A simulated robot that moves both its joints at once, after a rest."""
    rig = Rig("thesis_171_vertical", "none", 1)
    out = tmp_path_factory.mktemp("logged") / "run"
    rig.session(out, Plan(mode="simultaneous", dynamics=False, imu="calibrated"))
    rig.close()
    return load_recording(out / "session.mcap")


@pytest.fixture
def log(session: Recording) -> Log:
    return as_log(session, np.random.default_rng(3))


def test_the_robot_of_a_log_is_the_robot_of_the_same_session(session: Recording, log: Log) -> None:
    direct, found = identify_kinematics(session), identify_kinematics(imported(log))
    assert found.topology.serials == ("lower", "upper")
    assert found.topology.reversed == direct.topology.reversed
    # The same samples with other times, which the round trips tell to hundredths of a sample's period.
    ours, theirs = (relative_poses(one.fit.chain) for one in (direct, found))
    np.testing.assert_allclose(theirs[:, :3, 3], ours[:, :3, 3], atol=3e-4)
    np.testing.assert_allclose(theirs[:, :3, :3], ours[:, :3, :3], atol=2e-3)


def test_the_command_writes_a_recording_that_is_replayed(
    log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coordinator.commands.import_log.log_loader", lambda: load(log))
    out = tmp_path / "run"
    command = ["import", "arm.hebilog", "--type", "X5-9-old", "--type", "X5-9", "--out", str(out)]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert f"x5-coordinator replay {out}" in done.output
    recording = load_recording(out / "session.mcap")
    assert not recording.remarks
    assert not recording.damage
    assert [event.purpose for event in recording.latest_motions("rest", "whole")] == 2 * ["rest"] + 2 * [
        "whole"
    ]
    assert {serial: len(one.round_trips) > 100 for serial, one in recording.modules.items()} == {
        "module-1": True,
        "module-2": True,
    }


def test_what_the_log_lacks_is_named(log: Log) -> None:
    with pytest.raises(HebiLogError, match="it has 2 modules, 1 are named"):
        imported(log, ("lower",))
    log.effort[7, 1] = np.nan
    with pytest.raises(HebiLogError, match="sample 8 of upper: effort is not set"):
        imported(log)


def test_accelerometers_without_gravity_are_noticed(log: Log) -> None:
    log.accelerometer[:, 1] *= 0.01
    with pytest.raises(HebiLogError, match=r"of upper reads 0\.10 m/s.2 at rest.*accel_includes_gravity"):
        imported(log)


def test_a_joint_that_stands_still_is_named_and_so_is_a_log_without_rest(log: Log) -> None:
    upper = log.position[:, 1].copy()
    log.position[:, 1] = upper[0]
    with pytest.raises(HebiLogError, match=r"upper turns by 0\.000 rad in the best motion, from "):
        imported(log)
    log.position[:, 1] = upper[0] + 0.1 * np.sin(0.05 * np.arange(len(upper)))
    with pytest.raises(HebiLogError, match="let them stand still first"):
        imported(log)

"""A session that designs its motions by what it sees keeps to the modules' limits, its time and its word."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from coordinator.excitation.plan import Plan
from coordinator.recording.run_folder import load_recording
from module_agent.model.catalogue import module_type
from sim.scoring.score import score

Rigs = Callable[..., Any]


def test_four_joints_are_explored_in_ten_seconds_each_within_what_they_can_do(
    rigs: Rigs, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    plan = Plan(motions="optimised", dynamics=False, imu="calibrated", settle_s=0.3)
    result = rigs("a2085_04", "lan", 1).session(out, plan)
    assert result.robot_time_s < 10.0 * len(result.serials)
    found = score(out)
    assert found.topology_differences == []
    assert found.tip_position_rms_mm is not None
    # The bar for four joints with calibrated IMUs is 1 mm; links that give are part of this robot.
    assert found.tip_position_rms_mm < 2.0
    recording = load_recording(out / "session.mcap")
    for serial, record in recording.modules.items():
        rows = record.rows.rows(record.rows.first_row, record.rows.end_row)
        # What the sensor says of the speed is noise on top of it.
        assert abs(rows["velocity_rad_s"]).max() < module_type(result.types[serial]).max_speed_rad_s
    purposes = [e.purpose for e in recording.journal if e.what == "motion"]
    assert purposes.count("constant") == purposes.count("windowed_sine") == purposes.count("whole") == 4


def test_a_precision_that_is_asked_for_is_reached_by_repeats_or_it_is_said_how_far_it_got(
    rigs: Rigs, tmp_path: Path
) -> None:
    rig, out = rigs("thesis_171_vertical", "lan", 2), tmp_path / "run"
    plan = Plan(
        motions="optimised",
        dynamics=False,
        imu="calibrated",
        precision_mm=0.1,
        sine_centre_s=1.5,
        settle_s=0.3,
    )
    rig.session(out, plan)
    repeats = [e for e in load_recording(out / "session.mcap").journal if e.purpose == "repeat"]
    assert repeats
    said = [line for line in rig.notes if "mm asked for" in line]
    assert len(said) == 2
    for line in said:
        reached = float(line.partition("repeats, ")[2].split()[0])
        assert reached <= 0.1 or sum(e.serial in line for e in repeats) >= 1
    assert score(out).topology_differences == []

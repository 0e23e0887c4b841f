"""What `x5-coordinator follow` refuses before it joins a network."""

from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from coordinator.main import app

STILL = "t_s,q_elbow_rad\n0,0\n1,0\n2,0\n3,0\n"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--mode", "4"), "--mode 4: it must be 1, 2 or 3"),
        (("--rate", "5"), "--rate 5.0: it must be 50 to 1000 Hz"),
        (("--rate", "nan"), "--rate nan: it must be 50 to 1000 Hz"),
        (("--max-error", "0"), "--max-error 0.0: it must be 0.001"),
        (("--travel", "9"), "--travel 9.0: it must be 0.01 to 2 rad/s"),
        (("--out", "nowhere/follow.json"), "there is no folder nowhere"),
    ],
)
def test_wrong_usage_is_answered_with_what_is_right(
    known_folder: Callable[..., Path], tmp_path: Path, options: tuple[str, str], text: str
) -> None:
    (tmp_path / "m.csv").write_text(STILL)
    folder = str(known_folder("a2085_03"))
    done = CliRunner().invoke(app, ["follow", folder, "--motion", str(tmp_path / "m.csv"), *options])
    assert done.exit_code == 2, done.output
    assert text in done.output


def test_a_run_without_dynamics_and_another_robots_motion_are_refused(
    known_folder: Callable[..., Path], tmp_path: Path
) -> None:
    (tmp_path / "m.csv").write_text(STILL.replace("elbow", "knee"))
    motion = ("--motion", str(tmp_path / "m.csv"))
    done = CliRunner().invoke(app, ["follow", str(known_folder("a2085_03")), *motion])
    assert done.exit_code == 2
    assert "joint knee is not one of the robot's: shoulder-yaw, shoulder-lift, elbow" in done.output
    done = CliRunner().invoke(app, ["follow", str(known_folder("a2085_03", dynamics=None)), *motion])
    assert done.exit_code == 2
    assert "has no inertial parameters" in done.output
    suspect = str(known_folder("a2085_03", suspicions=["its IMU is sick"]))
    done = CliRunner().invoke(app, ["follow", suspect, *motion])
    assert done.exit_code == 2
    assert "not to be believed as usual: its IMU is sick. Identify the robot again" in done.output
    done = CliRunner().invoke(app, ["follow", suspect, *motion, "--suspect"])
    assert "joint knee is not one of the robot's" in done.output
    done = CliRunner().invoke(app, ["follow", str(tmp_path), *motion])
    assert done.exit_code == 2
    assert "holds no result.json" in done.output

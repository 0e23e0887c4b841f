"""`x5-coordinator follow` on world and agents as processes, over Zenoh."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from module_agent.model.errors import EXIT_SUSPECT

ROBOT = "thesis_171_horizontal"


@pytest.fixture
def follow(launcher, known_folder, tmp_path):
    """Start world and agents, and return what starts `follow` on them."""
    robot = launcher(ROBOT)
    robot.start_world()
    robot.start_agents()
    moving = robot.config.serials[0]
    path = tmp_path / "motion.csv"
    swing = [0.0, 0.0, 0.01, 0.03, 0.06, 0.08, 0.09, 0.09]
    path.write_text("\n".join([f"t_s,q_{moving}_rad", *(f"{k / 4},{q}" for k, q in enumerate(swing))]) + "\n")
    started = []

    def start(*options: str, **known: object) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "coordinator.main", "follow", str(known_folder(ROBOT, **known))),
                *("--motion", str(path), "--listen", robot.config.endpoint, "--network", "lan", *options),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def test_it_follows_in_all_modes_and_writes_what_it_measured(follow, tmp_path: Path, programs) -> None:
    out = tmp_path / "follow.json"
    # The model is that of a suspect run, which all that comes of it tells.
    process = follow("--out", str(out), "--suspect", suspicions=["its IMU is sick"])
    text, notes = process.communicate(timeout=programs.limit_s)
    assert process.returncode == EXIT_SUSPECT, notes
    assert "not to be believed as usual: its IMU is sick" in notes
    assert "Tracking error by input mode" in text
    result = json.loads(out.read_text())
    assert result["suspicions"] == ["its IMU is sick"]
    assert [one["mode"] for one in result["modes"]] == [1, 2, 3]
    for one in result["modes"]:
        # The motion is 0.09 rad long: a joint that stood still would be off by that.
        assert 0.0 < one["worst_rad"] < 0.06, one


def test_interrupted_it_stops_all_modules(follow, client, programs) -> None:
    process = follow()
    ear = client(ROBOT)

    def streams() -> bool:
        assert process.poll() is None, process.stderr.read()
        ear.pump()
        return any(3 in log.rows(log.first_row, log.end_row)["state"] for log in ear.rows.values())

    programs.until(streams, "streaming")
    process.send_signal(signal.SIGINT)
    _, notes = process.communicate(timeout=programs.limit_s)
    assert process.returncode == 130, notes
    assert "stopped: interrupted" in notes
    assert "Traceback" not in notes
    ear.until(lambda: {each[-1].state for each in ear.statuses.values()} == {"stopped"}, "a stop")

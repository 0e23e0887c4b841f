"""`x5-coordinator float` on world and agents as processes, over Zenoh."""

import json
import subprocess
import sys

import numpy as np
import pytest

ROBOT = "a2085_03"


@pytest.fixture
def floating(launcher, known_folder, tmp_path):
    """Start world and agents, and a float of what is known of them."""
    robot = launcher(ROBOT)
    robot.start_world()
    robot.start_agents()
    started = []

    def start(*options, folder=None):
        out = (tmp_path / "out.jsonl").open("wb")
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "coordinator.main", "compensate", str(folder or known_folder(ROBOT))),
                *("--listen", robot.config.endpoint, "--network", "lan", "--json", "-", *options),
            ],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append((process, out))
        return process

    yield start
    for process, out in started:
        if process.poll() is None:
            process.kill()
        process.communicate()
        out.close()


def lines(tmp_path):
    return [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]


def test_it_floats_until_interrupted_goes_back_with_its_weight_borne_and_lets_go(
    floating, client, programs, tmp_path
) -> None:
    process = floating()
    ear = client(ROBOT)

    def floats() -> bool:
        assert process.poll() is None, process.stderr.read()
        return any(line.get("phase") == "compensating" for line in lines(tmp_path))

    programs.until(floats, "compensating")
    process.terminate()
    assert process.wait(programs.limit_s) == 0, process.stderr.read()
    summary = lines(tmp_path)[-1]
    assert (summary["why"], summary["is_fault"]) == ("interrupted", False)
    assert [joint["serial"] for joint in summary["joints"]] == ["shoulder-yaw", "shoulder-lift", "elbow"]
    assert summary["compensated_s"] > 0.0
    ear.pump()
    for serial, log in ear.rows.items():
        rows = log.rows(log.first_row, log.end_row)
        streamed = rows[rows["state"] == 3]
        assert len(streamed), serial
        # Taken hold of, and on the way back, every joint is asked for its weight as floating it was.
        last_free = np.flatnonzero(np.isnan(streamed["position_command_rad"]))[-1]
        back = streamed[last_free + 1 :]
        assert len(back), serial
        assert np.isfinite(back["position_command_rad"]).all()
        assert np.isfinite(back["effort_command_nm"]).all()
    lift = ear.rows["shoulder-lift"]
    rows = lift.rows(lift.first_row, lift.end_row)
    free = rows[(rows["state"] == 3) & np.isnan(rows["position_command_rad"])]
    assert np.abs(free["effort_command_nm"]).min() > 0.3


def test_a_robot_with_a_module_too_few_is_not_taken_and_the_module_is_named(
    floating, known_folder, programs
) -> None:
    process = floating("--quiet", "--robot", ROBOT, folder=known_folder("a2085_04"))
    _, said = process.communicate(timeout=programs.limit_s)
    assert process.returncode == 1
    assert "module wrist is missing (1 of 4 are)" in said
    assert "Traceback" not in said

"""`x5-coordinator attend` with world and agents as processes, over Zenoh."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from coordinator.recording.run_folder import RESULT
from coordinator.recording.versions import Versions
from coordinator.runtime.terminal import Terminal
from module_agent.model.errors import EXIT_FINDING
from module_agent.wire.feedback_rows import STATE_NAMES
from sim.benchmark.cases.monitoring import Subject
from sim.robot.robot_file import load_robot
from sim.virtual_time.run import VirtualConfig, run_virtual

ROBOT, ARM = "thesis_171_horizontal", "a2085_03"
RANGE_RAD = 1.2
ROOM = f"""
trial_speed_rad_s = 1.0

[box]
low_m = [-1.0, -1.0, -0.9]
high_m = [1.0, 1.0, 1.1]

[joints]
all = [{-RANGE_RAD}, {RANGE_RAD}]
"""


class Attendant:
    """`attend` as a process; what it says comes as JSON lines."""

    def __init__(self, folder: Path, endpoint: str, heard: Path, *options: str):
        self._heard = heard
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "coordinator.main", "attend", str(folder)),
                *("--listen", endpoint, "--json", str(heard), *options),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    @property
    def heard(self) -> str:
        """All that it has said, a sentence a line."""
        lines = self._heard.read_text().splitlines() if self._heard.is_file() else []
        return "\n".join(json.loads(line).get("says", "") for line in lines)

    def said(self, words: str) -> bool:
        assert self.process.poll() is None, self.process.communicate()
        return words in self.heard

    def ends(self, how: signal.Signals, within_s: float) -> tuple[int, str, str]:
        """Send it a signal; return exit code, standard output and notes."""
        self.process.send_signal(how)
        text, notes = self.process.communicate(timeout=within_s)
        return self.process.returncode, text, notes


@pytest.fixture
def attend(tmp_path: Path) -> Iterator[Callable[..., Attendant]]:
    """Start an attendant; it does not outlive the test."""
    made: list[Attendant] = []

    def start(folder: Path, endpoint: str, *options: str) -> Attendant:
        made.append(Attendant(folder, endpoint, tmp_path / "heard.jsonl", *options))
        return made[-1]

    yield start
    for one in made:
        if one.process.poll() is None:
            one.process.kill()
            one.process.communicate()


def known_by_run(robot: str, out: Path) -> Path:
    """Identify a robot in virtual time, as a launch has it: with IMUs that are not calibrated."""
    plan = Subject(brief=True).plan.model_copy(update={"imu": "uncalibrated"})
    run_virtual(VirtualConfig(load_robot(robot), out, plan=plan), Terminal(True))
    return out


@pytest.fixture
def loses_last(launcher, client, programs, attend, tmp_path: Path):
    """An arm that is attended with leave to move, and whose last module has just died."""
    room = tmp_path / "room.toml"
    room.write_text(ROOM)
    robot = launcher(ARM, physics="compiled")
    robot.start_world()
    *others, last = robot.config.serials
    robot.start_agent(others)
    victim = robot.start_agent([last], 1)
    patient = tmp_path / "patient.toml"
    patient.write_text("retries = 5\n")
    options = ("--may-move", "--workspace", str(room), "--plan", str(patient))
    attendant = attend(known_by_run(ARM, tmp_path / "known"), robot.config.endpoint, *options)
    programs.until(lambda: attendant.said(f"attends {ARM}, version 1"), "the attendant")
    ear = client(ARM)
    ear.meet(robot.config.serials)
    victim.process.kill()
    victim.process.wait()
    programs.until(lambda: attendant.said("THE ROBOT MOVES"), "the announcement")
    assert attendant.said(f"module {last} has gone")
    return attendant, ear, others


def test_a_module_whose_agent_died_is_said_to_be_gone(launcher, programs, attend, tmp_path: Path) -> None:
    robot = launcher(ROBOT)
    robot.start_world()
    agents = dict(zip(robot.config.serials, robot.start_agents(), strict=True))
    attendant = attend(known_by_run(ROBOT, tmp_path / "known"), robot.config.endpoint, "--for", "3600")
    programs.until(lambda: attendant.said(f"attends {ROBOT}, version 1"), "the attendant")
    victim = robot.config.serials[-1]
    agents[victim].process.kill()
    agents[victim].process.wait()
    programs.until(lambda: attendant.said(f"module {victim} has gone"), "the news that a module is gone")
    code, text, notes = attendant.ends(signal.SIGTERM, programs.limit_s)
    assert code == EXIT_FINDING, notes
    assert "Traceback" not in notes
    assert f"module {victim} has gone" in text


def test_with_leave_to_move_the_robot_that_is_left_is_measured_and_a_version_written(
    loses_last, programs, tmp_path: Path
) -> None:
    attendant, ear, others = loses_last
    versions = Versions(tmp_path / "known")

    def measured() -> bool:
        ear.pump()
        assert not attendant.said("could not be measured"), attendant.heard
        return attendant.said("version 2 is the model from now on")

    programs.until(measured, "a new version")
    ear.until(lambda: {ear.statuses[s][-1].state for s in others} == {"idle"}, "modules at rest")
    code, text, notes = attendant.ends(signal.SIGINT, programs.limit_s)
    assert code == EXIT_FINDING, notes
    assert "Traceback" not in notes
    assert "every joint slowly" in text
    assert versions.current == tmp_path / "known" / "versions" / "0002"
    assert set(json.loads((versions.current / RESULT).read_text())["serials"]) == set(others)
    (entry,) = versions.history
    assert (entry.what, entry.version) == ("replaced", 2)
    for serial in others:
        rows = ear.rows[serial].rows(ear.rows[serial].first_row, ear.rows[serial].end_row)
        moved_rad = rows["position_rad"][rows["state"] == STATE_NAMES.index("moving")]
        # A joint that follows a motion of 1 rad/s is hardly 0.05 rad beyond it. A limp arm hangs outside its
        # range, comes in, and returns there.
        assert np.ptp(moved_rad) > 0.1
        assert moved_rad.max() < max(RANGE_RAD, moved_rad[0]) + 0.05
        assert moved_rad.min() > min(-RANGE_RAD, moved_rad[0]) - 0.05


def test_interrupted_while_it_measures_it_stops_the_robot(loses_last, programs, tmp_path: Path) -> None:
    attendant, ear, others = loses_last

    def moves() -> bool:
        ear.pump()
        return any(ear.statuses[serial][-1].state == "moving" for serial in others)

    programs.until(moves, "a motion")
    code, _, notes = attendant.ends(signal.SIGINT, programs.limit_s)
    assert code == EXIT_FINDING, notes
    assert "Traceback" not in notes
    ear.until(lambda: {ear.statuses[s][-1].state for s in others} == {"stopped"}, "a stop")
    versions = Versions(tmp_path / "known")
    assert versions.current_number == 1


def test_a_folder_without_a_run_and_an_unknown_version_are_refused(known_folder, tmp_path: Path) -> None:
    def attend(*words: str) -> "subprocess.CompletedProcess[str]":
        command = [sys.executable, "-m", "coordinator.main", "attend", *words]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    nothing = attend(str(tmp_path))
    assert nothing.returncode == 2
    assert "holds no result.json" in nothing.stderr
    known = known_folder(ROBOT)
    blind = attend(str(known), "--may-move")
    assert blind.returncode == 2
    assert "--workspace" in blind.stderr
    assert attend(str(known), "--use", "7").returncode == 2
    listed = attend(str(known), "--use", "1")
    assert listed.returncode == 0, listed.stderr
    assert "chosen" in listed.stdout

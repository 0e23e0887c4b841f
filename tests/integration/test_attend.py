"""`x5-coordinator attend` with world and agents as processes, over Zenoh."""

import json
import subprocess
import sys
from pathlib import Path

from coordinator.runtime.terminal import Terminal
from module_agent.model.errors import EXIT_FINDING
from sim.benchmark.cases.monitoring import Subject
from sim.robot.robot_file import load_robot
from sim.virtual_time.run import VirtualConfig, run_virtual

ROBOT = "thesis_171_horizontal"


def test_a_module_whose_agent_died_is_said_to_be_gone(launcher, programs, tmp_path: Path) -> None:
    known, heard = tmp_path / "known", tmp_path / "heard.jsonl"
    plan = Subject(brief=True).plan
    run_virtual(VirtualConfig(load_robot(ROBOT), known, seed=1, noise="x5", plan=plan), Terminal(True))
    robot = launcher(ROBOT)
    robot.start_world()
    agents = dict(zip(robot.config.serials, robot.start_agents(), strict=True))
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "coordinator.main", "attend", str(known), "--for", "3600"),
            *("--listen", robot.config.endpoint, "--json", str(heard)),
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )

    def said(words: str) -> bool:
        assert process.poll() is None, process.stderr.read()
        lines = heard.read_text().splitlines() if heard.is_file() else []
        return any(words in json.loads(line).get("says", "") for line in lines)

    try:
        programs.until(lambda: said(f"attends {ROBOT}, version 1"), "the attendant")
        victim = robot.config.serials[-1]
        agents[victim].process.kill()
        agents[victim].process.wait()
        programs.until(lambda: said(f"module {victim} has gone"), "the news that a module is gone")
        process.terminate()
        text, notes = process.communicate(timeout=programs.limit_s)
        assert process.returncode == EXIT_FINDING, notes
        assert "Traceback" not in notes
        assert f"module {victim} has gone" in text
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


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

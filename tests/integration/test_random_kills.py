"""A process killed at a random instant of a run: a named end, a readable recording, and a run that resumes.

`X5_KILLS=100` kills as many by seed, the suite two. `X5_KILLS_SPEED=0.3` is for a machine that is busy.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from coordinator.recording.run_folder import RESULT, SESSION, load_recording
from module_agent.model.errors import EXIT_FAILED, EXIT_LOST
from sim.processes.launcher import LOGS, Child, Launcher
from sim.scoring.score import score
from tests.integration.conftest import MARK, marked_processes

KILLS, SPEED = int(os.environ.get("X5_KILLS", "2")), float(os.environ.get("X5_KILLS_SPEED", "1.0"))
VICTIMS = ("coordinator", "agent", "world", "launcher")
# A recording with the short plan takes some twelve seconds.
LATEST_S = 11.0
# What an agent says of a world that has been killed.
ENDS = "the modules are gone", "no world listens on", "does not welcome this agent"


def launch(robot: Launcher, log: Path) -> Child:
    """Launch the same as `robot` would, by a program of its own."""
    config = robot.config
    command = [sys.executable, "-m", "sim.main", "run", config.robot_file, "--viewer", "none"]
    command += ["--out", str(config.out), "--listen", config.endpoint, "--network", config.network]
    with log.open("wb") as output:
        options = [*command, "--speed", str(SPEED), *config.coordinator_options]
        return Child("launcher", subprocess.Popen(options, stdout=output, stderr=subprocess.STDOUT), log)


def kill_at(victim: Child, others: Child, session: Path, after_s: float) -> None:
    """Kill a process at a time since there is a recording, or when the others have ended."""
    begun_s = None
    while others.process.poll() is None and (begun_s is None or time.monotonic() < begun_s + after_s):
        if begun_s is None and session.exists():
            begun_s = time.monotonic()
        time.sleep(0.05)
    victim.process.kill()
    victim.process.wait()


def living() -> set[int]:
    """Return the numbers of the processes that this test has started, at any depth, and that live."""
    return {int(line.split(":")[0]) for line in marked_processes(os.environ[MARK])}


def check_end(robot: Launcher, ended: Child, said: str, killed: Child) -> None:
    """Check the exit code of a run of which a process was killed against the table in docs/guide.md."""
    code = ended.process.returncode
    assert "Traceback" not in said
    if (robot.config.out / RESULT).exists():
        # All had been recorded, and perhaps computed, before the kill.
        assert code in ((0, -signal.SIGKILL) if ended is killed else (0,)), said
    elif ended is killed:
        assert code == -signal.SIGKILL
    else:
        # What follows it is how to go on.
        last = [line for line in said.splitlines() if line.startswith("x5-coordinator: ")][-1]
        serials = robot.config.serials
        lost = [serial for serial in serials if f"module {serial} is lost: " in last]
        assert code == (EXIT_LOST if lost else EXIT_FAILED), said
        # From the first step on it is known who takes part, and so who is missing.
        begun = any(event.what == "begin" for event in load_recording(robot.config.out / SESSION).journal)
        assert lost or not begun, said
        assert lost or any(serial in last for serial in serials) or "module expected, found " in last, said
        assert killed.name == "world" or all(killed.name == f"agent {serial}" for serial in lost), said


def check_robot(robot: Launcher) -> None:
    """Check that the result is the true robot, and that no process has died of a defect."""
    found = score(robot.config.out)
    assert found.topology_correct, found.topology_differences
    (link,) = found.links
    assert link.link_length_error_mm is not None
    assert link.link_length_sigma_mm is not None
    # Within the claim, and the claim within twice what the short plan claims of this link, 1.7 mm.
    assert abs(link.link_length_error_mm) <= 5.0 * link.link_length_sigma_mm
    assert link.link_length_sigma_mm <= 0.02 * link.link_length_true_mm
    check_logs(robot)


def check_logs(robot: Launcher) -> None:
    for log in (robot.config.out / LOGS).iterdir():
        assert "Traceback" not in log.read_text(errors="replace"), log


@pytest.mark.parametrize("seed", range(KILLS))
def test_a_random_kill_has_a_named_end_and_the_run_resumes(
    launcher, programs, nothing_is_left, tmp_path, seed: int
) -> None:
    draw = np.random.default_rng(seed)
    robot, which = launcher(), VICTIMS[int(draw.integers(len(VICTIMS)))]
    robot.config = robot.config._replace(speed=SPEED)
    session, after_s = robot.config.out / SESSION, float(draw.uniform(0.0, LATEST_S)) / SPEED
    if which == "launcher":
        launched = launch(robot, tmp_path / "launch.log")
        kill_at(launched, launched, session, after_s)
        check_end(robot, launched, (tmp_path / "launch.log").read_text(), killed=launched)
        programs.until(lambda: not living(), "the end of all that it had launched")
        # Only who is killed outright leaves the folder of its bus.
        for folder in nothing_is_left.glob("x5-*"):
            shutil.rmtree(folder)
    else:
        world, agents = robot.start_world(), robot.start_agents()
        coordinator = robot.start_coordinator(quiet=True)
        victim = {"coordinator": coordinator, "agent": agents[int(draw.integers(2))], "world": world}[which]
        kill_at(victim, coordinator, session, after_s)
        said = programs.ended(coordinator)[1]
        check_end(robot, coordinator, said, victim)
        if which == "world":
            # Without a body there is no module: its agent says so and ends.
            for agent in agents:
                code, words = programs.ended(agent)
                assert code == EXIT_LOST, words
                # On a busy machine the world may be killed before an agent has found it, or as it comes.
                assert any(end in words for end in ENDS), words
            left = set()
        else:
            # Modules outlive their coordinator and one another: motors off, they wait for the next one.
            left = {world.process.pid, *(agent.process.pid for agent in agents)} - {victim.process.pid}
        programs.until(lambda: living() == left, f"just {left} of {marked_processes(os.environ[MARK])}")
    recording = load_recording(session)
    assert recording.damage == []
    robot.stop()
    assert all(child.process.poll() is not None for child in robot.children)
    check_logs(robot)
    if (robot.config.out / RESULT).exists():
        # A world that was killed leaves no truth to compare with.
        if which != "world":
            check_robot(robot)
        return

    # The same robot again; what has been done is not repeated.
    done = {event.step for event in recording.journal if event.what == "done" and "explore" in event.step}
    again = Launcher(robot.config, lambda text: None)
    try:
        again.start_world()
        again.start_agents()
        code, said = programs.ended(again.start_coordinator(["--resume"], quiet=True))
    finally:
        again.stop()
    assert code == 0, said
    whole = load_recording(session)
    assert (whole.damage, whole.remarks) == ([], [])
    # One that was killed within a fifth of a second has not written that it had begun.
    before, after = (sum(e.what == "session" for e in each.journal) for each in (recording, whole))
    assert after == before + 1
    assert done <= {event.step for event in whole.journal if event.what == "done"}
    check_robot(again)

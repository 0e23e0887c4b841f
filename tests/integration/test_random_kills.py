"""A process killed at a random instant of a run: a named end, a readable recording, and a run that resumes.

`X5_KILLS=100` kills as many by seed, the suite two. `X5_KILLS_SPEED=0.3` is for a machine that is busy.
"""

import os
import time

import numpy as np
import pytest

from coordinator.recording.run_folder import SESSION, load_recording
from module_agent.model.errors import EXIT_FAILED, EXIT_LOST
from sim.processes.launcher import Child, Launcher

KILLS, SPEED = int(os.environ.get("X5_KILLS", "2")), float(os.environ.get("X5_KILLS_SPEED", "1.0"))
VICTIMS = ("coordinator", "agent", "world")
# A run with the short plan takes some fourteen seconds.
LATEST_S = 12.0


def started(robot: Launcher) -> tuple[Child, list[Child], Child]:
    """World, agents and a coordinator."""
    world = robot.start_world()
    return world, robot.start_agents(), robot.start_coordinator(quiet=True)


@pytest.mark.parametrize("seed", range(KILLS))
def test_a_random_kill_has_a_named_end_and_the_run_resumes(launcher, programs, seed: int) -> None:
    draw = np.random.default_rng(seed)
    robot, which = launcher(), VICTIMS[int(draw.integers(len(VICTIMS)))]
    robot.config = robot.config._replace(speed=SPEED)
    world, agents, coordinator = started(robot)
    victim = {"coordinator": coordinator, "agent": agents[int(draw.integers(2))], "world": world}[which]
    end_s = time.monotonic() + float(draw.uniform(2.0, LATEST_S)) / SPEED
    session = robot.config.out / SESSION
    while coordinator.process.poll() is None and (time.monotonic() < end_s or not session.exists()):
        time.sleep(0.05)
    victim.process.kill()
    victim.process.wait()

    if which != "coordinator":
        code, said = programs.ended(coordinator)
        # Lost, or of modules that are there not all were found to begin with.
        assert code in (0, EXIT_FAILED, EXIT_LOST), said
        assert "Traceback" not in said
        assert code == 0 or any(serial in said for serial in robot.config.serials) or "module" in said
    recording = load_recording(session)
    assert recording.damage == []
    robot.stop()
    assert all(child.process.poll() is not None for child in robot.children)
    if (robot.config.out / "result.json").exists():
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
    assert [event.what for event in whole.journal].count("session") == 2
    assert done <= {event.step for event in whole.journal if event.what == "done"}

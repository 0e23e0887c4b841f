"""An agent that dies in the middle of a motion."""

from coordinator.recording.run_folder import load_recording


def test_a_killed_agent_is_named_and_what_it_did_until_then_is_kept(launcher, client, programs) -> None:
    robot = launcher()
    config = robot.config
    victim, survivor = reversed(config.serials)
    robot.start_world()
    agents = dict(zip(config.serials, robot.start_agents(), strict=True))
    coordinator = robot.start_coordinator(quiet=True)
    ear = client(config.robot_name)
    motion = ear.motion(victim, "windowed_sine", 100, coordinator)
    agents[victim].process.kill()
    agents[victim].process.wait()
    heard_row = ear.rows[victim].end_row

    code, said = programs.ended(coordinator)
    assert code == 3
    assert f"module {victim} is lost" in said
    assert str(config.out) in said
    assert "Traceback" not in said

    recording = load_recording(config.out / "session.mcap")
    log = recording.modules[victim].rows
    assert log.end_row >= heard_row
    rows = log.rows(motion.start_row, heard_row)
    assert len(rows) == heard_row - motion.start_row
    assert set(rows["motion_id"].tolist()) == {motion.motion_id}
    assert recording.journal[-1].what == "failed"
    assert victim in recording.journal[-1].text

    # The coordinator was the hub; with another one the module that lives tells that it was stopped.
    ear.close()
    status = client(config.robot_name, hub=True).status(survivor)
    assert status.state == "stopped"
    assert victim in status.note

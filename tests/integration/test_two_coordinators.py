"""A second coordinator comes to a robot that is taken."""

from coordinator.recording.run_folder import load_recording
from sim.scoring.score import score


def test_the_second_coordinator_is_told_who_holds_the_robot_and_disturbs_nothing(
    launcher, client, programs, plan, tmp_path, through_driver
) -> None:
    robot = launcher(hebi=through_driver)
    config = robot.config
    robot.start_world()
    # The second one starts as soon as the first holds the robot, for over half a minute.
    lasting = tmp_path / "lasting.toml"
    lasting.write_text(plan.read_text().replace("sine_centre_s = 1.4", "sine_centre_s = 6.0"))
    robot.start_agents()
    first = robot.start_coordinator(["--plan", str(lasting)], quiet=True)
    ear = client(config.robot_name)

    def held(serial: str) -> bool:
        return any(status.holder is not None for status in ear.statuses.get(serial, ())[-1:])

    ear.until(lambda: all(held(serial) for serial in config.serials), "a robot that is held", first)
    second = programs.run(
        "coordinator.main",
        *("run", "--out", str(tmp_path / "second"), "--robot", config.robot_name),
        *("--listen", config.endpoint, "--plan", str(plan), "--no-dynamics"),
    )
    assert first.process.poll() is None, "the second one must come while the first one works"
    assert second.returncode == 1
    assert f"held by coordinator-{first.process.pid}@" in second.stderr
    assert "Traceback" not in second.stderr

    code, said = programs.ended(first)
    assert code == 0, said
    robot.stop()
    journal = load_recording(config.out / "session.mcap").journal
    assert [event for event in journal if "stop" in event.text] == []
    assert score(config.out).topology_correct
    ear.pump()
    holders = {s.holder for serial in config.serials for s in ear.statuses[serial] if s.holder is not None}
    assert len(holders) == 1
    assert "stopped" not in {s.state for serial in config.serials for s in ear.statuses[serial]}

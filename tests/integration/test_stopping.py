"""People who stop things: Ctrl-C at the launcher, and the stop command."""

import json
import signal
import subprocess
import sys

from coordinator.recording.run_folder import load_recording
from sim.processes.launcher import Child

ROBOT = "thesis_171_horizontal"


def test_ctrl_c_stops_everything_and_keeps_what_was_recorded(
    client, programs, endpoint, plan, tmp_path
) -> None:
    out, log = tmp_path / "run", tmp_path / "log"
    command = [sys.executable, "-m", "sim.main", "launch", ROBOT, "--viewer", "none", "--no-dynamics"]
    command += ["--no-report"]
    with log.open("wb") as output:
        launch = subprocess.Popen(
            [*command, "--out", str(out), "--plan", str(plan), "--listen", endpoint],
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    ear = client(ROBOT)
    motion = ear.motion("X-00009", "windowed_sine", 100, Child("launch", launch, log))
    launch.send_signal(signal.SIGINT)
    assert launch.wait(programs.limit_s) == 130
    said = log.read_text()
    assert f"interrupted, everything is stopped; recorded up to here: {out}" in said
    assert "Traceback" not in said
    recording = load_recording(out / "session.mcap")
    rows = recording.modules["X-00009"].rows.rows(motion.start_row, motion.start_row + 100)
    assert len(rows) == 100
    assert (rows["motion_id"] == motion.motion_id).all()
    assert recording.journal[-1].what == "failed"
    # The truth up to the end too, for whoever examines the recording.
    assert (out / "truth.npz").is_file()


def test_whoever_says_stop_is_obeyed_by_the_modules_and_by_the_coordinator(
    launcher, client, programs, lasting_plan, through_driver
) -> None:
    robot = launcher(hebi=through_driver)
    config = robot.config
    robot.start_world()
    agents = robot.start_agents()
    # A long session: it must not come to its end by itself before it is stopped.
    coordinator = robot.start_coordinator(["--plan", str(lasting_plan)], quiet=True)
    ear = client(config.robot_name)
    ear.motion(config.serials[0], "windowed_sine", 50, coordinator)
    where = ("--robot", config.robot_name, "--listen", config.endpoint)

    listed = programs.run("coordinator.main", "list", "--json", "-", *where)
    assert listed.returncode == 0, listed.stderr
    modules = json.loads(listed.stdout)
    assert [m["serial"] for m in modules] == sorted(config.serials)
    assert all(m["holder"].startswith(f"coordinator-{coordinator.process.pid}@") for m in modules)
    assert {m["state"] for m in modules} <= {"armed", "moving"}
    assert all(m["feedback_delay"]["messages"] > 10 for m in modules)
    assert all(m["cpu_us_per_message"] > 0.0 for m in modules)

    stopped = programs.run("coordinator.main", "stop", *where)
    assert stopped.returncode == 0, stopped.stderr
    code, said = programs.ended(coordinator)
    assert code == 1
    assert "was stopped by" in said
    assert "Traceback" not in said
    ear.close()

    witness = client(config.robot_name, hub=True)
    witness.meet(config.serials, *agents)
    for serial in config.serials:
        assert witness.status(serial).state == "stopped"
    # Nobody has armed it again in between.
    journal = load_recording(config.out / "session.mcap").journal
    assert journal[-1].what == "failed"
    assert [event for event in journal if "stop" in event.text and event.what == "note"] == []


def test_a_run_whose_output_nothing_reads_any_more_ends_as_with_a_closed_terminal(programs, tmp_path) -> None:
    """As by `x5-sim run ... 2>&1 | head -1`."""
    command = [sys.executable, "-m", "sim.main", "run", ROBOT, "--virtual", "--no-dynamics", "--no-report"]
    run = subprocess.Popen(
        [*command, "--out", str(tmp_path / "run")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # Started by nohup it would outlive its terminal.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )
    assert run.stderr is not None
    # Before it has found the modules there is nothing to stop.
    assert any(line.startswith("[2/") for line in iter(run.stderr.readline, ""))
    run.stderr.close()
    assert run.wait(programs.limit_s) == 130
    (failed,) = [e for e in load_recording(tmp_path / "run" / "session.mcap").journal if e.what == "failed"]
    assert failed.text == "stopped: interrupted"
    assert failed.deaf == ()

"""What `x5-sim` says when it cannot work, how a virtual run is interrupted, and how processes are watched."""

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from coordinator.excitation.plan import Plan
from coordinator.recording.run_folder import SESSION, load_recording
from coordinator.recording.session_file import read_session
from coordinator.runtime.event_loop import Interruption
from module_agent.wire.codec import decode
from module_agent.wire.messages import Ack
from sim.main import app
from sim.processes.launcher import LOGS, Child, LaunchConfig, Launcher, LaunchError
from sim.robot.robot_file import load_robot
from sim.virtual_time.robot import VirtualRobot
from sim.virtual_time.run import VirtualConfig, run_virtual
from sim.world.truth import read_truth

ROBOT = "thesis_171_horizontal"


# --------------------------------------------------------------------------- wrong usage


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run", ROBOT, "--seed", "-1"), "greater than or equal to 0"),
        (("run", ROBOT, "--speed", "0"), "speed 0.0: it must be a positive number"),
        (("run", ROBOT, "--virtual", "--noise", "loud"), "unknown noise profile 'loud'; known are ideal"),
        (("run", ROBOT, "--virtual", "--with", "wind"), "unknown effect 'wind'; known are friction"),
        (("launch", ROBOT, "--with", "heat", "--without", "heat"), "'heat' is switched both on and off"),
        (("launch", ROBOT, "--listen", "nonsense"), "endpoint 'nonsense': it must look like tcp/"),
        (("launch", ROBOT, "--viewer", "foo"), "--viewer foo: it must be none, spawn, serve or an address"),
        (("launch", ROBOT, "--processes", "0"), "greater than or equal to 1"),
    ],
)
def test_wrong_usage_is_answered_with_what_is_right_and_nothing_is_started(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    out = tmp_path / "run"
    done = CliRunner().invoke(app, [*arguments, "--out", str(out)])
    assert done.exit_code == 2, done.output
    assert words in done.output
    assert not out.exists()


SOFT = """
name = "soft"
[base.compliance]
mass_kg = 0.1
inertia = [1e-3, 1e-3, 1e-3, 0.0, 0.0, 0.0]
stiffness_nm_rad = [0.5, 0.5, 0.5]
[[module]]
serial = "A"
type = "X5-1"
parent = "base"
[[module]]
serial = "B"
type = "X5-1"
parent = "A"
link = { pose = { xyz_m = [0.0, 0.0, 0.5] } }
"""


@pytest.mark.parametrize("command", [("run", "--virtual"), ("launch",)])
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[default]\nposition_rad = [1.0, -1.0]\n", "limits.toml:2: default.position_rad: 1 .. -1"),
        ("[default]\n[module.X-9]\n", "limits.toml:2: module.X-9: the robot has no such module"),
        ("<group_safety><mstop><strategy>off</strategy></mstop></group_safety>", "1 values for 16 modules"),
        ("[default]\nposition_rad = [2.0, 3.0]\n", "the type's own range is -1.5708 .. 1.5708"),
    ],
)
def test_limits_that_cannot_be_are_refused_before_anything_is_started(
    tmp_path: Path, command: tuple[str, ...], text: str, words: str
) -> None:
    (tmp_path / "limits.toml").write_text(text)
    limits, out = str(tmp_path / "limits.toml"), str(tmp_path / "run")
    done = CliRunner().invoke(app, [*command, "snake16", "--safety", limits, "--out", out])
    assert done.exit_code == 2, done.output
    assert words in " ".join(done.output.split())
    assert not Path(out).exists()


@pytest.mark.parametrize("command", [("world", "--bus", "bus"), ("run", "--virtual", "--out", "run")])
def test_a_robot_too_soft_to_stand_is_wrong_usage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("soft.toml").write_text(SOFT)
    done = CliRunner().invoke(app, [command[0], "soft.toml", *command[1:]])
    assert done.exit_code == 2, done.output
    assert "'soft' falls over" in done.output
    assert "--without base-shake" in done.output


@pytest.mark.parametrize(
    "option", [("--speed", "0"), ("--speed", "nan"), ("--seed", "-1"), ("--noise", "loud")]
)
def test_a_world_that_cannot_run_leaves_no_socket(tmp_path: Path, option: tuple[str, str]) -> None:
    bus = tmp_path / "bus"
    done = CliRunner().invoke(app, ["world", ROBOT, "--bus", str(bus), *option])
    assert done.exit_code == 2, done.output
    assert not bus.exists()


def test_a_picture_in_an_unknown_format_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["show", ROBOT, "--out", str(tmp_path / "robot.foo")])
    assert done.exit_code == 2
    assert "Format 'foo' is not supported" in done.output
    assert "png" in done.output


@pytest.mark.parametrize("command", [("run", "--virtual"), ("run",), ("launch", "--viewer", "none")])
def test_a_folder_that_holds_a_run_is_refused_before_anything_is_started(
    tmp_path: Path, command: tuple[str, ...]
) -> None:
    (tmp_path / SESSION).write_bytes(b"precious")
    done = CliRunner().invoke(app, [command[0], ROBOT, *command[1:], "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert "holds a run already: choose another --out" in done.output
    assert [path.name for path in tmp_path.iterdir()] == [SESSION]


# --------------------------------------------------------------------------- virtual runs


class Silent:
    """A screen that shows nothing."""

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None: ...

    def note(self, text: str) -> None: ...


def test_an_interrupted_virtual_run_stops_the_robot_and_closes_its_recording(tmp_path: Path) -> None:
    interruptions: list[Interruption] = []

    def interrupt_later(robot: VirtualRobot) -> None:
        def press_ctrl_c_twice() -> None:
            interruptions[0](signal.SIGINT, None)
            interruptions[0](signal.SIGINT, None)

        robot.loop.call_at(2.5, press_ctrl_c_twice)

    plan = Plan(dynamics=False, discover_s=0.3, link_s=0.3, rest_s=1.0)
    config = VirtualConfig(load_robot(ROBOT), tmp_path, plan=plan)
    with pytest.raises(asyncio.CancelledError):
        run_virtual(config, Silent(), interrupt_later, interruptions.append)
    recording = load_recording(tmp_path / SESSION)
    last = recording.journal[-1]
    assert last.what == "failed"
    assert "no confirmation" not in last.text
    # Every module had been taken, and every one has accepted to stop.
    asked = [e for e in read_session(tmp_path / SESSION) if e.topic.endswith("/stop")]
    assert sorted(e.topic.split("/")[2] for e in asked if e.kind == "request") == ["X-00009", "X-00010"]
    assert all(decode(Ack, e.payload).accepted for e in asked if e.kind == "reply")
    # A file that was closed has its index, which ends with the magic bytes.
    assert (tmp_path / SESSION).read_bytes().endswith(b"\x89MCAP0\r\n")


def test_a_virtual_run_that_fails_says_so_in_one_line(tmp_path: Path) -> None:
    # Round trips of 300 ms: the link is refused before anything moves.
    plan, slow = tmp_path / "plan.toml", tmp_path / "slow.toml"
    plan.write_text("discover_s = 0.3\nlink_s = 0.3\n")
    slow.write_text("delay_ms = 150.0\n")
    given = ["run", ROBOT, "--virtual", "--network", str(slow), "--plan", str(plan), "--quiet"]
    done = subprocess.run(
        [sys.executable, "-m", "sim.main", *given, "--out", str(tmp_path / "run")],
        capture_output=True,
        text=True,
        timeout=120.0,
        check=False,
    )
    assert "Traceback" not in done.stderr
    assert "was destroyed" not in done.stderr
    assert done.returncode == 1, done.stderr
    assert "x5-sim: unfit:" in done.stderr


def test_the_truth_tells_the_clocks_and_biases_of_the_world_that_ran(tmp_path: Path) -> None:
    bus = tmp_path / "bus"
    command = [sys.executable, "-m", "sim.main", "world", ROBOT, "--bus", str(bus), "--truth", str(tmp_path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as world:
        assert world.stderr is not None
        while f"2 modules on {bus}" not in (line := world.stderr.readline()):
            assert line, "the world ended before its bus was open"
        world.send_signal(signal.SIGTERM)
        assert world.wait(60.0) == 0
    assert not bus.exists()
    truth = read_truth(tmp_path / "truth.json")
    assert truth.clocks is not None
    assert len(truth.clocks) == 2
    assert truth.imu_bias is not None
    assert truth.imu_bias.shape == (2, 6)
    assert json.loads((tmp_path / "truth.json").read_text())["clocks"] is not None


# --------------------------------------------------------------------------- the launcher


SLEEP = "import time; time.sleep(600)"


class Bench:
    """A launcher whose processes are small programs, given as Python source."""

    def __init__(self, out: Path):
        self.said: list[str] = []
        self.launcher = Launcher(LaunchConfig("none", "none", ("A", "B"), out), self.said.append)

    def start(self, name: str, program: str, up: str = "") -> Child:
        source = self.launcher.config.out / f"{len(self.launcher.children)}_{abs(hash(program))}.py"
        source.parent.mkdir(parents=True, exist_ok=True)
        source.write_text(program)
        return self.launcher._start(name, [source.stem], up=up)

    def agent(self, serial: str, program: str) -> Child:
        child = self.start(f"agent {serial}", program, up="is up")
        self.launcher._waited_for.append(child)
        return child


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    made = Bench(tmp_path)
    yield made
    made.launcher.stop()


def test_an_agent_that_ends_early_is_named_with_its_last_output_and_the_coordinator_decides(
    bench: Bench,
) -> None:
    bench.start("world", SLEEP)
    gone = bench.agent("A", "print('x5-agent: no module A in this world'); raise SystemExit(2)")
    gone.process.wait(30.0)
    # The coordinator ends by itself, later, with a code of its own.
    coordinator = bench.start("coordinator", "import time; time.sleep(0.5); raise SystemExit(3)")
    assert bench.launcher.watch(coordinator) == 3
    told = [line for line in bench.said if "ended" in line]
    assert told == ["agent A ended with 2: x5-agent: no module A in this world"]


def test_without_a_world_there_is_nothing_to_go_on_with(bench: Bench) -> None:
    world = bench.start("world", "print('out of memory'); raise SystemExit(1)")
    world.process.wait(30.0)
    with pytest.raises(LaunchError, match="world ended with 1: out of memory"):
        bench.launcher.watch(bench.start("coordinator", SLEEP))


def test_a_coordinator_that_a_signal_ended_has_the_exit_code_of_a_shell(bench: Bench) -> None:
    program = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    assert bench.launcher.watch(bench.start("coordinator", program)) == 128 + signal.SIGKILL


def test_who_is_up_is_said_once_and_only_when_it_is(bench: Bench) -> None:
    child = bench.agent("A", SLEEP)
    bench.launcher.look(child)
    assert bench.said == [f"agent A: process {child.process.pid}"]
    assert child.log is not None
    child.log.write_text("A is up, process 7\n")
    for _ in range(2):
        bench.launcher.look(child)
    assert bench.said[1:] == ["agent A: is up"]


def test_logs_stay_in_the_folder_of_the_run_and_a_restarted_agent_has_its_own(bench: Bench) -> None:
    many = ",".join(f"module-{k}" for k in range(64))
    names: list[Any] = []
    for name in ("world", "agent A,B", "agent A,B", f"agent {many}"):
        child = bench.start(name, f"print({name!r})")
        child.process.wait(30.0)
        assert child.log is not None
        names.append(child.log.name)
    assert names[:3] == ["world.log", "agent-A,B.log", "agent-A,B-2.log"]
    bench.launcher.stop()
    folder = bench.launcher.config.out / LOGS
    assert (folder / "world.log").read_text() == "world\n"
    assert (folder / names[3]).read_text() == f"agent {many}\n"


def test_a_viewer_is_refused_where_nothing_is_live(tmp_path: Path) -> None:
    arguments = ["run", ROBOT, "--virtual", "--viewer", "spawn", "--out", str(tmp_path / "run")]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 2
    assert "with --virtual there is nothing live" in done.output
    assert not (tmp_path / "run").exists()

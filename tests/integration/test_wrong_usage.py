"""What cannot work is refused at once, with exit code 2 and a word on what would be right."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from module_agent.hardware.hardware import Readings, WiredModule
from sim.world.bus_server import BusServer

ROBOT = "thesis_171_horizontal"


def refused(done) -> str:
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return str(done.stderr)


def test_an_unknown_robot_is_answered_with_the_known_ones(programs, tmp_path) -> None:
    said = refused(programs.run("sim.main", "run", "no_such_robot", "--out", str(tmp_path / "run")))
    assert "no_such_robot" in said
    assert ROBOT in said


@pytest.mark.parametrize("command", ["run", "launch"])
def test_an_unknown_network_is_answered_with_the_known_ones(programs, tmp_path, command) -> None:
    out = str(tmp_path / "run")
    said = refused(programs.run("sim.main", command, ROBOT, "--network", "pigeons", "--out", out))
    assert "pigeons" in said
    assert "lan, lossy, wifi, bad" in said


def test_a_coordinator_does_not_even_listen_on_an_unknown_network(programs, tmp_path, endpoint) -> None:
    said = refused(
        programs.run(
            "coordinator.main",
            *("run", "--out", str(tmp_path / "run"), "--network", "pigeons", "--listen", endpoint),
        )
    )
    assert "lan, lossy, wifi, bad" in said
    assert not (tmp_path / "run").exists()


def test_a_folder_that_holds_a_run_is_not_written_over(programs, tmp_path, endpoint) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "session.mcap").write_bytes(b"dear")
    for command in (
        ("coordinator.main", "run", "--listen", endpoint),
        ("sim.main", "run", ROBOT, "--virtual"),
        ("sim.main", "run", ROBOT, "--listen", endpoint),
    ):
        said = refused(programs.run(*command, "--out", str(out)))
        assert f"{out} holds a run already" in said
        assert "--resume" in said
    assert [path.name for path in out.iterdir()] == ["session.mcap"]
    assert (out / "session.mcap").read_bytes() == b"dear"


def test_there_is_nothing_to_resume_in_an_empty_folder(programs, tmp_path, endpoint) -> None:
    said = refused(
        programs.run("coordinator.main", "run", "--out", str(tmp_path), "--listen", endpoint, "--resume")
    )
    assert "no recording to resume" in said


class OneModule:
    """A world that nobody is let into."""

    modules = (WiredModule("A-1", "X5-1", 1_000_000, 4_000_000),)

    def exchange(self, pwm):
        return Readings(1)


@pytest.fixture
def bus(nothing_is_left: Path) -> Iterator[str]:
    """Serve the bus of a world with one module, which ticks without agents."""
    path = str(nothing_is_left / "bus")
    server = BusServer(path, OneModule())
    over = threading.Event()

    def serve() -> None:
        while not over.wait(0.01):
            server.tick()

    thread = threading.Thread(target=serve)
    thread.start()
    yield path
    over.set()
    thread.join()
    server.close()


def test_an_agent_of_a_module_that_the_world_does_not_have_is_told_which_there_are(
    programs, client, endpoint, bus
) -> None:
    client("robot", hub=True)
    said = refused(programs.run("module_agent.main", "--serial", "B-2", "--bus", bus, "--connect", endpoint))
    assert "no module 'B-2' in this world; there are A-1" in said

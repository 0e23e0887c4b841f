"""What `x5-coordinator` says when it cannot work, when a run ends early, and how its clean-up is kept."""

import asyncio
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from coordinator.commands.run import resuming
from coordinator.live_robot.discovery import Search, light_led, listed, stop_robot
from coordinator.live_robot.errors import ModuleLost
from coordinator.live_robot.messenger import NoAnswer
from coordinator.main import app
from coordinator.monitoring.module_states import full_name
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import JOURNAL_TOPIC, Entry
from coordinator.recording.run_folder import SESSION, RunFolderError, check_free, open_run_folder
from coordinator.recording.session_file import SessionWriter
from coordinator.runtime.command_line import ENDINGS, ending
from coordinator.runtime.event_loop import Interruption, run_to_end
from coordinator.synchronisation.feedback_delays import feedback_delays
from coordinator.viewer.targets import ViewerTargets, viewer_choice
from module_agent.model.catalogue import CATALOGUE, UnknownModuleType, module_type
from module_agent.model.errors import EXIT_USAGE, RobotError, UsageError
from module_agent.transport.transport import Event, Liveness, Reply, Sample, Sink
from module_agent.wire.codec import decode, encode
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import Ask, Status, Stop


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


# --------------------------------------------------------------------------- wrong usage


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run", "--seed", "-1"), "greater than or equal to 0"),
        (("run", "--speed", "0"), "speed 0.0: it must be a positive number"),
        (("run", "--speed", "nan"), "speed nan: it must be a positive number"),
        (("run", "--expect", "0"), "greater than or equal to 1"),
        (("run", "--robot", "a/b"), "robot 'a/b' cannot be part of a key"),
        (("run", "--network", "pigeons"), "known are none, lan, lossy, wifi, bad"),
        (("run", "--viewer", "foo"), "it must be none, spawn, serve or an address like rerun+http://"),
        (("run", "--viewer", "http://x"), "it must be none, spawn, serve or an address like rerun+http://"),
        (("run", "--listen", "tcp/127.0.0.1"), "an address of tcp is HOST:PORT"),
        (("run", "--connect", "carrier/pigeon:1"), "unknown protocol 'carrier'"),
        (("list", "--robot", "a/b"), "robot 'a/b' cannot be part of a key"),
        (("stop", "--robot", "a/b"), "robot 'a/b' cannot be part of a key"),
        (("list", "--listen", "nonsense"), "endpoint 'nonsense': it must look like tcp/"),
    ],
)
def test_wrong_usage_is_answered_with_what_is_right_and_nothing_is_made(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    out = tmp_path / "run"
    place = ("--out", str(out)) if arguments[0] == "run" else ()
    done = CliRunner().invoke(app, [*arguments, *place])
    assert done.exit_code == 2, done.output
    assert words in done.output
    assert not out.exists()


def test_a_gains_file_for_another_number_of_modules_is_refused_before_they_are_looked_for(
    tmp_path: Path,
) -> None:
    path = tmp_path / "three.xml"
    path.write_text("<group_gains><position><kp>1 2 3</kp></position></group_gains>")
    done = CliRunner().invoke(app, ["gains", "load", str(path), "--module", "A", "--module", "B"])
    assert done.exit_code == EXIT_USAGE
    assert f"{path}: <kp> has 3 values for 2 modules" in done.output


def test_a_plan_without_fast_motions_is_refused_before_anything_moves(tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text("topology_only = true\n")
    arguments = ["run", "--out", str(tmp_path / "run"), "--plan", str(tmp_path / "plan.toml")]
    done = CliRunner().invoke(app, [*arguments, "--listen", free_endpoint()])
    assert done.exit_code == 2
    assert "topology_only" in done.output
    assert not (tmp_path / "run").exists()


def test_a_robot_that_nobody_announces_leaves_a_folder_that_may_be_used_again(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text("discover_s = 0.1\n")
    out = tmp_path / "a run"
    given = ["run", "--out", str(out), "--robot", "lonely", "--listen", free_endpoint()]
    given += ["--no-dynamics", "--plan", str(plan), "--speed", "8", "--quiet"]
    # In a process of its own: the program takes over signals and the event loop.
    done = subprocess.run(
        [sys.executable, "-m", "coordinator.main", *given],
        capture_output=True,
        text=True,
        timeout=60.0,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    assert "expected, found 0: none; the robot was not moving; recorded up to here" in done.stderr
    assert "Traceback" not in done.stderr
    resume = done.stderr.partition("to resume: ")[2].strip()
    assert resume.startswith("x5-coordinator run ")
    assert f"--out '{out}'" in resume
    for words in ("--robot lonely", given[6], "--no-dynamics", str(plan), "--speed 8", "--resume"):
        assert words in resume
    assert (out / SESSION).exists()
    check_free(out)


# --------------------------------------------------------------------------- folders


def record(folder: Path, *events: JournalEvent) -> Path:
    folder.mkdir(exist_ok=True)
    writer = SessionWriter(folder / SESSION)
    for event in events:
        writer.write(Entry("journal", JOURNAL_TOPIC, event.t_ns, event.encode()))
    writer.close()
    return folder


def test_a_recording_in_which_no_step_began_is_no_run(tmp_path: Path) -> None:
    folder = record(tmp_path, JournalEvent(t_ns=1, what="session", robot="arm"))
    check_free(folder)
    assert open_run_folder(folder, resume=False) is None
    assert not (folder / SESSION).exists()


def test_a_recording_in_which_a_step_began_is_kept(tmp_path: Path) -> None:
    folder = record(
        tmp_path,
        JournalEvent(t_ns=1, what="session", robot="arm"),
        JournalEvent(t_ns=2, what="begin", step="home"),
    )
    before = (folder / SESSION).read_bytes()
    with pytest.raises(RunFolderError, match="holds a run already"):
        open_run_folder(folder, resume=False)
    assert (folder / SESSION).read_bytes() == before


def test_another_robot_s_run_is_not_resumed_and_not_touched(tmp_path: Path) -> None:
    folder = record(tmp_path, JournalEvent(t_ns=1, what="session", robot="arm"))
    before = (folder / SESSION).read_bytes()
    with pytest.raises(RunFolderError, match="holds a run of robot 'arm', not of 'leg': give --robot arm"):
        open_run_folder(folder, resume=True, robot="leg")
    assert [path.name for path in folder.iterdir()] == [SESSION]
    assert (folder / SESSION).read_bytes() == before
    assert open_run_folder(folder, resume=True, robot="arm") is not None


# --------------------------------------------------------------------------- words


def test_every_end_of_a_run_has_a_sentence_and_a_code_and_a_defect_has_none() -> None:
    codes = {
        3: ModuleLost("A-1", "no feedback for 1.2 s"),
        2: RunFolderError("holds a run already"),
        1: NoAnswer("A-1", Leaf.INFO, "Timeout"),
        130: asyncio.CancelledError(),
    }
    for code, error in codes.items():
        assert isinstance(error, ENDINGS)
        assert ending(error).exit_code == code
    with pytest.raises(UnknownModuleType) as unknown:
        module_type("X5-7")
    assert (
        str(ending(unknown.value))
        == f"unknown module type 'X5-7'; the catalogue knows {', '.join(CATALOGUE)}"
    )
    assert not isinstance(KeyError("a bug"), ENDINGS)
    assert not isinstance(ZeroDivisionError(), ENDINGS)


def test_a_viewer_is_a_word_or_an_address() -> None:
    assert viewer_choice("none") == ViewerTargets()
    assert viewer_choice("spawn").spawn
    assert viewer_choice("serve", 9090) == ViewerTargets(connect="rerun+http://127.0.0.1:9091/proxy")
    assert viewer_choice("rerun+http://host:9876/proxy").connect == "rerun+http://host:9876/proxy"
    for nonsense in ("", "rerun+http://", "ftp://host", "spawned"):
        with pytest.raises(UsageError, match="it must be none, spawn, serve"):
            viewer_choice(nonsense)


def test_the_command_that_resumes_repeats_what_was_given_and_nothing_else() -> None:
    program = typer.Typer()
    said = []

    @program.command()
    def run(
        context: typer.Context,
        out: str,
        connect: list[str] | None = None,
        dynamics: bool = True,
        resume: bool = False,
        seed: int = 0,
    ) -> None:
        said.append(resuming(context))

    program.registered_commands[0].callback = run
    runner = CliRunner()
    assert runner.invoke(program, ["a b", "--connect", "x", "--connect", "y", "--no-dynamics"]).exit_code == 0
    assert runner.invoke(program, ["plain", "--resume", "--seed", "3"]).exit_code == 0
    assert said[0].endswith("--connect x --connect y --no-dynamics --resume")
    assert said[1].endswith("--seed 3 --resume")
    assert said[1].count("--resume") == 1


# --------------------------------------------------------------------------- signals


def test_a_second_signal_does_not_disturb_the_clean_up() -> None:
    loop = asyncio.new_event_loop()
    done: list[str] = []

    async def work() -> None:
        try:
            await asyncio.sleep(30.0)
        finally:
            interruption()
            await asyncio.sleep(0.01)
            done.append("cleaned up")

    task = loop.create_task(work())
    interruption = Interruption(loop, task)
    interruption()
    interruption()
    with pytest.raises(asyncio.CancelledError, match="interrupted"):
        run_to_end(loop, task)
    loop.close()
    assert done == ["cleaned up"]


def test_what_a_task_leaves_behind_is_ended_with_it() -> None:
    loop = asyncio.new_event_loop()
    left: list[asyncio.Task[Any]] = []

    async def work() -> int:
        left.append(asyncio.create_task(asyncio.sleep(30.0)))
        return 7

    assert run_to_end(loop, loop.create_task(work())) == 7
    assert left[0].cancelled()
    loop.close()


# --------------------------------------------------------------------------- list and stop


class Robot:
    """The network of a robot whose modules announce themselves one after the other and answer as told."""

    def __init__(self, wire: Any, serials: tuple[str, ...], deaf: tuple[str, ...] = ()):
        self.wire = wire
        self.serials = serials
        self.deaf = deaf
        self.closed = False
        self.stopped: list[str] = []

    def watch_alive(self, key_expr: str, sink: Sink) -> "Robot":
        for serial in self.serials:
            sink(Liveness(key("arm", serial, Leaf.ALIVE), True))
        return self

    def undeclare(self) -> None:
        pass

    def subscribe(self, key_expr: str, sink: Sink) -> "Robot":
        for serial in self.serials:
            message = self.wire.feedback(serial)
            sink(Sample(key("arm", serial, Leaf.FEEDBACK), encode(message)))
        return self

    def query(self, at: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
        serial = at.split("/")[2]
        event: Event = Reply(tag, at, None, "Timeout")
        if serial not in self.deaf:
            event = Reply(tag, at, self.answer(serial, at, payload))
        sink(event)

    def answer(self, serial: str, at: str, payload: bytes) -> bytes:
        if at.endswith("status"):
            asked = decode(Ask, payload)
            assert asked.serial == serial
            return encode(self.wire.status(serial, re=asked.seq))
        if at.endswith("info"):
            return encode(self.wire.info(serial, family="Arm", name=f"{serial}-joint"))
        stop = decode(Stop, payload)
        self.stopped.append(stop.serial)
        return encode(self.wire.ack(serial=serial, re=stop.seq))

    def close(self) -> None:
        self.closed = True


QUICK = Search(quiet_s=0.02, first_s=0.02)


def test_every_module_is_listed_and_who_does_not_answer_is_named(wire: Any) -> None:
    robot: Any = Robot(wire, ("B", "A", "C"), deaf=("C",))
    statuses, deaf, *_ = listed(robot, "arm", QUICK, listen_s=0.1)
    assert [status.serial for status in statuses] == ["A", "B"]
    assert all(isinstance(status, Status) for status in statuses)
    assert deaf == ["C"]
    assert robot.closed


def test_modules_are_listed_with_the_names_that_their_user_gave(wire: Any) -> None:
    robot: Any = Robot(wire, ("A", "B"), deaf=("B",))
    known = listed(robot, "arm", QUICK, listen_s=0.1).recording.modules
    assert full_name(known["A"].info) == "Arm/A-joint"
    assert full_name(known["B"].info) == ""


def test_the_delay_of_feedback_is_heard_meanwhile(wire: Any) -> None:
    robot: Any = Robot(wire, ("A", "B"), deaf=("B",))
    found = listed(robot, "arm", QUICK, listen_s=0.1)
    # Five requests tell the clock of a module; of one that does not answer nothing is claimed.
    assert len(found.recording.modules["A"].round_trips) == 5
    assert [(one.serial, one.messages) for one in feedback_delays(found.recording)] == [("A", 1)]
    assert found.cpu_us_per_message is not None


def test_every_module_is_stopped_and_who_does_not_confirm_is_named(wire: Any) -> None:
    robot: Any = Robot(wire, ("B", "A", "C"), deaf=("C",))
    assert stop_robot(robot, "arm", "tester", QUICK) == (["A", "B"], ["C"])
    # In the order in which they were seen, and not when all were.
    assert robot.stopped == ["B", "A"]


def test_a_stop_does_not_wait_for_a_module_that_comes_and_goes(
    wire: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module announces itself and leaves all the time, so that the search for others takes its longest."""
    monkeypatch.setattr("coordinator.live_robot.discovery.MAX_S", 2.0)
    sent_s: list[float] = []

    class Restless(Robot):
        """A network with a module that never settles."""

        def watch_alive(self, key_expr: str, sink: Sink) -> "Robot":
            super().watch_alive(key_expr, sink)
            self.left = threading.Event()
            self.thread = threading.Thread(target=self.come_and_go, args=(sink,))
            self.thread.start()
            return self

        def come_and_go(self, sink: Sink) -> None:
            alive = True
            while not self.left.wait(0.01):
                sink(Liveness(key("arm", "RESTLESS", Leaf.ALIVE), alive))
                alive = not alive

        def undeclare(self) -> None:
            self.left.set()
            self.thread.join()

        def answer(self, serial: str, at: str, payload: bytes) -> bytes:
            sent_s.append(time.monotonic() - begun_s)
            return super().answer(serial, at, payload)

    robot: Any = Restless(wire, ("B", "A"))
    begun_s = time.monotonic()
    stopped, _ = stop_robot(robot, "arm", "tester", QUICK._replace(quiet_s=0.2))
    # Both were stopped while the search still went on.
    assert {"A", "B"} <= {*stopped}
    assert sent_s[1] < 1.0 < time.monotonic() - begun_s


def test_a_led_is_lit_only_if_the_module_itself_says_so(wire: Any) -> None:
    class Answering(Robot):
        """Its module answers as another one, another question, or garbage."""

        def answer(self, serial: str, at: str, payload: bytes) -> bytes:
            return answers.pop(0)

    right = encode(wire.ack(serial="A", re=1))
    answers = [right, encode(wire.ack(serial="B", re=1)), encode(wire.ack(serial="A", re=7)), b"garbage"]
    robot: Any = Answering(wire, ("A",))
    light_led(robot, "arm", "A", "tester", True, QUICK)
    for said in (
        "is no answer to the question: B, 1",
        "is no answer to the question: A, 7",
        "cannot be read",
    ):
        with pytest.raises(RobotError, match=said):
            light_led(robot, "arm", "A", "tester", True, QUICK)


@pytest.mark.parametrize(("lost", "stops"), [(2, True), (3, False)])
def test_a_stop_that_the_network_loses_is_sent_again(wire: Any, lost: int, stops: bool) -> None:
    class Lossy(Robot):
        """A network that loses the first answers."""

        def query(self, at: str, payload: bytes, timeout_s: float, sink: Sink, tag: int) -> None:
            nonlocal lost
            lost -= 1
            if lost >= 0:
                sink(Reply(tag, at, None, "Timeout"))
            else:
                super().query(at, payload, timeout_s, sink, tag)

    robot: Any = Lossy(wire, ("A",))
    assert stop_robot(robot, "arm", "tester", QUICK) == ((["A"], []) if stops else ([], ["A"]))
    assert robot.closed


def test_a_module_that_refuses_to_stop_is_not_counted_as_stopped(wire: Any) -> None:
    class Refusing(Robot):
        """Its module refuses."""

        def answer(self, serial: str, at: str, payload: bytes) -> bytes:
            return encode(self.wire.ack(serial=serial, accepted=False))

    robot: Any = Refusing(wire, ("A",))
    assert stop_robot(robot, "arm", "tester", QUICK) == ([], ["A"])


def test_a_search_ends_with_the_last_module_that_is_expected(wire: Any) -> None:
    robot: Any = Robot(wire, ("A", "B", "C"))
    statuses = listed(robot, "arm", QUICK._replace(expect=2), listen_s=0.1).statuses
    assert [status.serial for status in statuses] == ["A", "B"]


def test_a_hub_waits_for_agents_that_try_once_a_second(wire: Any) -> None:
    class Late(Robot):
        """Its module comes long after all has been quiet."""

        def watch_alive(self, key_expr: str, sink: Sink) -> "Robot":
            event = Liveness(key("arm", self.serials[0], Leaf.ALIVE), True)
            threading.Timer(0.3, sink, [event]).start()
            return self

    late: Any = Late(wire, ("A",))
    statuses = listed(late, "arm", QUICK, listen_s=0.1).statuses
    assert statuses == []
    # Not a hub either says of a slow network that nothing is there.
    for patient in (Search(quiet_s=0.02), QUICK._replace(min_s=20.0, expect=1)):
        late = Late(wire, ("A",))
        statuses = listed(late, "arm", patient, listen_s=0.1).statuses
        assert [status.serial for status in statuses] == ["A"]


def test_a_payload_is_refused_at_once_where_nothing_was_weighed(known_folder: Any, tmp_path: Path) -> None:
    """Before the robot moves: no recording is read, no network joined, no folder made."""
    baseline = known_folder("thesis_171_horizontal", dynamics=None)
    done = CliRunner().invoke(app, ["payload", str(baseline), "--out", str(tmp_path / "new")])
    assert done.exit_code == EXIT_USAGE
    assert "A payload is what is more than a known inertia" in done.output
    assert not (tmp_path / "new").exists()


def test_a_log_is_imported_with_one_name_for_each_type_and_into_a_new_folder(tmp_path: Path) -> None:
    def ended(*options: str) -> Any:
        command = ["import", str(tmp_path / "a.hebilog"), "--out", str(tmp_path / "run"), *options]
        return CliRunner().invoke(app, command)

    for options, said in (
        (("--type", "X5-1", "--name", "a", "--name", "b"), "1 types, 2 names"),
        (("--type", "X5-1", "--type", "X5-1", "--name", "a", "--name", "a"), "of its own to each"),
        (("--type", "X5-7"), "X5-7"),
        (("--type", "X5-1", "--name", "a/b"), "--name 'a/b' cannot be part of a key"),
    ):
        done = ended(*options)
        assert done.exit_code == EXIT_USAGE
        assert said in done.output
    assert not (tmp_path / "run").exists()

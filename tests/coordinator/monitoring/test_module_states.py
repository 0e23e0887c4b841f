"""The live table's figures: rates, losses and delays of messages whose truth is known, and its keys."""

import asyncio
import io
import json
import os
import pty
import sys
import termios
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

from coordinator.commands.views.module_table import ModuleScreen, line, table
from coordinator.live_robot.messenger import Messenger, Sender
from coordinator.main import app
from coordinator.monitoring.live_states import LiveStates
from coordinator.monitoring.module_states import ModuleState, ModuleStates
from coordinator.runtime.key_presses import key_presses
from coordinator.synchronisation.feedback_delays import FeedbackDelay
from module_agent.network_emulation.profile import NetworkProfile
from module_agent.wire.keys import Leaf

# Module clock behind the session's: 40 days of uptime.
OFFSET_NS = 3_456_000_000_000_000
PERIOD_NS, BATCH = 4_000_000, 5
DELAY_NS, TRIP_NS = 3_000_000, 600_000


def stretched(module_ns: int, slow: float) -> int:
    """Return the session time of a module time, of a world that falls behind after the fifth second."""
    since = module_ns - 5_000_000_000
    return OFFSET_NS + module_ns + round(max(0, since) * slow)


def feed(
    states: ModuleStates,
    wire: SimpleNamespace,
    seconds: float,
    lost: range = range(0),
    twice: range = range(0),
    slow: float = 0.0,
) -> int:
    """Send batches of 5 rows that are 3 ms under way, and ask twice a second; return the time of the end."""
    t_ns = 0
    for batch in range(round(seconds * 1e9 / (PERIOD_NS * BATCH))):
        first = batch * BATCH
        newest_ns = PERIOD_NS * (first + BATCH - 1)
        t_ns = stretched(newest_ns, slow) + DELAY_NS
        message = wire.publication(Leaf.FEEDBACK, wire.feedback(first=first), t_ns)
        for _ in range(0 if batch in lost else 2 if batch in twice else 1):
            states.record(message)
        if batch % 25 == 0:
            states.record(wire.request(Leaf.STATUS, wire.ask(seq=batch + 1), t_ns))
            # Answered in the middle of the round trip.
            answered = newest_ns + round((DELAY_NS + TRIP_NS // 2) / (1.0 + slow))
            status = wire.status(re=batch + 1, t_ns=answered, refusals={"no_lease": 2}, holder="me@here")
            states.record(wire.reply(Leaf.STATUS, status, t_ns + TRIP_NS))
    return t_ns


def test_rows_a_second_and_delays_are_those_of_the_messages(wire: SimpleNamespace) -> None:
    states = ModuleStates()
    states.record(wire.reply(Leaf.INFO, wire.info()))
    end_ns = feed(states, wire, 20.0)
    (state,) = states.at(end_ns, {"A"})
    assert (state.serial, state.kind, state.state, state.holder) == ("A", "X5-4", "armed", "me@here")
    assert state.rows_per_s == pytest.approx(250.0, rel=1e-3)
    assert state.lost_rows == 0
    assert state.delay is not None
    assert state.delay.p50_ms == pytest.approx(3.0, abs=1e-3)
    assert state.delay.p99_ms == pytest.approx(3.0, abs=1e-3)
    # A round trip of 0.6 ms may have been answered at any of its moments.
    assert state.delay.clock_sigma_ms == pytest.approx(0.6 / 12**0.5, abs=1e-3)
    assert state.refused == {"no_lease": 2}
    # The position of a row is its number.
    assert state.position_rad == pytest.approx(20.0 * 250 - 1)


def test_a_world_that_falls_behind_its_machine_does_not_make_feedback_arrive_before_it_was_sampled(
    wire: SimpleNamespace,
) -> None:
    states = ModuleStates()
    (state,) = states.at(feed(states, wire, 12.0, slow=0.2), {"A"})
    # 3 ms between two round trips that are half a second apart, across a change of 20 % in the clock's rate.
    assert state.delay is not None
    assert state.delay.p50_ms == pytest.approx(3.0, abs=0.2)


def test_lost_rows_count_and_repeated_ones_do_not(wire: SimpleNamespace) -> None:
    states = ModuleStates()
    end_ns = feed(states, wire, 4.0, lost=range(40, 47), twice=range(60, 90))
    (state,) = states.at(end_ns, {"A"})
    assert state.lost_rows == 7 * BATCH
    assert state.rows_per_s == pytest.approx(250.0 * (200 - 7) / 200, rel=0.02)


def test_rows_that_come_late_are_not_lost(wire: SimpleNamespace) -> None:
    states = ModuleStates()
    order = [0, 1, 3, 2, 5, 4, 6]
    for k, batch in enumerate(order):
        states.record(wire.publication(Leaf.FEEDBACK, wire.feedback(first=5 * batch), 20_000_000 * k))
    assert states.at(200_000_000, {"A"})[0].lost_rows == 0


def test_a_new_boot_counts_anew(wire: SimpleNamespace) -> None:
    states = ModuleStates()
    feed(states, wire, 2.0, lost=range(20, 30))
    t_ns = OFFSET_NS + 3_000_000_000
    states.record(wire.publication(Leaf.FEEDBACK, wire.feedback(boot=2, first=0), t_ns))
    assert states.at(t_ns, {"A"})[0].lost_rows == 0


def test_who_is_silent_and_who_is_gone_is_told_apart(wire: SimpleNamespace) -> None:
    states = ModuleStates()
    end_ns = feed(states, wire, 2.0)
    assert [state.state for state in states.at(end_ns, {"A", "B"})] == ["armed", "silent"]
    assert states.at(end_ns + 2_000_000_000, {"A"})[0].state == "silent"
    assert states.at(end_ns, set())[0].state == "gone"


def test_a_session_of_hours_keeps_seconds_of_rows(wire: SimpleNamespace) -> None:
    states = ModuleStates()
    for first in range(0, 60_000, 200):
        states.record(
            wire.publication(Leaf.FEEDBACK, wire.feedback(first=first, count=200), 4_000_000 * first)
        )
    log = states.recording.modules["A"].rows
    assert log.end_row - log.first_row <= 20_200
    assert states.at(4_000_000 * 60_000, {"A"})[0].lost_rows == 0


# ---------------------------------------------------------------------- on a robot


class Follower:
    """The live table on a simulated robot in virtual time."""

    def __init__(self, rig: Any):
        self.rig = rig
        self.states = ModuleStates()
        self.shown: list[list[ModuleState]] = []
        self.notes: list[str] = []
        self.messenger = Messenger(
            rig.endpoint("table"), rig.robot.name, self.clock, rig.loop.call_soon, self.states.record
        )
        sender = Sender("table", b"a-secret-of-16-b")
        self.live = LiveStates(
            self.states, self.messenger, self.clock, sender, self.shown.append, self.notes.append
        )

    def clock(self) -> int:
        return int(self.rig.loop.now_ns)

    def follow(self, seconds: float) -> None:
        self.messenger.start()
        self.rig.run(self.live.follow(self.clock() + round(1e9 * seconds)))
        self.messenger.close()


@pytest.fixture
def follower(rigs: Callable[..., Any]) -> Follower:
    return Follower(rigs("thesis_171_horizontal", network="lan"))


def test_every_module_of_a_robot_is_shown_with_its_figures(follower: Follower) -> None:
    follower.follow(4.0)
    last = follower.shown[-1]
    assert [state.serial for state in last] == ["X-00009", "X-00010"]
    assert {state.kind for state in last} == {module.type for module in follower.rig.robot.modules}
    for state in last:
        assert state.state == "idle"
        assert state.voltage_v == pytest.approx(24.0, abs=2.0)
        assert state.rows_per_s == pytest.approx(250.0, rel=0.05)
        # A cable's delay is a fraction of a millisecond, and a clock is known to half a round trip.
        assert state.delay is not None
        assert -0.5 < state.delay.p50_ms < 5.0


def test_a_key_holds_all_modules_and_the_same_key_releases_them(follower: Follower) -> None:
    held: list[str] = []
    follower.rig.at(1.0, follower.live.hold)
    follower.rig.at(3.0, lambda: held.extend(follower.rig.state(s) for s in follower.rig.serials))
    follower.rig.at(3.0, follower.live.hold)
    follower.follow(5.0)
    assert held == ["armed", "armed"]
    assert [follower.rig.state(serial) for serial in follower.rig.serials] == ["idle", "idle"]
    assert follower.notes == ["held: X-00009, X-00010", "released"]


def test_a_key_holds_modules_that_take_longer_to_take_than_a_lease_lasts(rigs: Callable[..., Any]) -> None:
    """Four answers of 80 ms each, one after the other, would be longer than the 250 ms of a lease."""
    follower = Follower(rigs("a2085_04", NetworkProfile(name="far", delay_ms=40.0)))
    held: list[str] = []
    follower.rig.at(1.0, follower.live.hold)
    follower.rig.at(3.0, lambda: held.extend(follower.rig.state(s) for s in follower.rig.serials))
    follower.follow(3.5)
    assert held == ["armed"] * 4


@pytest.mark.parametrize("after_s", [0.0005, 0.001, 0.002])
def test_a_release_while_the_leases_are_being_taken_releases_all_modules(
    follower: Follower, after_s: float
) -> None:
    follower.rig.at(1.0, follower.live.hold)
    follower.rig.at(1.0 + after_s, follower.live.hold)
    follower.follow(3.0)
    assert {follower.rig.state(serial) for serial in follower.rig.serials} <= {"idle", "expired"}
    assert not follower.live.holds
    assert not any(note.startswith("held") for note in follower.notes)


def test_a_key_stops_all_modules_also_those_that_another_program_holds(follower: Follower) -> None:
    _, _, group = follower.rig.group("another")

    async def hold() -> None:
        await group.meet(follower.rig.serials)
        for serial in group.serials:
            await group.acquire(serial)

    follower.rig.run(hold())
    assert follower.rig.state("X-00009") == "armed"
    follower.rig.loop.call_later(0.5, follower.live.stop)
    follower.follow(1.5)
    assert [follower.rig.state(serial) for serial in follower.rig.serials] == ["stopped", "stopped"]
    assert follower.notes == ["stopped: X-00009, X-00010"]


@pytest.mark.parametrize("after_s", [0.0, 0.0005, 0.001, 0.0015, 0.002])
def test_a_stop_while_the_leases_are_being_taken_stops_all_modules_for_good(
    follower: Follower, after_s: float
) -> None:
    """Whichever of the acquisitions is under way, none may arm a module after the stop."""
    follower.rig.at(1.0, follower.live.hold)
    follower.rig.at(1.0 + after_s, follower.live.stop)
    follower.follow(3.0)
    assert [follower.rig.state(serial) for serial in follower.rig.serials] == ["stopped", "stopped"]
    assert not follower.live.holds
    assert not any(note.startswith("held") for note in follower.notes)


def test_a_stop_that_the_network_loses_is_sent_again(
    follower: Follower, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost: list[str] = []
    query = follower.messenger._transport.query

    def losing(at: str, payload: bytes, timeout_s: float, sink: Any, tag: int) -> None:
        is_lost = at.endswith(Leaf.STOP.value) and lost.count(at) < 2
        if is_lost:
            lost.append(at)
        query(f"{at}-lost" if is_lost else at, payload, timeout_s, sink, tag)

    monkeypatch.setattr(follower.messenger._transport, "query", losing)
    follower.rig.at(1.0, follower.live.stop)
    follower.follow(3.0)
    assert len(lost) == 4
    assert [follower.rig.state(serial) for serial in follower.rig.serials] == ["stopped", "stopped"]


def test_a_key_lights_one_led_after_the_other_and_the_end_of_the_table_the_last(follower: Follower) -> None:
    lit: list[list[str]] = []
    modules = [host.modules[0].firmware.config.serial for host in follower.rig.hosts.values()]

    def look() -> None:
        drives = (host._hardware.identified for host in follower.rig.hosts.values())
        lit.append([serial for serials in drives for serial in serials])

    for k in range(4):
        follower.rig.at(1.0 + k, follower.live.light)
        follower.rig.at(1.5 + k, look)
    follower.follow(5.0)
    look()
    assert lit == [["X-00009"], ["X-00010"], [], ["X-00009"], []]
    assert follower.notes[1:3] == ["the LED of X-00010 is lit", "no LED is lit"]
    assert [follower.rig.state(serial) for serial in modules] == ["idle", "idle"]


def test_who_holds_a_module_is_named_where_it_cannot_be_held(follower: Follower) -> None:
    _, _, group = follower.rig.group("another")

    async def hold() -> None:
        await group.meet(follower.rig.serials)
        await group.acquire("X-00010")

    follower.rig.run(hold())
    follower.rig.loop.call_later(1.0, follower.live.hold)
    follower.follow(3.0)
    assert any("another" in note for note in follower.notes)
    assert not follower.live.holds


# ---------------------------------------------------------------------- shown


def example() -> list[ModuleState]:
    moving = ModuleState(
        "elbow",
        "Arm/lift",
        "X5-4",
        "moving",
        "me-7@host-1f",
        0.5,
        -0.1,
        1.25,
        31.0,
        23.9,
        250.0,
        12,
        FeedbackDelay("elbow", 500, -0.2, 4.0, 4.5, 0.3),
    )
    return [moving, ModuleState("wrist", "", None, "silent", None, refused={"no_lease": 3})]


def test_the_table_has_every_figure_with_its_unit() -> None:
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(table("arm", example()))
    shown = console.export_text()
    for words in (
        "1 of 2 modules",
        "28.65",
        "-5.7",
        "1.25",
        "31.0",
        "23.9",
        "Arm/lift",
        "me-7",
        "no_lease 3",
        "[deg]",
        "[Nm]",
        # What is known of a delay of -0.2 +- 0.3 ms.
        "< 0.3",
        "4.0",
    ):
        assert words in shown
    assert "host-1f" not in shown
    assert line(example()[1]).startswith("wrist silent: - deg")


def test_programs_read_a_line_of_json_a_module_and_second(tmp_path: Path) -> None:
    file = tmp_path / "states.jsonl"
    with ModuleScreen("arm", file, quiet=True, keys="") as screen:
        for k in range(9):
            screen.show(example(), 0.25 * k)
    lines = [json.loads(text) for text in file.read_text().splitlines()]
    assert [(each["t_s"], each["serial"]) for each in lines[::2]] == [
        (0.0, "elbow"),
        (1.0, "elbow"),
        (2.0, "elbow"),
    ]
    assert lines[0]["position_rad"] == 0.5
    assert lines[1]["refused"] == {"no_lease": 3}


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The other end of a terminal that is standard input."""
    master, slave = pty.openpty()
    with os.fdopen(slave, "r") as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield master
    os.close(master)


def test_a_key_acts_without_enter_and_the_terminal_is_left_as_it_was(terminal: int) -> None:
    before = termios.tcgetattr(sys.stdin.fileno())
    loop, pressed = asyncio.new_event_loop(), list[str]()
    actions = {"s": lambda: pressed.append("s"), "q": loop.stop}
    with key_presses(loop, actions) as there:
        assert there
        os.write(terminal, b"xSq")
        loop.run_forever()
    loop.close()
    assert pressed == ["s"]
    assert termios.tcgetattr(sys.stdin.fileno()) == before


def test_a_recording_has_no_modules_to_show() -> None:
    done = CliRunner().invoke(app, ["monitor", "--recording", "session.mcap"])
    assert done.exit_code == 2
    assert "--recording needs a baseline" in done.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--alarms-per-hour", "7"), "--alarms-per-hour is of findings, which need a baseline"),
        (
            ("a_run", "--recording", "a.mcap", "--for", "5"),
            "--for and --speed are of a robot that is monitored",
        ),
        (("a_run", "--recording", "a.mcap", "--speed", "2"), "a --recording is read whole"),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(arguments: tuple[str, ...], words: str) -> None:
    done = CliRunner().invoke(app, ["monitor", *arguments])
    assert done.exit_code == 2, done.output
    assert words in " ".join(done.output.split())

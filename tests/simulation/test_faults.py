"""Agents die, cables are pulled, messages come twice or late: a run ends well or says why not."""

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from coordinator.baseline.baseline_robot import load_baseline
from coordinator.excitation.plan import Plan
from coordinator.live_robot.errors import ModuleLost, MotionInterrupted, UnfitLink
from coordinator.live_robot.messenger import NoAnswer
from coordinator.monitoring.reference import build_reference, steps_of_run
from coordinator.recording.recording import Entry, RecordingFull
from coordinator.recording.run_folder import load_recording
from coordinator.recording.session_file import NotRecorded, SessionWriter, read_session
from coordinator.session.session import NoModulesFound
from module_agent.network_emulation.profile import NetworkProfile
from module_agent.wire.keys import Leaf, key
from module_agent.wire.proof import secret_for
from sim.scoring.score import score
from sim.virtual_time.loop import NS_PER_S
from tests.breadth import breadth
from tests.rig import SECRET

ARM = "thesis_171_horizontal"
BASE, TIP = "X-00009", "X-00010"
Rigs = Callable[..., Any]
pytestmark = pytest.mark.parametrize("physics", ["compiled", *breadth("pybullet")])


def _right(out: Path) -> None:
    found = score(out)
    assert found.topology_differences == []
    for link in found.links:
        assert link.link_length_error_mm is not None
        assert abs(link.link_length_error_mm) < 2.0  # see test_robots


def test_on_a_bad_network_the_robot_is_recognised_all_the_same(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    # Its round trips of up to 300 ms need modules that are told to be patient; at most a second is allowed.
    rig = rigs(ARM, "bad", 1, lifetime_ns=500_000_000)
    rig.session(tmp_path / "run", quick_plan)
    _right(tmp_path / "run")


@pytest.mark.parametrize("seed", range(2))
def test_with_impatient_modules_a_bad_network_ends_right_or_with_a_reason_and_all_stopped(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, seed: int
) -> None:
    rig = rigs(ARM, "bad", seed)
    try:
        rig.session(tmp_path / "run", quick_plan)
    except (UnfitLink, MotionInterrupted):
        assert not (tmp_path / "run" / "result.json").exists()
        assert {rig.state(s) for s in rig.serials} <= {"idle", "stopped", "expired"}
    else:
        _right(tmp_path / "run")


def test_messages_that_come_twice_and_out_of_order_change_nothing(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    echo = NetworkProfile(name="echo", delay_ms=1.0, jitter_ms=4.0, reorder=0.5, duplicate=0.5)
    rigs(ARM, echo, 1).session(tmp_path / "run", quick_plan)
    _right(tmp_path / "run")


@pytest.mark.parametrize("victim", [BASE, TIP])
@pytest.mark.parametrize("when_s", [0.7, 2.1, 4.3, 6.9])
def test_an_agent_that_is_killed_ends_the_run_by_name_and_the_others_are_stopped(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, victim: str, when_s: float
) -> None:
    rig = rigs(ARM, "lan", 2)
    rig.at(when_s, lambda: rig.kill(victim))
    with pytest.raises(ModuleLost, match=f"module {victim} is lost: its agent has left the network"):
        rig.session(tmp_path / "run", quick_plan)
    # Seen, said and stopped within a third of a second, and three attempts to stop the dead one.
    assert rig.loop.time() < when_s + 1.6
    other = TIP if victim == BASE else BASE
    assert rig.state(other) in ("stopped", "idle")
    assert not (tmp_path / "run" / "result.json").exists()
    failed = [e for e in load_recording(tmp_path / "run" / "session.mcap").journal if e.what == "failed"]
    assert len(failed) == 1
    assert f"no confirmation from {victim}" in failed[0].text
    assert failed[0].deaf == (victim,)


def test_an_agent_that_freezes_in_mid_motion_ends_the_run_by_name(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    rig = rigs(ARM, "wifi", 1)
    rig.at(4.0, lambda: rig.freeze(TIP))
    with pytest.raises(ModuleLost, match=rf"module {TIP} is lost: no feedback for 1\.\d s"):
        rig.session(tmp_path / "run", quick_plan)


@pytest.mark.parametrize("seed", [0, *breadth(2, 5)])
def test_a_motion_that_a_partition_interrupts_is_done_again(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, seed: int
) -> None:
    rig = rigs(ARM, "lan", seed)

    def part() -> None:
        rig.cut = True
        rig.loop.call_later(0.5, heal)

    def heal() -> None:
        rig.cut = False

    # At another moment of the base joint's third to eighth motion for every seed.
    rig.when(lambda: rig.state(BASE) == "moving" and rig.loop.time() > 3.0 + 0.7 * seed, part)
    rig.session(tmp_path / "run", quick_plan)
    _right(tmp_path / "run")
    recording = load_recording(tmp_path / "run" / "session.mcap")
    assert [e.what for e in recording.journal].count("note") >= 1
    assert any("trying again" in line for line in rig.notes)
    assert {s: m.status.expiries for s, m in recording.modules.items() if m.status} == {BASE: 1, TIP: 1}


def test_a_partition_on_the_way_back_does_not_cost_the_run(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    rig = rigs("thesis_171_vertical", "lan", 0)

    def heal() -> None:
        rig.cut = False

    def part() -> None:
        rig.cut = True
        rig.loop.call_later(0.5, heal)

    def back_home() -> bool:
        return any("back to where" in line for line in rig.notes) and rig.state(BASE) == "moving"

    rig.when(back_home, part)
    rig.session(tmp_path / "run", quick_plan)
    _right(tmp_path / "run")
    assert rig.world.plant.q_rad[0] == pytest.approx(rig.robot.start_rad[0], abs=0.1)


def test_a_network_that_cannot_keep_a_motion_alive_is_refused_before_anything_moves(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    for profile, complaint in (
        (NetworkProfile(name="slow", delay_ms=150.0), "round trips to module .* take"),
        (NetworkProfile(name="lossy", delay_ms=1.0, loss=0.6), "delivers|did not answer"),
    ):
        rig = rigs(ARM, profile)
        with pytest.raises((UnfitLink, NoAnswer), match=complaint):
            rig.session(tmp_path / profile.name, quick_plan)
        assert abs(rig.world.plant.q_rad[0] - rig.robot.start_rad[0]) < 0.02
        assert {rig.state(s) for s in rig.serials} == {"idle"}


def test_a_module_that_is_missing_is_said_before_anything_moves(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    rig = rigs(ARM, "lan")
    rig.kill(TIP)
    with pytest.raises(NoModulesFound, match="2 module expected, found 1: X-00009"):
        rig.session(tmp_path / "run", quick_plan)


def _crash(rig: Any, out: Path, plan: Plan, when: Callable[[], bool], expects: bool = True) -> None:
    """Run a session whose coordinator is killed once a condition holds, and wait until its leases lapse."""

    class Killed(BaseException):
        """SIGKILL: nothing runs after it."""

    def kill() -> None:
        rig.network.kill("coordinator")
        raise Killed

    rig.when(when, lambda: rig.loop.call_soon(kill))
    with pytest.raises(Killed):
        rig.session(out, plan, expects=expects)
    crashed = (out / "session.mcap").read_bytes()
    rig.end_tasks()
    rig.loop.call_later(2.0, rig.loop.stop)
    rig.loop.run_forever()
    (out / "session.mcap").write_bytes(crashed)


@pytest.mark.parametrize(
    ("gone", "new", "mode"),
    [
        ("", "elbow", "joint"),
        ("elbow", "", "simultaneous"),
        *breadth(("", "elbow", "simultaneous"), ("elbow", "", "joint")),
        # The lift hangs loose in the first session, which no motion of all joints at once survives.
        ("elbow", "shoulder-lift", "joint"),
    ],
)
def test_a_session_that_is_resumed_with_other_modules_measures_those_that_are_there(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, gone: str, new: str, mode: str
) -> None:
    """One that goes and one that comes are as many as before: counting them shows nothing."""
    rig = rigs("a2085_03", "lan", 3)
    out, plan = tmp_path / "run", quick_plan.model_copy(update={"mode": mode, "dynamics": False})
    if new:
        rig.kill(new)
    _crash(rig, out, plan, lambda: bool(rig.notes) and "back to where" in rig.notes[-1], expects=False)
    if gone:
        rig.kill(gone)
    if new:
        rig.boot(new)
    result = rig.session(out, plan, resume=True, sender="successor", expects=False)
    there = {"shoulder-yaw", "shoulder-lift", "elbow"} - {gone}
    assert (set(result.serials), result.suspicions) == (there, [])
    (said,) = [note for note in rig.notes if "since the session before" in note]
    assert all(f"{serial} {what}" in said for serial, what in ((gone, "went"), (new, "came")) if serial)


@pytest.mark.parametrize("when_s", [1.0, 9.0, *breadth(3.5, 6.0)])
def test_a_run_whose_coordinator_is_killed_is_resumed_and_ends_right(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, when_s: float
) -> None:
    rig = rigs(ARM, "lan", 5)
    out = tmp_path / "run"
    _crash(rig, out, quick_plan, lambda: rig.loop.now_ns >= when_s * NS_PER_S)
    # By now every motor is off, and every lease has lapsed.
    assert {rig.state(s) for s in rig.serials} <= {"idle", "expired"}
    rig.session(out, quick_plan, resume=True, sender="successor")
    _right(out)
    done = [e.step for e in load_recording(out / "session.mcap").journal if e.what == "done"]
    assert sorted(set(done)) == ["back", "explore/X-00009", "explore/X-00010", "home", "rest"]
    # No step is done again that had been done, but for going home.
    assert [s for s in done if s != "home"] == list(dict.fromkeys(s for s in done if s != "home"))
    assert not (out / "session.crashed.mcap").exists()
    assert json.loads((out / "result.json").read_text())["serials"] == [BASE, TIP]


@pytest.mark.parametrize("victim", [BASE, TIP])
def test_a_run_is_resumed_though_a_module_has_booted_since(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, victim: str
) -> None:
    """What it measured of the others' motions is of its earlier boot: all is measured anew."""
    rig = rigs(ARM, "lan", 5)
    out = tmp_path / "run"
    _crash(rig, out, quick_plan, lambda: any("joint X-00010" in note for note in rig.notes))
    rig.kill(victim)
    rig.boot(victim)
    rig.session(out, quick_plan, resume=True, sender="successor")
    _right(out)
    said = f"since the session before {victim} booted: the robot is measured anew"
    assert any(said in note for note in rig.notes)


@pytest.mark.parametrize(
    "break_s", [pytest.param(1.0, id="at once"), pytest.param(90.0, id="when its rows are forgotten")]
)
def test_a_resumed_run_says_what_is_normal_by_the_steps_of_its_sessions(
    rigs: Rigs, tmp_path: Path, break_s: float
) -> None:
    """Between them the arm hangs limp; modules remember a minute of that, and of more there is a hole."""
    rig = rigs("a2085_03", "lan", 3)
    out = tmp_path / "run"
    plan = Plan(mode="simultaneous", excitation="d-optimal", excitation_motions=4, excitation_s=4.0)
    _crash(rig, out, plan, lambda: rig.loop.now_ns >= 28.0 * NS_PER_S)
    rig.loop.call_later(break_s, rig.loop.stop)
    rig.loop.run_forever()
    again_ns = rig.loop.now_ns
    rig.session(out, plan, resume=True, sender="successor")

    known = load_baseline(out)
    motions, (before, after) = steps_of_run(known)
    assert len(motions) == 4
    begun = [(e.step, e.t_ns) for e in known.recording.journal if e.what == "begin"]
    # The motion in which the coordinator died is made again, and what it left of it is not looked at.
    died_ns, _ = (t_ns for step, t_ns in begun if step == "dynamic/1")
    assert died_ns - 8e6 < before.t_ns[-1] < died_ns
    first_ns = min(t_ns for _, t_ns in begun if t_ns > again_ns)
    assert first_ns <= after.t_ns[0] < first_ns + 4e6
    assert build_reference(known).together


class _FullDisk(SessionWriter):
    """A recording on a disk that is full after 12 s, in the middle of a motion."""

    def _write(self, entry: Entry) -> None:
        if entry.t_ns > 12_000_000_000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super()._write(entry)


@pytest.mark.parametrize(
    ("writer", "why"),
    [
        (lambda path, _: _FullDisk(path), "No space left on device"),
        (lambda path, _: SessionWriter(path, 300_000), "the limit of --max-disk"),
    ],
)
def test_when_nothing_can_be_recorded_any_more_the_robot_is_stopped_and_it_is_said(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writer: Any, why: str
) -> None:
    monkeypatch.setattr("coordinator.session.run.SessionWriter", writer)
    rig = rigs(ARM, "lan", 1)
    with pytest.raises(NotRecorded, match=why):
        rig.session(tmp_path / "run", quick_plan)
    # A stop goes out to all, though nothing is recorded of it.
    assert {rig.state(serial) for serial in rig.serials} == {"stopped"}
    kept = load_recording(tmp_path / "run" / "session.mcap")
    assert not kept.damage
    assert all(module.rows.count > 1000 for module in kept.modules.values())


def test_messages_on_made_up_keys_neither_end_a_session_nor_keep_its_stop_back(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rigs(ARM, "lan", 1)
    monkeypatch.setattr("coordinator.session.run.SessionWriter", lambda path, _: _FullDisk(path))
    monkeypatch.setattr("coordinator.recording.session_file.MAX_MODULES", 10)
    intruder = rig.endpoint("intruder")

    def publish() -> None:
        for number in range(50):
            for leaf in (Leaf.STATUS, Leaf.FEEDBACK):
                intruder.publish(key(rig.robot.name, f"made-up-{number}", leaf), b"noise")

    rig.at(8.0, publish)
    with pytest.raises(NotRecorded, match="No space left on device"):
        rig.session(tmp_path / "run", quick_plan)
    assert {rig.state(serial) for serial in rig.serials} == {"stopped"}
    (said,) = [line for line in rig.notes if "not recorded" in line]
    # Two messages of each made-up module that has no place beside those of the robot.
    assert said.startswith(f"{2 * (50 - 10 + len(rig.serials))} messages ")
    path = tmp_path / "run" / "session.mcap"
    kept = load_recording(path)
    assert not kept.damage
    assert all(kept.modules[serial].rows.count > 1000 for serial in rig.serials)
    # The leases were acquired with a secret, which no reader of the recording learns.
    acquired = [each for each in read_session(path) if each.topic.endswith("/lease")]
    assert len(acquired) > 10
    for secret in (SECRET, *(secret_for(serial, SECRET) for serial in rig.serials)):
        assert not any(secret in each.payload for each in read_session(path))
        assert secret not in path.read_bytes()


def test_a_session_whose_rows_fill_the_memory_stops_the_robot_and_says_of_which_module(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # 12 s at 250 Hz; in full an hour at 1 kHz. It takes longer than was expected.
    monkeypatch.setattr("module_agent.wire.row_log.MAX_ROWS", 3000)
    rig = rigs(ARM, "lan", 1)
    with pytest.raises(RecordingFull, match=rf"of module ({BASE}|{TIP}) .* rows of it, 0\.1.. min at 250 Hz"):
        rig.session(tmp_path / "run", quick_plan)
    assert {rig.state(serial) for serial in rig.serials} == {"stopped"}
    assert load_recording(tmp_path / "run" / "session.mcap").journal[-1].what == "failed"


@pytest.mark.parametrize("bound", ["MAX_ROWS", "MAX_ROWS_OF_ALL"])
def test_a_session_whose_rows_would_not_fit_into_the_memory_moves_nothing(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bound: str
) -> None:
    monkeypatch.setattr(f"coordinator.recording.recording.{bound}", 2000)
    rig = rigs(ARM, "lan", 1)
    with pytest.raises(RecordingFull, match=r"takes 0\.\d+ min and makes \d+ feedback rows of 2 modules"):
        rig.session(tmp_path / "run", quick_plan)
    assert {rig.state(serial) for serial in rig.serials} == {"idle"}

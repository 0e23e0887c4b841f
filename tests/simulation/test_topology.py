"""The session finds who is mounted on whom although modules do not respond, joints are stuck or disturbed."""

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from coordinator.excitation.segment import RobotMotion
from coordinator.identification.topology_search import TopologyFound, doubtful_motions, search_topology
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.recording.journal import JournalEvent, missing_modules
from coordinator.recording.recording import JOURNAL_TOPIC, Entry, Recording
from coordinator.session.session import NoModulesFound, Session
from coordinator.topology.next_motion import NextMotion
from module_agent.wire.keys import Leaf, parse
from module_agent.wire.messages import GoTo
from sim.benchmark.cases.topology import PLAN, topology_trial
from sim.virtual_time.network import VirtualEndpoint

# yaw - lift - elbow (reversed) - wrist: the first axis is vertical, so that nothing falls when it lets go.
ARM = """
name = "four"
[[module]]
serial = "yaw"
type = "X5-9"
parent = "base"
[[module]]
serial = "lift"
type = "X5-9"
parent = "yaw"
link = { bracket = "HeavyRightOutside" }
[[module]]
serial = "elbow"
type = "X5-4"
parent = "lift"
mounted = "reversed"
link = { tube = { length_m = 0.15, twist_rad = 0.5 } }
[[module]]
serial = "wrist"
type = "X5-1"
parent = "elbow"
link = { bracket = "X5LightRight" }
"""
Rigs = Callable[..., Any]


@pytest.fixture
def arm(rigs: Rigs, tmp_path: Path) -> Any:
    (tmp_path / "four.toml").write_text(ARM)
    return rigs(str(tmp_path / "four.toml"), "lan", 5, noise="x5-uncalibrated")


class Watcher:
    """A reporter of a session that keeps what it is told, and lets others hear of its steps."""

    def __init__(self, recording: Recording, on_step: Callable[[str], None]):
        self.recording = recording
        self.notes: list[str] = []
        self._on_step = on_step

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        assert index <= total
        self._on_step(text)

    def note(self, text: str) -> None:
        self.notes.append(text)

    def estimates(self, joint: str) -> None:
        """Nothing is drawn."""

    async def moving(self, serials: Sequence[str]) -> None:
        """Nothing is drawn."""

    async def doubts(self) -> Sequence[NextMotion]:
        return doubtful_motions(self.recording)

    async def explored(self) -> None:
        """What follows is computed afterwards."""

    async def excitation(self) -> Sequence[RobotMotion]:
        self.notes.append("asked for motions of all joints")
        return ()

    def journal(self, event: JournalEvent) -> None:
        self.recording.add(Entry("journal", JOURNAL_TOPIC, event.t_ns, event.encode()))


def explore(
    rig: Any, plan: Plan = PLAN, on_step: Callable[[str], None] = lambda text: None
) -> tuple[Recording, Watcher]:
    messenger, recording, group = rig.group("coordinator")
    watcher = Watcher(recording, on_step)
    rig.run(
        Session(group, messenger, recording, plan, lambda: rig.loop.now_ns, watcher.journal, watcher).run()
    )
    messenger.close()
    return recording, watcher


def rested(recording: Recording) -> list[str]:
    return sorted({e.serial for e in recording.journal if e.purpose == "rest"})


def edges(found: TopologyFound) -> dict[str, tuple[str, bool]]:
    topology = found.topology
    names = (*topology.serials, "base")
    columns = zip(topology.serials, topology.parent, topology.reversed, strict=True)
    return {serial: (names[p], turned) for serial, p, turned in columns}


WHOLE = {"yaw": ("base", False), "lift": ("yaw", False), "elbow": ("lift", True), "wrist": ("elbow", False)}


def test_an_arm_that_nothing_disturbs_is_found_without_a_doubt(arm: Any) -> None:
    recording, watcher = explore(arm)
    found = search_topology(recording, arm.serials)
    assert edges(found) == WHOLE
    assert found.topology.doubts == ()
    assert found.topology.confidence > 0.99
    assert not any("again" in note for note in watcher.notes)


def test_what_a_joint_with_a_dead_motor_carries_shows_on_what_carries_it(arm: Any) -> None:
    index = arm.serials.index("yaw")
    arm.on_tick.append(lambda: arm.pwm.__setitem__(index, 0.0))
    found = search_topology(explore(arm)[0], arm.serials)
    assert found.topology.unmoved == ("yaw",)
    assert edges(found) == WHOLE | {"lift": ("base", False)}
    (why,) = found.missing
    assert why.startswith("joint yaw did not move")
    assert why in found.notes


def test_a_push_while_a_joint_moves_is_a_doubt_that_another_motion_settles(arm: Any) -> None:
    """Somebody turns the arm's first joint while the wrist makes its slow motion: all IMUs turn along."""
    yaw, until_s = arm.serials.index("yaw"), [0.0]

    def listen(text: str) -> None:
        if text == "exploring joint wrist":
            until_s[0] = arm.loop.time() + 2.0

    def push() -> None:
        if arm.loop.time() < until_s[0]:
            arm.pwm[yaw] = 0.6

    arm.on_tick.append(push)
    recording, watcher = explore(arm, on_step=listen)
    found = search_topology(recording, arm.serials)
    assert edges(found) == WHOLE
    assert any(e.what == "done" and e.step == "settle/0/wrist" for e in recording.journal)
    assert any("joint wrist moves" in note and "sure" not in note for note in watcher.notes)


@pytest.mark.parametrize(("gone", "left"), [("wrist", {}), ("elbow", {"wrist": ("lift", False)})])
def test_a_module_that_does_not_answer_is_left_out_and_all_else_is_right(
    arm: Any, gone: str, left: dict[str, tuple[str, bool]]
) -> None:
    arm.run(asyncio.sleep(0.2))
    arm.freeze(gone)
    recording, watcher = explore(arm)
    found = search_topology(recording, rested(recording))
    assert edges(found) == {s: on for s, on in (WHOLE | left).items() if s != gone}
    assert any(f"going on without {gone}" in note for note in watcher.notes)
    (missing,) = found.missing
    assert missing.startswith(f"{gone} took no part")
    assert missing in found.notes


def test_a_module_that_sends_no_feedback_is_left_out_by_name(
    arm: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish = VirtualEndpoint.publish

    def mute(self: VirtualEndpoint, key: str, payload: bytes) -> None:
        if parse(key)[1:] != ("wrist", Leaf.FEEDBACK):
            publish(self, key, payload)

    monkeypatch.setattr(VirtualEndpoint, "publish", mute)
    recording, watcher = explore(arm)
    assert edges(search_topology(recording, rested(recording))) == {s: WHOLE[s] for s in arm.serials[:3]}
    assert any("module wrist answers, but sends no feedback" in note for note in watcher.notes)
    (missing,) = search_topology(recording, rested(recording)).missing
    assert missing.startswith("wrist took no part")


def narrow_elbow(arm: Any) -> None:
    """Let the elbow allow less than exploring it takes."""
    limits = arm.hosts["elbow"].modules[0].firmware.config.limits
    narrow = limits.model_copy(update={"min_position_rad": -0.1, "max_position_rad": 0.1})
    arm.kill("elbow")
    arm.boot("elbow", limits=narrow)


@pytest.mark.parametrize("narrow", [False, True])
def test_all_joints_are_excited_together_only_if_all_take_part(arm: Any, narrow: bool) -> None:
    if narrow:
        narrow_elbow(arm)
    update = {"dynamics": True, "excitation": "d-optimal", "dynamic_repeats": 1}
    recording, watcher = explore(arm, PLAN.model_copy(update=update))
    assert ("asked for motions of all joints" in watcher.notes) != narrow
    excited = {e.serial for e in recording.journal if e.purpose == "dynamic"}
    # Nothing was designed here, or nothing asked for: joint by joint, without who is left out.
    assert excited == set(arm.serials) - ({"elbow"} if narrow else set())


def test_no_joint_is_excited_where_a_module_is_missing(arm: Any) -> None:
    """Without it no inertia is identified."""
    arm.run(asyncio.sleep(0.2))
    arm.freeze("wrist")
    recording, watcher = explore(arm, PLAN.model_copy(update={"dynamics": True, "dynamic_repeats": 1}))
    assert {e.purpose for e in recording.journal if e.what == "motion"}.isdisjoint({"dynamic", "held_out"})
    assert "no motions for the inertia: the robot is not known whole without wrist" in watcher.notes
    assert recording.journal[-1].step == "back"


def test_a_joint_whose_limits_forbid_the_motion_is_named_and_all_else_is_explored(arm: Any) -> None:
    narrow_elbow(arm)
    recording, watcher = explore(arm)
    found = search_topology(recording, rested(recording))
    assert found.topology.unmoved == ("elbow",)
    assert edges(found) == WHOLE | {"elbow": ("lift", False), "wrist": ("lift", False)}
    assert any("going on without elbow" in note for note in watcher.notes)
    # It is well, and there: what it refuses is no reason to doubt the others.
    assert any(note.startswith("elbow took no part") for note in found.notes)
    assert found.missing == ()


def test_a_pause_of_the_network_is_survived_though_a_joint_has_been_excluded(arm: Any) -> None:
    """All motors let go, that of the excluded joint too: nobody takes it again, nor waits for it."""
    narrow_elbow(arm)

    def part(text: str) -> None:
        if text == "exploring joint wrist":
            arm.at(arm.loop.time() + 1.0, lambda: setattr(arm, "cut", True))
            arm.at(arm.loop.time() + 1.35, lambda: setattr(arm, "cut", False))

    recording, _ = explore(arm, on_step=part)
    assert any(e.what == "done" and e.step == "explore/wrist" for e in recording.journal)
    assert recording.journal[-1].step == "back"
    (missing,) = search_topology(recording, rested(recording)).missing
    assert missing.startswith(
        "elbow took no part: it did not hold its joint to the end: its state is expired"
    )


def test_a_motor_that_protects_itself_while_it_is_explored_is_left_out(arm: Any) -> None:
    """Taking it again is refused: nothing else of the robot is lost by that."""

    def heat(text: str) -> None:
        if text == "exploring joint lift":
            above_k = np.zeros((3, 4))
            above_k[:, arm.serials.index("lift")] = 150.0
            arm.at(arm.loop.time() + 1.0, lambda: arm.world.warm(above_k))

    recording, watcher = explore(arm, on_step=heat)
    assert any(note.startswith("going on without lift") for note in watcher.notes)
    assert {e.step for e in recording.journal if e.what == "done"} >= {
        "explore/elbow",
        "explore/wrist",
        "back",
    }


def test_two_joints_that_may_not_go_home_are_left_out(arm: Any) -> None:
    for serial in ("elbow", "wrist"):
        limits = arm.hosts[serial].modules[0].firmware.config.limits
        away = limits.model_copy(update={"min_position_rad": 0.5, "max_position_rad": 1.5})
        arm.kill(serial)
        arm.boot(serial, limits=away)
    recording, watcher = explore(arm)
    assert {note.split(":")[0] for note in watcher.notes if note.startswith("going on without")} == {
        "going on without elbow",
        "going on without wrist",
    }
    assert {e.serial for e in recording.journal if e.purpose == "constant"} == {"yaw", "lift"}


def test_the_way_home_after_an_interrupted_trial_is_as_slow_as_the_trial(
    arm: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    speeds: dict[bool, set[float]] = {True: set(), False: set()}
    run, tried, cut = ModuleGroup.run, [False], [False]

    async def noted(self: ModuleGroup, patterns: Any, *rest: Any) -> Any:
        speeds[tried[0]] |= {one.max_speed_rad_s for one in patterns.values() if isinstance(one, GoTo)}
        return await run(self, patterns, *rest)

    def part(text: str) -> None:
        tried[0] = tried[0] or text == "all joints to their home position"
        if text == "every joint slowly, a little" and not cut[0]:
            cut[0] = True
            arm.at(arm.loop.time() + 1.0, lambda: setattr(arm, "cut", True))
            arm.at(arm.loop.time() + 1.35, lambda: setattr(arm, "cut", False))

    monkeypatch.setattr(ModuleGroup, "run", noted)
    plan = PLAN.model_copy(update={"trial_speed_rad_s": 0.2})
    _, watcher = explore(arm, plan, part)
    assert any("re-arming and trying again" in note for note in watcher.notes)
    assert speeds[False] == {0.2}
    assert plan.travel_speed_rad_s in speeds[True]


def test_a_module_that_its_limits_excluded_and_that_lets_go_of_its_joint_later_is_missing(arm: Any) -> None:
    narrow_elbow(arm)

    def overheat(step: str) -> None:
        if step == "exploring joint yaw":
            arm.hosts["elbow"].modules[0].firmware._enter("fault", "winding at 121 C")

    recording, _ = explore(arm, on_step=overheat)
    (why,) = missing_modules(recording.journal, arm.serials)
    held = "it did not hold its joint to the end: its state is fault: winding at 121 C"
    assert why == f"elbow took no part: {held}"


def test_where_no_module_responds_the_session_says_so(arm: Any) -> None:
    arm.run(asyncio.sleep(0.2))
    for serial in arm.serials:
        arm.freeze(serial)
    with pytest.raises(NoModulesFound, match=r"themselves responds: module .* did not answer on info"):
        explore(arm)


def test_a_session_that_breaks_off_has_found_nothing_and_says_why(tmp_path: Path) -> None:
    """Six seconds without any message in the midst of the exploration."""
    parted = tmp_path / "parted.toml"
    parted.write_text("delay_ms = 0.5\npartitions = [[3.0, 9.0]]\n")
    found = topology_trial(14, network=str(parted))
    assert found.confidence == 0.0
    assert "is lost" in found.differences[0]


def test_a_random_robot_finds_out_how_it_is_built() -> None:
    found = topology_trial(14)
    assert found.modules == 5
    assert found.differences == ()
    assert found.confidence > 0.99

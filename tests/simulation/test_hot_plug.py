"""A module is added, taken off or swapped: only what is other is measured again, the rest is kept."""

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from typer.testing import CliRunner

from coordinator.baseline.baseline_robot import BASELINE, BaselineRobot, load_baseline
from coordinator.excitation.plan import Plan
from coordinator.live_robot.errors import ModulesJoined
from coordinator.main import app
from coordinator.recording.run_folder import RESULT, load_recording
from module_agent.model.chain import Chain
from module_agent.wire.keys import Leaf, key
from sim.robot.robot_file import Robot, load_robot
from sim.scoring.score import score
from sim.virtual_time.run import VirtualConfig, run_virtual
from tests.rig import Notes, Rig

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("hot_plug")

ARM = "a2085_03"


class Updated(NamedTuple):
    """A robot brought up to date: as it was known, as it is, and what was said."""

    known: BaselineRobot
    found: BaselineRobot
    notes: list[str]


Bring = Callable[[Robot, Robot], Updated]


@pytest.fixture(scope="module")
def bring(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bring]:
    """Let a robot be known, and bring it up to date another day.

    The known robot is identified once from its recording, for the tests and for all runs that begin with it.
    """
    loaded_once = cache(load_baseline)
    known: dict[tuple[str, ...], Path] = {}
    done: dict[tuple[tuple[str, ...], ...], Updated] = {}
    short = Plan(
        dynamics=False, sine_centre_s=1.2, sine_sigma_s=0.5, settle_s=0.3, simultaneous_duration_s=6.0
    )

    def run(robot: Robot, out: Path, day: int, before: Path | None = None) -> list[str]:
        notes = Notes()
        run_virtual(
            VirtualConfig(robot, out, 3, noise_seed=day, noise="x5", plan=short, baseline=before), notes
        )
        return notes.lines

    def make(before: Robot, after: Robot) -> Updated:
        case = before.serials, after.serials
        if case in done:
            return done[case]
        folder = tmp_path_factory.mktemp("plug")
        if before.serials not in known:
            known[before.serials] = folder / "known"
            run(before, folder / "known", 0)
        lines = run(after, folder / "new", 1, known[before.serials])
        done[case] = Updated(loaded_once(known[before.serials]), load_baseline(folder / "new"), lines)
        return done[case]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("coordinator.session.run.load_baseline", loaded_once)
        yield make


def _without_last(robot: Robot) -> Robot:
    return robot.model_copy(update={"modules": robot.modules[:-1]})


def _swapped(robot: Robot, k: int) -> Robot:
    """Another module of the same type in one place."""
    names = {robot.serials[k]: "spare"}
    modules = tuple(
        m.model_copy(
            update={"serial": names.get(m.serial, m.serial), "parent": names.get(m.parent, m.parent)}
        )
        for m in robot.modules
    )
    return robot.model_copy(update={"modules": modules})


def _explored(lines: list[str]) -> list[str]:
    """Return the joints that were moved by themselves."""
    return [line.rsplit(" ", 1)[-1] for line in lines if "exploring joint " in line]


def _seen_from(chain: Chain, first: str, serial: str) -> np.ndarray:
    a, b = (chain.imu_home[chain.serials.index(s)] for s in (first, serial))
    return np.asarray(np.linalg.inv(a) @ b)


def test_a_module_that_was_added_is_measured_and_the_others_are_kept(bring: Bring) -> None:
    robot = load_robot(ARM)
    first, second, last = robot.serials
    done = bring(_without_last(robot), robot)
    assert _explored(done.notes) == [first, second]
    assert f"module {last} is new" in done.notes
    found = score(done.found.folder)
    assert found.topology_correct
    kept = (_seen_from(run.chain, first, second) for run in (done.known, done.found))
    assert np.allclose(next(kept), next(kept), atol=1e-9)
    # The new link's own error is that of any short exploration: 0.3 % of 0.33 m, and its claim covers it.
    (link,) = [one for one in found.links if one.child == last]
    assert link.link_length_error_mm is not None
    assert link.link_length_sigma_mm is not None
    assert abs(link.link_length_error_mm) < max(3.0 * link.link_length_sigma_mm, 1.0)
    assert link.link_length_sigma_mm < 10.0


def test_a_module_that_was_taken_off_moves_nothing_but_a_glance(bring: Bring) -> None:
    robot = load_robot(ARM)
    done = bring(robot, _without_last(robot))
    assert _explored(done.notes) == []
    assert f"module {robot.serials[-1]} is missing" in done.notes
    assert done.found.chain.serials == robot.serials[:-1]
    kept = (_seen_from(run.chain, *robot.serials[:2]) for run in (done.known, done.found))
    assert np.allclose(next(kept), next(kept), atol=1e-9)
    assert score(done.found.folder).topology_correct


def test_of_a_module_that_was_swapped_only_its_own_links_are_measured_again(bring: Bring) -> None:
    robot = load_robot(ARM)
    done = bring(robot, _swapped(robot, 1))
    assert _explored(done.notes) == [robot.serials[0], "spare"]
    assert {f"module {robot.serials[1]} is missing", "module spare is new"} <= set(done.notes)
    found = score(done.found.folder)
    assert found.topology_correct
    for link in found.links:
        assert link.link_length_error_mm is not None
        assert link.link_length_sigma_mm is not None
        assert abs(link.link_length_error_mm) < max(3.0 * link.link_length_sigma_mm, 1.0)


def test_the_folder_tells_the_robot_by_itself_and_a_replay_the_same(bring: Bring, tmp_path: Path) -> None:
    robot = load_robot(ARM)
    done = bring(robot, _swapped(robot, 1))
    assert (done.found.folder / BASELINE / "session.mcap").is_file()
    again = CliRunner().invoke(
        app, ["replay", str(done.found.folder / "session.mcap"), "--out", str(tmp_path)]
    )
    assert again.exit_code == 0, again.output
    assert (tmp_path / RESULT).read_text() == (done.found.folder / RESULT).read_text()


def test_a_folder_that_holds_no_run_is_no_known_robot(tmp_path: Path) -> None:
    arguments = [
        "run",
        "--out",
        str(tmp_path / "new"),
        "--listen",
        "tcp/127.0.0.1:0",
        "--baseline",
        str(tmp_path),
    ]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 2
    assert not (tmp_path / "new").exists()


def _boots(rig: Rig, serial: str, during: str) -> None:
    """Let a module join while a joint moves in the first step with these words."""
    others = [s for s in rig.serials if s != serial]

    def moves() -> bool:
        return during in rig.notes[-1] and any(rig.state(s) == "moving" for s in others)

    rig.when(lambda: bool(rig.notes) and moves(), lambda: rig.boot(serial))


@pytest.mark.parametrize(("during", "dynamics"), [("exploring joint", False), ("exciting joint", True)])
def test_a_module_that_joins_in_the_middle_of_a_session_is_measured_with_the_others(
    rigs: Callable[..., Rig], quick_plan: Plan, tmp_path: Path, during: str, dynamics: bool
) -> None:
    rig = rigs(ARM, "lan", 2)
    last = rig.serials[-1]
    rig.kill(last)
    _boots(rig, last, during)
    plan = quick_plan.model_copy(update={"dynamics": dynamics})
    result = rig.session(tmp_path / "run", plan, expects=False)
    (said,) = [line for line in rig.notes if "in the middle of a session" in line]
    assert said.startswith(f"module {last} came")
    assert set(result.serials) == set(rig.serials)
    found = score(tmp_path / "run")
    assert found.topology_correct
    for link in found.links:
        assert link.link_length_error_mm is not None
        assert link.link_length_sigma_mm is not None
        assert abs(link.link_length_error_mm) < max(3.0 * link.link_length_sigma_mm, 1.0)
    assert all(rig.state(serial) == "idle" for serial in rig.serials)
    # A replay finds the same robot in the same recording.
    again = CliRunner().invoke(
        app, ["replay", str(tmp_path / "run" / "session.mcap"), "--out", str(tmp_path / "again")]
    )
    assert again.exit_code == 0, again.output
    assert (tmp_path / "again" / RESULT).read_text() == (tmp_path / "run" / RESULT).read_text()


def test_where_modules_are_counted_one_that_joins_ends_the_session_by_name(
    rigs: Callable[..., Rig], quick_plan: Plan, tmp_path: Path
) -> None:
    rig = rigs(ARM, "lan", 2)
    last = rig.serials[-1]
    rig.kill(last)
    _boots(rig, last, "exploring joint")
    run = rig.begin(tmp_path / "run", quick_plan, expect=len(rig.serials) - 1)
    with pytest.raises(ModulesJoined, match=f"module {last} came in the middle of a session"):
        rig.run(run.run())
    # It joined while a joint moved, and was seen when that had come to rest.
    assert all(rig.state(serial) in ("stopped", "idle") for serial in rig.serials)
    journal = load_recording(tmp_path / "run" / "session.mcap").journal
    assert journal[-1].what == "failed"


def test_a_token_without_a_module_disturbs_no_session_and_is_reason_to_doubt_it(
    rigs: Callable[..., Rig], quick_plan: Plan, tmp_path: Path
) -> None:
    rig = rigs("thesis_171_horizontal", "lan", 2)
    ghost = rig.network.endpoint("ghost")
    rig.at(3.0, lambda: ghost.declare_alive(key(rig.robot.name, "X-66666", Leaf.ALIVE)))
    result = rig.session(tmp_path / "run", quick_plan, expects=False)
    assert set(result.serials) == set(rig.serials)
    assert any("going on without X-66666" in line for line in rig.notes)
    # Nobody can tell it from a module that hangs: the robot may have one more.
    (why,) = result.suspicions
    assert why.startswith("X-66666 took no part")


def test_a_module_that_joins_when_all_is_measured_is_no_part_of_the_result_and_that_is_said(
    rigs: Callable[..., Rig], quick_plan: Plan, tmp_path: Path
) -> None:
    rig = rigs(ARM, "lan", 2)
    last = rig.serials[-1]
    rig.kill(last)
    _boots(rig, last, "back to where it stood")
    result = rig.session(tmp_path / "run", quick_plan, expects=False)
    assert set(result.serials) == set(rig.serials) - {last}
    (why,) = result.suspicions
    assert last in why
    assert "when all had been measured" in why


def test_a_module_that_joins_when_the_others_are_released_already_is_said_too(
    rigs: Callable[..., Rig], quick_plan: Plan, tmp_path: Path
) -> None:
    rig = rigs(ARM, "lan", 2)
    *others, last = rig.serials
    rig.kill(last)

    def released() -> bool:
        return "back to where" in rig.notes[-1] and all(rig.state(s) == "idle" for s in others)

    rig.when(lambda: bool(rig.notes) and released(), lambda: rig.boot(last))
    result = rig.session(tmp_path / "run", quick_plan, expects=False)
    assert set(result.serials) == set(others)
    assert [why for why in result.suspicions if "when all had been measured" in why]

"""A known robot is checked on another day: a displaced link is found, an unchanged robot raises no alarm.

Modules are as delivered, with uncalibrated IMUs, on links that give.
"""

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from typer.testing import CliRunner

from coordinator.baseline.baseline_robot import BaselineError, BaselineRobot, load_baseline
from coordinator.baseline.check import check, check_plan
from coordinator.commands.measured_again import CHECK
from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify_kinematics
from coordinator.main import app
from coordinator.runtime.terminal import Terminal
from module_agent.model.errors import EXIT_FINDING, EXIT_SUSPECT
from module_agent.network_emulation.profile_file import network
from sim.benchmark.cases.link_change import LinkChange, draw_link_change, with_link_change
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.run import VirtualConfig, run_virtual
from sim.virtual_time.session import record_session

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("check")

ARM = "a2085_03"
SLIPPED_M = 4e-3


class Days(NamedTuple):
    """The same robot: as it is known, unchanged on another day, and with a displaced link."""

    known: BaselineRobot
    sound: BaselineRobot
    changed: BaselineRobot
    change: LinkChange


# A run's robot is identified once from its recording, for this file's tests and for the commands in them.
loaded_once = cache(load_baseline)


def _lived(robot: Robot, out: Path, day: int, plan: Plan) -> BaselineRobot:
    """Return the robot of a run, or of the same session without a folder where its motions are designed."""
    if plan.motions == "optimised":
        recording = record_session(VirtualSettings(robot, network("lan"), 5, noise_seed=day), plan)
        return BaselineRobot(out, recording, identify_kinematics(recording))
    run_virtual(VirtualConfig(robot, out, seed=5, noise_seed=day, network="lan", plan=plan), Terminal(True))
    return loaded_once(out)


KNOWN_BY = {
    "thesis": Plan(dynamics=False, sine_centre_s=1.6, sine_sigma_s=0.7),
    "designed": Plan(dynamics=False, motions="optimised"),
}


@pytest.fixture(scope="module", params=list(KNOWN_BY))
def days(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Days:
    folder, robot = tmp_path_factory.mktemp("days"), load_robot(ARM)
    known = _lived(robot, folder / "known", 0, KNOWN_BY[request.param])
    plan = check_plan(known, Plan())
    change = LinkChange(robot.serials[2], np.array([SLIPPED_M, 0.0, 0.0]))
    return Days(
        known,
        _lived(robot, folder / "sound", 1, plan),
        _lived(with_link_change(robot, change), folder / "changed", 2, plan),
        change,
    )


def test_an_unchanged_robot_raises_no_alarm(days: Days) -> None:
    report = check(days.known, days.sound)
    assert not report.changed
    assert report.summary[0].startswith("no link has changed")
    # What would have been found is about what is: no claim of micrometres.
    assert all(link.would_find_mm is None or link.would_find_mm > 0.5 for link in report.links)
    # Three joints of 8 s, and the session's own 6 s; motions that are designed take 10 s a joint, and more
    # for so few of them.
    assert report.robot_time_s < (30.0 if report_of_thesis(days) else 36.0)


def report_of_thesis(days: Days) -> bool:
    return all(e.purpose != "whole" for e in days.known.recording.journal)


def test_a_check_runs_the_motions_that_the_robot_is_known_from(days: Days) -> None:
    """What a model leaves out of a motion cancels only then; the thesis' are cut short, and no more."""

    def patterns(run: BaselineRobot) -> list[object]:
        moved = [e for e in run.recording.journal if e.what == "motion" and e.purpose == "windowed_sine"]
        return [(e.serial, e.motion.pattern) for e in moved if e.motion is not None]

    assert patterns(days.known) == patterns(days.sound)


def test_a_link_that_slipped_is_found_located_and_sized(days: Days) -> None:
    report = check(days.known, days.changed)
    named = [link for link in report.links if link.changed]
    assert [link.child for link in named] == [days.change.child]
    # The bar of a 2 mm change.
    assert np.linalg.norm(np.array(named[0].displacement_mm) - 1e3 * days.change.displacement_m) < 0.5
    assert abs(named[0].length_mm - 1e3 * SLIPPED_M) < 3.0 * named[0].length_sigma_mm
    assert named[0].sigmas > 4.0
    assert days.change.child in report.summary[0]


@pytest.mark.parametrize("days", ["thesis"], indirect=True)
def test_the_command_says_so_and_exits_with_4(days: Days, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coordinator.commands.measured_again.load_baseline", loaded_once)
    arguments = ["check", str(days.known.folder), "--measured"]
    sound = CliRunner().invoke(app, [*arguments, str(days.sound.folder)])
    assert sound.exit_code == 0, sound.output
    moot = CliRunner().invoke(app, [*arguments, str(days.sound.folder), "--expect", "4"])
    assert moot.exit_code == 2
    assert "--expect is of a new run: --measured compares with a finished one" in " ".join(
        moot.output.split()
    )
    slipped = CliRunner().invoke(app, [*arguments, str(days.changed.folder), "--json", "-"])
    assert slipped.exit_code == EXIT_FINDING
    written = json.loads((days.changed.folder / CHECK).read_text())
    assert written["changed"] is True
    assert [link["child"] for link in written["links"] if link["changed"]] == [days.change.child]
    assert not list(days.changed.folder.glob("*.part"))


@pytest.mark.parametrize("days", ["thesis"], indirect=True)
def test_a_later_run_that_began_with_a_suspect_one_ends_the_command_with_5(
    days: Days, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its IMUs may be elsewhere than it takes them to be, and so may its links."""
    kinematics = days.sound.kinematics
    told = kinematics.refinement.calibration_information
    began = kinematics._replace(measured=(told._replace(session="5eed", suspicions=("base took no part",)),))
    later = days.sound._replace(kinematics=began)
    runs = {days.known.folder: days.known, days.sound.folder: later}
    monkeypatch.setattr("coordinator.commands.measured_again.load_baseline", runs.__getitem__)
    done = CliRunner().invoke(app, ["check", str(days.known.folder), "--measured", str(days.sound.folder)])
    assert done.exit_code == EXIT_SUSPECT
    assert "it began with recording 5eed, and there base took no part" in " ".join(done.output.split())


def test_modules_that_are_not_the_known_ones_are_named(days: Days) -> None:
    topology = days.sound.kinematics.topology
    other = topology._replace(serials=(*topology.serials[:-1], "stranger"))
    report = check(days.known, days.sound._replace(kinematics=days.sound.kinematics._replace(topology=other)))
    assert report.changed
    assert report.modules_missing == [topology.serials[-1]]
    assert report.modules_new == ["stranger"]


def test_a_folder_without_a_recording_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(BaselineError, match=r"holds no session\.mcap"):
        load_baseline(tmp_path)
    done = CliRunner().invoke(app, ["check", str(tmp_path), "--out", str(tmp_path / "new")])
    assert done.exit_code == 2


def test_a_check_needs_a_robot_or_a_run(tmp_path: Path) -> None:
    assert CliRunner().invoke(app, ["check", str(tmp_path)]).exit_code == 2


@pytest.mark.parametrize("name", ["arm6", "a2085_06", "tree_y"])
def test_a_link_change_displaces_its_module_and_what_is_beyond_it_only(name: str) -> None:
    robot = load_robot(name)
    sound = true_chain(robot)
    for seed in range(5):
        change = draw_link_change(robot, seed, 2e-3)
        assert np.linalg.norm(change.displacement_m) == pytest.approx(2e-3)
        k = robot.serials.index(change.child)
        moved = true_chain(with_link_change(robot, change)).imu_home[:, :3, 3] - sound.imu_home[:, :3, 3]
        assert moved[k] == pytest.approx(sound.imu_home[k, :3, :3] @ change.displacement_m, abs=1e-12)
        assert np.allclose(moved[:k], 0.0, atol=1e-12)

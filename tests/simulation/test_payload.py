"""A known arm with a tool is handed something, and says what it is from one short motion."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from coordinator.baseline.baseline_robot import BaselineRobot, load_baseline
from coordinator.baseline.payload import PayloadError, payload_plan, search_payload
from coordinator.commands.measured_again import PAYLOAD
from coordinator.description.urdf_writer import link_homes
from coordinator.excitation.plan import Plan
from coordinator.main import app
from coordinator.runtime.terminal import Terminal
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import EXIT_USAGE
from module_agent.network_emulation.profile_file import network
from sim.benchmark.cases.link_change import known_robot
from sim.geometry.link_parts import FreePose
from sim.robot.robot_file import Robot, load_robot
from sim.robot.robot_tree import true_chain, true_inertia
from sim.robot.variants import loaded
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.run import VirtualConfig, run_virtual

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("payload")

ARM = "a2085_03"
HELD = FreePose(mass_kg=0.2, com_xyz_m=(0.04, 0.0, 0.02), inertia=(1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0))
TWICE = FreePose(mass_kg=0.4, com_xyz_m=HELD.com_xyz_m, inertia=(2e-4, 2e-4, 2e-4, 0.0, 0.0, 0.0))
PLAN = Plan(excitation="d-optimal", excitation_motions=3, excitation_s=4.0, imu="calibrated")
# A run's robot is identified once from its recording, for this file's tests and for the commands in them.
loaded_once = cache(load_baseline)


def holding(held: FreePose) -> Robot:
    robot = load_robot(ARM)
    return loaded(robot, robot.serials[-1], held)


def lived(robot: Robot, out: Path, day: int, plan: Plan) -> BaselineRobot:
    config = VirtualConfig(robot, out, seed=6, noise_seed=day, network="lan", noise="x5", plan=plan)
    run_virtual(config, Terminal(True))
    return loaded_once(out)


def remembered(robot: Robot, day: int, plan: Plan) -> BaselineRobot:
    """The same without a folder."""
    return known_robot(VirtualSettings(robot, network("lan"), 6, "x5", noise_seed=day), plan, day)


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> BaselineRobot:
    """The robot with a tool: it is known once, for what is added to the tool and for what is taken off."""
    return lived(holding(HELD), tmp_path_factory.mktemp("payload") / "known", 0, PLAN)


@pytest.fixture(scope="module")
def later(known: BaselineRobot, tmp_path_factory: pytest.TempPathFactory) -> BaselineRobot:
    return lived(holding(TWICE), tmp_path_factory.mktemp("payload") / "later", 1, payload_plan(known, Plan()))


def test_mass_and_centre_are_found_from_one_motion(known: BaselineRobot, later: BaselineRobot) -> None:
    report = search_payload(known, later)
    assert report.found
    assert report.carrier == known.chain.serials[-1]
    assert report.motion_s < 15.0
    # 3 %, as a springy arm's torque sensors allow.
    assert report.mass_kg == pytest.approx(0.2, abs=0.006)
    found = (link_homes(known.chain)[-1] @ np.append(1e-3 * np.array(report.com_mm), 1.0))[:3]
    # Across the axis and along it, from the module's own IMU: the true root frame is turned against ours.
    added = true_inertia(holding(TWICE)) - true_inertia(holding(HELD))
    truth = from_axis(true_chain(load_robot(ARM)), added[-1, 1:4] / added[-1, 0])
    across, along = from_axis(known.chain, found) - truth
    assert abs(across) < 5e-3
    # The joints that hold this arm up are all parallel to its last axis: gravity tells nothing along it.
    assert abs(along) < 4e-3 * report.com_sigma_mm[2]


def from_axis(chain: Chain, place_m: Array) -> Array:
    """How far from the last axis, and how far along it from the last IMU."""
    axis, imu = chain.axis[-1], chain.imu_home[-1, :3, 3]
    off = place_m - chain.point[-1]
    return np.array([np.linalg.norm(off - axis * (axis @ off)), axis @ (place_m - imu)])


def test_an_arm_that_was_handed_nothing_says_so(known: BaselineRobot) -> None:
    report = search_payload(known, remembered(holding(HELD), 2, payload_plan(known, Plan())))
    assert not report.found
    assert report.explained
    assert "no payload detected" in report.summary[0]


def test_what_was_taken_off_is_not_taken_for_something_added(known: BaselineRobot) -> None:
    report = search_payload(known, remembered(load_robot(ARM), 4, payload_plan(known, Plan())))
    assert report.found
    assert report.taken_off
    assert report.carrier == known.chain.serials[-1]
    assert report.mass_kg == pytest.approx(0.2, abs=0.006)
    assert "removed from" in report.summary[0]


def test_the_command_writes_what_it_says(
    known: BaselineRobot, later: BaselineRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coordinator.commands.measured_again.load_baseline", loaded_once)
    done = CliRunner().invoke(app, ["payload", str(known.folder), "--measured", str(later.folder)])
    assert done.exit_code == 0, done.output
    assert "kg were added" in done.output
    written = json.loads((later.folder / PAYLOAD).read_text())
    assert written["found"] is True
    assert not list(later.folder.glob("*.part"))


def test_a_run_without_inertia_is_no_robot_to_compare_with(
    known: BaselineRobot, later: BaselineRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coordinator.commands.measured_again.load_baseline", loaded_once)
    with pytest.raises(PayloadError, match="no motions for inertia"):
        search_payload(later, known)
    done = CliRunner().invoke(app, ["payload", str(later.folder), "--measured", str(known.folder)])
    assert done.exit_code == EXIT_USAGE
    assert CliRunner().invoke(app, ["payload", str(known.folder)]).exit_code == EXIT_USAGE


def test_the_load_is_where_the_file_says() -> None:
    robot = load_robot(ARM)
    bare, full = true_inertia(robot), true_inertia(loaded(robot, robot.serials[-1], HELD))
    assert full[-1, 0] - bare[-1, 0] == pytest.approx(0.2)
    np.testing.assert_allclose(full[:-1], bare[:-1], atol=1e-15)
    with pytest.raises(ValueError, match="has no module nobody"):
        loaded(robot, "nobody", HELD)
    assert true_chain(robot).serials == robot.serials

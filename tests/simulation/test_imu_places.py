"""An IMU off its catalogued place: found by several assemblies of its module, and no change of a link."""

import json
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from typer.testing import CliRunner

from coordinator.baseline.baseline_robot import BaselineRobot
from coordinator.baseline.check import check
from coordinator.excitation.plan import Plan
from coordinator.identification.identified import Kinematics, calibrations
from coordinator.identification.identify import identify_kinematics
from coordinator.main import app
from coordinator.merge.calibration_file import read_calibration
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import CALIBRATION, RESULT, SESSION
from module_agent.model.imu_prior import PLACE_SIGMA_M
from module_agent.network_emulation.profile import PROFILES
from sim.benchmark.cases.link_change import LinkChange, with_link_change
from sim.benchmark.cases.reassembly import reordered
from sim.imperfections.noise_profile import noise_profile, switched
from sim.robot.robot_file import Build, Robot, load_robot
from sim.robot.robot_tree import true_chain
from sim.robot.variants import as_built
from sim.scoring.chain_score import link_length_m
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.run import VirtualConfig, run_virtual
from sim.virtual_time.session import record_session

# Tests of this group share recorded sessions: they stay in one process.
pytestmark = pytest.mark.xdist_group("imu_places")

ELBOW, SEED = "elbow", 5
NOISE = switched(noise_profile("x5"), on=("imu-place", "imu-mounting"))
# Two millimetres across the joint's axis, twice what the catalogue allows for.
OFF_M = (1.6e-3, -1.2e-3, 0.0)


class Session(NamedTuple):
    robot: Robot
    recording: Recording
    alone: Kinematics


def _robot() -> Robot:
    """The kit arm with modules unlike their catalogue, the elbow's IMU 2 mm off its place."""
    robot = load_robot("a2085_03")
    *others, elbow = robot.modules
    displaced = elbow.model_copy(update={"build": Build(imu_xyz_m=OFF_M)})
    return as_built(robot.model_copy(update={"modules": (*others, displaced)}), SEED, NOISE)


@pytest.fixture(scope="module")
def plan(quick_plan: Plan) -> Plan:
    return quick_plan.model_copy(update={"imu": "calibrated"})


def _recorded(robot: Robot, day: int, plan: Plan) -> Recording:
    return record_session(VirtualSettings(robot, PROFILES["lan"], SEED, NOISE, noise_seed=day), plan)


@pytest.fixture(scope="module")
def assemblies(plan: Plan) -> dict[str, Session]:
    """The elbow as the last module, mounted the other way round, and in the middle."""
    robot = _robot()
    *others, elbow = robot.modules
    backwards = (*others, elbow.model_copy(update={"mounted": "reversed"}))
    robots = {
        "reversed": robot.model_copy(update={"modules": backwards}),
        "middle": reordered(robot, np.array([0, 2, 1])),
        "distal": robot,
    }
    sessions = {}
    for day, (name, one) in enumerate(robots.items()):
        recording = _recorded(one, day, plan)
        sessions[name] = Session(one, recording, identify_kinematics(recording))
    return sessions


def _place(kinematics: Kinematics) -> tuple[np.ndarray, np.ndarray]:
    """The displacement of the elbow's IMU and its standard deviations, (3,) each."""
    k = kinematics.topology.serials.index(ELBOW)
    return kinematics.refinement.placement[k, 3:], kinematics.refinement.placement_sigma[k, 3:]


def _link(session: Session, kinematics: Kinematics) -> tuple[float, float]:
    """The error of the elbow's link and its standard deviation [m]."""
    fit, truth = kinematics.fit, true_chain(session.robot)
    k = fit.chain.serials.index(ELBOW)
    error_m = fit.link_length_m[k] - link_length_m(truth, truth.serials.index(ELBOW))
    return float(error_m), float(fit.link_length_sigma_m[k])


def test_a_displaced_imu_is_found_by_several_assemblies_and_links_get_surer(
    assemblies: dict[str, Session],
) -> None:
    distal = assemblies["distal"]
    earlier = [calibrations(assemblies[name].alone, assemblies[name].recording)[0] for name in assemblies]
    together = identify_kinematics(distal.recording, earlier[:2])
    # By itself the last module of an arm tells nothing of its own IMU's place.
    np.testing.assert_allclose(_place(distal.alone)[1], PLACE_SIGMA_M, rtol=0.05)
    place, sigma = _place(together)
    # Across the axis it is known to a third of what was known, along it nothing tells.
    assert sigma[:2].max() < PLACE_SIGMA_M / 3.0
    assert (np.abs(place - OFF_M) < 3.0 * sigma).all()
    # Neither the catalogue's place nor chance explains it.
    assert np.abs(place / sigma).max() > 5.0
    error_m, sigma_m = _link(distal, together)
    assert sigma_m < 0.5 * _link(distal, distal.alone)[1]
    assert abs(error_m) < 3.0 * sigma_m
    for session in assemblies.values():
        error_m, sigma_m = _link(session, session.alone)
        assert abs(error_m) < 3.0 * sigma_m


@pytest.mark.parametrize(("former", "later"), [("reversed", "middle"), ("middle", "reversed")])
def test_in_either_order_the_truth_is_covered_and_a_session_adds_what_it_does_alone(
    assemblies: dict[str, Session], former: str, later: str
) -> None:
    before, after = assemblies[former], assemblies[later]
    both = identify_kinematics(after.recording, calibrations(before.alone, before.recording))
    place, sigma = _place(both)
    assert (np.abs(place - OFF_M) < 3.0 * sigma).all()
    assert (sigma < 1.01 * np.minimum(_place(before.alone)[1], _place(after.alone)[1])).all()
    # What a session tells does not contain its prior, here 5 and more times as much. Noise and bending links
    # are estimated anew.
    own, chained = (calibrations(each, after.recording)[0] for each in (after.alone, both))
    across = 40 * own.serials.index(ELBOW) + np.array([37, 38])
    alone, within = (one.matrix[across, across] for one in (own, chained))
    np.testing.assert_allclose(within, alone, rtol=0.3, atol=0.1 * PLACE_SIGMA_M**-2)


def test_what_begins_with_a_suspect_run_is_suspect_and_says_which(assemblies: dict[str, Session]) -> None:
    before, after = assemblies["middle"], assemblies["distal"]
    assert identify_kinematics(after.recording, calibrations(before.alone, before.recording)).suspicions == []
    sick = before.alone._replace(missing=("wrist took no part: it was silent",))
    kinematics = identify_kinematics(after.recording, calibrations(sick, before.recording))
    assert kinematics.own_suspicions == []
    which = f"it began with recording {before.recording.trace_hash[:16]}"
    assert kinematics.suspicions == [f"{which}, and there wrist took no part: it was silent"]
    # Torques of this recording tell of all bodies all the same, and the next run hears of the sick one once.
    assert kinematics.dynamic
    passed_on = calibrations(kinematics, after.recording)
    assert [one.suspicions for one in passed_on] == [(), tuple(sick.missing)]


def test_a_run_that_began_with_earlier_ones_is_complete_and_a_replay_the_same(
    plan: Plan, tmp_path: Path
) -> None:
    robot = load_robot("thesis_171_vertical")
    for day, (name, measured) in enumerate({"first": (), "second": (tmp_path / "first",)}.items()):
        config = VirtualConfig(robot, tmp_path / name, SEED, noise=NOISE, plan=plan, noise_seed=day)
        run_virtual(config._replace(measured=measured))
    first, second = (
        json.loads((tmp_path / name / RESULT).read_text())["imu_places"] for name in ("first", "second")
    )
    (base, tip), (base_again, tip_again) = (
        [np.trace(one["covariance"]) for one in places] for places in (first, second)
    )
    # Two runs tell more of the base's IMU than one. Nothing tells of the last module's.
    assert base_again < 0.999 * base
    assert tip_again == pytest.approx(tip, rel=1e-9)
    sessions = [one.session for one in read_calibration(tmp_path / "second" / CALIBRATION)]
    assert len(set(sessions)) == len(sessions) == 2
    # The earlier run is not needed any more.
    shutil.rmtree(tmp_path / "first")
    replay = ["replay", str(tmp_path / "second" / SESSION), "--out", str(tmp_path / "again")]
    assert CliRunner().invoke(app, replay).exit_code == 0
    for name in (RESULT, CALIBRATION):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


def test_displaced_imus_are_no_change_and_a_displaced_link_is_one(
    assemblies: dict[str, Session], plan: Plan
) -> None:
    distal = assemblies["distal"]
    known = BaselineRobot(Path("known"), distal.recording, distal.alone)
    change = LinkChange(ELBOW, np.array([0.0, 2e-3, 0.0]))
    reports = []
    for day, robot in enumerate((distal.robot, with_link_change(distal.robot, change)), start=10):
        recording = _recorded(robot, day, plan)
        later = BaselineRobot(Path(f"day {day}"), recording, identify_kinematics(recording))
        reports.append(check(known, later))
    unchanged, displaced = reports
    assert not unchanged.changed
    (link,) = [link for link in displaced.links if link.changed]
    assert link.child == ELBOW
    size_m = 1e-3 * np.array(link.displacement_mm)
    sigma_m = 1e-3 * np.array(link.displacement_sigma_mm)
    assert (np.abs(size_m - change.displacement_m) < 4.0 * sigma_m).all()

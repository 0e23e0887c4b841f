"""What the search judges a session by: the whole robot, but for what nothing could have shown."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coordinator.identification.result import Result
from coordinator.recording.run_folder import RESULT, SESSION
from module_agent.control.safety import Safety
from sim.faults import run, schedule
from sim.faults.fault import Fault
from sim.faults.invariants import _wrong_torque, check_folder
from sim.faults.run import Ending, run_schedule, witness_of
from sim.faults.schedule import SMALL_ROBOTS, PlanName, Schedule, draw, first_modules
from sim.robot.robot_file import load_robot
from sim.scoring.score import Score

ARM = ("a2085_03", 3)


def session(
    robot: tuple[str, int], *faults: Fault, expects: bool = True, planned: PlanName = "short"
) -> Schedule:
    name, modules = robot
    arm = first_modules(load_robot(name), modules)
    return Schedule(3, arm, "lan", faults, expects=expects, planned=planned)


def ran(one: Schedule, out: Path) -> Ending:
    return run_schedule(one, out, witness_of(one))


def result(out: Path) -> Any:
    return json.loads((out / RESULT).read_text())


@pytest.mark.parametrize("robot", SMALL_ROBOTS, ids=lambda robot: robot[0])
def test_without_faults_every_module_is_measured_and_judged(robot: tuple[str, int], tmp_path: Path) -> None:
    one = session(robot)
    ending = ran(one, tmp_path / "run")
    assert (ending.name, check_folder(tmp_path / "run", ending).violations) == ("result", {})
    written = result(tmp_path / "run")
    assert set(written["serials"]) == set(one.robot.serials)
    # Of a joint that does not move the search would compare little.
    assert all(module["joint_moved"] for module in written["topology"])


def test_a_joint_that_moves_slowly_and_is_held_in_its_sine_makes_the_result_suspect(tmp_path: Path) -> None:
    """Of the link that it turns the sine tells nothing, though the topology is known."""
    held = session(("thesis_171_vertical", 2), Fault("motor stall", 6.2, math.inf, 0))
    ending = ran(held, tmp_path / "run")
    assert ending.name == "suspect"
    assert f"joint {held.robot.serials[0]} turned by" in ending.text
    assert "in its windowed_sine motion" in ending.text


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("motor stall", "the range of its position within 0.5 s is"),
        ("torque stuck", "its effort reads exactly the same"),
    ],
)
def test_what_is_sick_only_in_the_held_out_motion_makes_the_result_suspect(
    kind: str, words: str, tmp_path: Path
) -> None:
    """Inertia is identified by then, and is not compared with a joint that stands, or torques of nothing."""
    late = session(("thesis_171_vertical", 2), Fault(kind, 32.5, math.inf, 0), planned="inertia")
    ending = ran(late, tmp_path / "run")
    assert (ending.name, check_folder(tmp_path / "run", ending).violations) == ("suspect", {})
    assert words in ending.text
    assert "in its held_out motion" in ending.text
    dynamics = result(tmp_path / "run")["dynamics"]
    assert dynamics["held_out"] is None
    assert dynamics["identifiability"]


def test_of_a_joint_that_halts_in_a_motion_for_inertia_none_is_identified(tmp_path: Path) -> None:
    """What holds it is in the torques of all joints up to it."""
    one = session(("thesis_171_vertical", 2), Fault("motor stall", 17.0, 1.5, 0), planned="inertia")
    ending = ran(one, tmp_path / "run")
    assert (ending.name, check_folder(tmp_path / "run", ending).violations) == ("suspect", {})
    assert "in its dynamic motion" in ending.text
    assert result(tmp_path / "run")["dynamics"] is None


def test_predicted_torques_are_compared_with_the_true_ones(tmp_path: Path) -> None:
    one = session(ARM, planned="inertia")
    ending = ran(one, tmp_path / "run")
    assert (ending.name, check_folder(tmp_path / "run", ending).violations) == ("result", {})
    path = tmp_path / "run" / "held_out.npz"
    with np.load(path) as file:
        columns = dict(file)
    serial = one.robot.serials[1]
    column = result(tmp_path / "run")["serials"].index(serial)
    (claimed,) = (
        term["sigma"]
        for term in result(tmp_path / "run")["dynamics"]["torque_terms"]
        if (term["serial"], term["term"]) == (serial, "scale")
    )
    assert 0.01 < claimed < 0.05

    def violation(predicted_nm: NDArray[np.float64], **sick: frozenset[str]) -> str:
        changed = columns["tau_predicted_nm"].copy()
        changed[:, column] = predicted_nm
        np.savez(path, **(columns | {"tau_predicted_nm": changed}))
        return check_folder(tmp_path / "run", ending, **sick).violations.get("wrong robot", "")

    right_nm = columns["tau_predicted_nm"][:, column]
    to_and_fro_nm = right_nm + 0.2 * np.sign(np.sin(np.arange(right_nm.size)))
    assert violation(to_and_fro_nm).startswith(f"torques of {serial} are predicted 0.20 Nm off")
    # A common factor is within five sigmas of what is claimed of the sensor's scale, or beyond.
    assert violation((1.0 + 3.0 * claimed) * right_nm) == ""
    for off in (7.0, -7.0):
        found = violation((1.0 + off * claimed) * right_nm)
        assert found.startswith(f"torques of {serial} are predicted too large by {'-' if off < 0.0 else ''}")
    # By a sick clock it is not known which torques were the true ones.
    assert violation(to_and_fro_nm, clock_sick=frozenset({serial})) == ""


def test_of_a_link_that_no_motion_showed_no_sigma_is_claimed(tmp_path: Path) -> None:
    """Its joint was held in every motion; what stands for its length is the initial guess."""
    ending = ran(draw(110184, planned="short"), tmp_path / "run")
    assert ending.name == "suspect"
    assert [link["link_length_sigma_mm"] for link in result(tmp_path / "run")["links"]] == [None]


def test_a_module_that_was_not_announced_is_forgiven_only_where_modules_are_not_counted(
    tmp_path: Path,
) -> None:
    gone = session(ARM, Fault("agent crash", 0.0, math.inf, 2), expects=False)
    ending = ran(gone, tmp_path / "run")
    missing = gone.robot.serials[2]
    assert (ending.name, ending.unheard) == ("result", {missing})
    assert check_folder(tmp_path / "run", ending).violations == {}
    found = check_folder(tmp_path / "run", ending._replace(unheard=frozenset())).violations
    assert f"module {missing} was not found" in found["wrong robot"]


def test_the_result_of_a_single_module_can_be_read_again(tmp_path: Path) -> None:
    """It has nothing to fit, and no condition therefore; the other module is plugged in too late."""
    one = session(("thesis_171_horizontal", 2), Fault("hot plug", 10.6, math.inf, 0), expects=False)
    ending = ran(one, tmp_path / "run")
    assert (ending.name, check_folder(tmp_path / "run", ending).violations) == ("result", {})
    read = Result.model_validate_json((tmp_path / "run" / RESULT).read_bytes())
    assert (read.serials, read.condition, read.reduced_chi2) == ([one.robot.serials[1]], None, None)


def test_of_a_joint_that_its_limits_keep_still_only_what_it_carries_is_forgiven(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, narrow = session(ARM), Safety(position_rad=(-0.1, 0.1))
    first, still, last = one.robot.serials
    monkeypatch.setattr(run, "safety", lambda each: schedule.safety(each) | {still: narrow})
    ending = ran(one, tmp_path / "run")
    assert (ending.name, check_folder(tmp_path / "run", ending).violations) == ("result", {})
    assert {m["serial"]: m["parent"] for m in result(tmp_path / "run")["topology"]}[last] == first
    path = tmp_path / "run" / "truth.json"
    truth = path.read_text()
    # The link before it is measured by the first joint.
    _displace(path, still)
    assert f"link {first} - {still}" in check_folder(tmp_path / "run", ending).violations["wrong robot"]
    path.write_text(truth)
    _displace(path, last)
    assert check_folder(tmp_path / "run", ending).violations == {}


@pytest.mark.parametrize("name", ["result", "suspect", "lost"])
def test_a_session_that_leaves_no_recording_is_a_violation(name: str, tmp_path: Path) -> None:
    assert "no recording" in check_folder(tmp_path, Ending(name)).violations


def test_a_recording_may_lack_its_end_where_its_writer_was_killed_and_nothing_else(tmp_path: Path) -> None:
    ending = ran(session(("thesis_171_horizontal", 2)), tmp_path / "run")
    path = tmp_path / "run" / SESSION
    whole, lost = path.read_bytes(), ending._replace(name="lost")
    path.write_bytes(whole[: len(whole) // 2])
    assert check_folder(tmp_path / "run", lost).violations == {}
    assert (
        check_folder(tmp_path / "run", ending).violations["unreadable recording"] == f"{SESSION} is cut off"
    )
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes(64) + whole[middle + 64 :])
    for each in (lost, ending):
        assert "is damaged" in check_folder(tmp_path / "run", each).violations["unreadable recording"]


def test_a_right_robot_whose_claims_are_wide_is_vague(tmp_path: Path) -> None:
    one = session(("thesis_171_horizontal", 2))
    ending = ran(one, tmp_path / "run")
    claim = check_folder(tmp_path / "run", ending).claim
    assert claim is not None
    assert not claim.is_vague
    document = result(tmp_path / "run")
    document["links"][0]["link_length_sigma_mm"] = 6.0
    (tmp_path / "run" / RESULT).write_text(json.dumps(document))
    wide = check_folder(tmp_path / "run", ending)
    assert wide.violations == {}
    assert wide.claim == claim._replace(mm=6.0)
    assert wide.claim.is_vague
    assert claim._replace(deg=1.1).is_vague
    # Of one module alone no link is compared.
    alone = check_folder(tmp_path / "run", ending._replace(unheard=frozenset(one.robot.serials[:1])))
    assert alone.claim is not None
    assert (alone.claim.link, alone.claim.is_vague) == ("no link", True)


def test_a_suspect_result_is_compared_with_the_truth_and_its_suspicions_with_what_is_wrong(
    tmp_path: Path,
) -> None:
    sick = session(ARM, Fault("IMU NaN", 9.0, 0.5, 2))
    ending, (first, _, last) = ran(sick, tmp_path / "run"), sick.robot.serials
    # It is the robot without its last module, as it says.
    assert ending.name == "suspect"
    assert last in ending.text
    right = check_folder(tmp_path / "run", ending)
    assert (right.violations, right.wrong) == ({}, "")
    document = result(tmp_path / "run")
    _displace(tmp_path / "run" / "truth.json", document["links"][0]["child"])
    for text, is_explained in ((f"{first}: its encoder", True), ("the network is slow", False)):
        found = check_folder(tmp_path / "run", ending._replace(text=f"{last}: its IMU; {text}"))
        assert found.violations == {}
        assert found.wrong.startswith(f"link {first} - ")
        assert found.is_explained is is_explained
    # Nothing is wrong with a link of which nothing is claimed.
    document["links"][0]["link_length_sigma_mm"] = None
    (tmp_path / "run" / RESULT).write_text(json.dumps(document))
    assert not check_folder(tmp_path / "run", ending).wrong.startswith(f"link {first} - ")


def test_a_suspect_result_that_cannot_be_read_is_a_violation(tmp_path: Path) -> None:
    ending = ran(
        session(("thesis_171_vertical", 2), Fault("motor stall", 6.2, math.inf, 0)), tmp_path / "run"
    )
    assert check_folder(tmp_path / "run", ending).violations == {}
    (tmp_path / "run" / RESULT).write_text("{}")
    assert "unreadable result" in check_folder(tmp_path / "run", ending).violations


def test_a_wrong_axis_is_a_wrong_robot_though_every_length_is_right(tmp_path: Path) -> None:
    one = session(ARM)
    ending = ran(one, tmp_path / "run")
    path = tmp_path / "run" / "truth.json"
    first, second = one.robot.serials[:2]
    truth = json.loads(path.read_text())
    chain = {name: np.array(truth["chain"][name]) for name in ("axis", "point", "imu_home")}
    k, child = (truth["chain"]["serials"].index(serial) for serial in (first, second))
    axis = chain["axis"][k]
    arm = chain["imu_home"][child, :3, 3] - chain["point"][k]
    along = axis * (axis @ arm)
    # About the perpendicular to the IMU, at its foot: the way across the axis stays what it is.
    across = (arm - along) / np.linalg.norm(arm - along)
    truth["chain"]["point"][k] = (chain["point"][k] + along).tolist()
    truth["chain"]["axis"][k] = Rotation.from_rotvec(np.radians(4.0) * across).apply(axis).tolist()
    path.write_text(json.dumps(truth))
    found = check_folder(tmp_path / "run", ending).violations["wrong robot"]
    assert f"link {first} - {second} the axis is" in found


@pytest.mark.parametrize("robot", [ARM, ("thesis_171_vertical", 2), ("tree_y", 3)], ids=lambda one: one[0])
def test_a_wrong_zero_of_an_encoder_is_a_wrong_robot_though_every_link_is_right(
    robot: tuple[str, int], tmp_path: Path
) -> None:
    """By ten degrees: a short session knows the vertical arm's zero to one and a half."""
    one = session(robot)
    ending = ran(one, tmp_path / "run")
    path = tmp_path / "run" / "truth.json"
    truth = json.loads(path.read_text())
    chain, (second, last) = truth["chain"], one.robot.serials[-2:]
    k, leaf = (chain["serials"].index(serial) for serial in (second, last))
    axis, point = np.array(chain["axis"][k]), np.array(chain["point"][k])
    turn = Rotation.from_rotvec(np.radians(10.0) * axis)
    home = np.array(chain["imu_home"][leaf])
    home[:3, 3] = point + turn.apply(home[:3, 3] - point)
    home[:3, :3] = turn.as_matrix() @ home[:3, :3]
    chain["imu_home"][leaf] = home.tolist()
    chain["axis"][leaf] = turn.apply(chain["axis"][leaf]).tolist()
    chain["point"][leaf] = (point + turn.apply(np.array(chain["point"][leaf]) - point)).tolist()
    path.write_text(json.dumps(truth))
    assert "the tips are" in check_folder(tmp_path / "run", ending).violations["wrong robot"]


@pytest.mark.parametrize(
    ("part", "value", "kind", "words"),
    [
        ("links", "unknown", "wrong robot", "has a length of which nothing is claimed, with exit code 0"),
        ("chain", "turned", "wrong robot", "degrees off, expected at most 3.00"),
        ("rank", "many", "unreadable result", "rank"),
        ("chain", "missing", "unreadable result", "chain"),
    ],
)
def test_a_result_that_claims_nothing_or_cannot_be_read_is_a_violation(
    part: str, value: str, kind: str, words: str, tmp_path: Path
) -> None:
    one = session(("thesis_171_horizontal", 2))
    ending = ran(one, tmp_path / "run")
    document = result(tmp_path / "run")
    if value == "unknown":
        document["links"][0]["link_length_sigma_mm"] = None
    elif value == "turned":
        x, y, z = document["chain"]["gravity"]
        document["chain"]["gravity"] = np.cross([x, y, z], [y, z, x]).tolist()
    elif value == "missing":
        del document[part]
    else:
        document[part] = value
    (tmp_path / "run" / RESULT).write_text(json.dumps(document))
    assert words in check_folder(tmp_path / "run", ending).violations[kind]


def _displace(path: Path, serial: str) -> None:
    """Let the true robot have an IMU elsewhere, by 50 mm along each axis."""
    truth = json.loads(path.read_text())
    place = truth["chain"]["serials"].index(serial)
    for row in range(3):
        truth["chain"]["imu_home"][place][row][3] += 0.05
    path.write_text(json.dumps(truth))


@pytest.mark.parametrize(("sigma", "is_wrong"), [(0.0, True), (0.001, False)])
def test_where_nothing_is_claimed_of_a_scale_an_error_counts_as_a_whole(sigma: float, is_wrong: bool) -> None:
    """0.04 Nm of scale and as much of shape are within the bound of 0.05 Nm each, and beyond it together."""
    scored = Score(
        topology_correct=True,
        topology_differences=[],
        links=[],
        unidentifiable=[],
        tip_position_rms_mm=None,
        tip_orientation_rms_deg=None,
        robot_time_s=1.0,
        wall_time_s=None,
        torque_rms_nm_per_joint={"A": 0.5},
        torque_rms_error_nm_per_joint={"A": math.hypot(0.04, 0.04)},
        torque_scale_error_per_joint={"A": 0.08},
        torque_scale_sigma_per_joint={"A": sigma},
        torque_shape_error_nm_per_joint={"A": 0.04},
    )
    assert bool(_wrong_torque(scored, frozenset()).text) is is_wrong

"""`x5-coordinator excite` as it is called: within all limits, clear by another library, and worth it."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner, Result

from coordinator.arm_fit.data_file import read_log
from coordinator.description.urdf_reader import read_urdf
from coordinator.main import app
from tests.coordinator.excitation.six_joint_arm import HOME, six_joint_urdf

RATE_HZ = 250.0


def called(folder: Path, *options: str) -> Result:
    (folder / "six.urdf").write_text(six_joint_urdf())
    files = ("--urdf", str(folder / "six.urdf"), "--out", str(folder / "motion.csv"))
    return CliRunner().invoke(app, ["excite", *files, "--home", HOME, *options])


def clearances_m(urdf: Path, q_rad: np.ndarray) -> tuple[np.ndarray, float]:
    """Distances of links that are not neighbours, by coal, and the least height of a shape's centre."""
    model = pin.buildModelFromUrdf(str(urdf))
    shapes = pin.buildGeomFromUrdf(model, str(urdf), pin.GeometryType.COLLISION)
    shapes.addAllCollisionPairs()
    for pair in list(shapes.collisionPairs):
        one, other = (shapes.geometryObjects[k].parentJoint for k in (pair.first, pair.second))
        if model.parents[one] == other or model.parents[other] == one:
            shapes.removeCollisionPair(pair)
    data, placed = model.createData(), shapes.createData()
    distances, heights = [], []
    for q in q_rad:
        pin.computeDistances(model, data, shapes, placed, q)
        distances.append([result.min_distance for result in placed.distanceResults])
        heights += [place.translation[2] for place in placed.oMg]
    return np.array(distances), min(heights)


def test_the_motion_keeps_all_limits_and_is_worth_three_random_ones(tmp_path: Path) -> None:
    done = called(tmp_path, "--tries", "1000", "--periods", "1")
    assert done.exit_code == 0, done.output
    robot = read_urdf(tmp_path / "six.urdf")
    log = read_log(tmp_path / "motion.csv", robot.chain.serials)
    assert log.rate_hz == pytest.approx(RATE_HZ)
    assert log.duration_s == pytest.approx(10.0)
    assert log.qd_rad_s is not None
    low, high, speed = robot.limits.T
    assert ((log.q_rad > low) & (log.q_rad < high)).all()
    assert (np.abs(np.diff(log.q_rad, axis=0)) * RATE_HZ < speed).all()
    assert (np.abs(np.diff(log.qd_rad_s, axis=0)) * RATE_HZ < 2.0 * speed).all()
    assert (np.abs(log.tau_nm) < robot.effort_nm).all()
    # At rest at home, at both ends.
    np.testing.assert_allclose(log.q_rad[[0, -1]], [[float(q) for q in HOME.split(",")]] * 2, atol=1e-6)
    np.testing.assert_allclose(log.qd_rad_s[[0, -1]], 0.0, atol=1e-6)
    apart, _ = clearances_m(tmp_path / "six.urdf", log.q_rad[::5])
    assert apart.shape[1] == 15
    # What the tool promises, and touching shapes at home would have been named.
    assert apart.min() > 0.02
    assert "not checked" not in done.output
    line = " ".join(done.stdout.split())
    condition, of_random = (float(line.partition(text)[2].split()[0]) for text in ("number ", "parameters, "))
    assert "for 58 parameters" in line
    assert of_random > 3.0 * condition


def test_the_arm_stays_above_a_floor_that_is_given(tmp_path: Path) -> None:
    heights = []
    for options in ((), ("--floor", "0")):
        done = called(tmp_path, "--tries", "30", "--periods", "1", *options)
        assert done.exit_code == 0, done.output
        log = read_log(tmp_path / "motion.csv", read_urdf(tmp_path / "six.urdf").chain.serials)
        heights.append(clearances_m(tmp_path / "six.urdf", log.q_rad[::10])[1])
    # The base's own centre is at 0.03 m.
    assert heights[0] < 0.0
    assert heights[1] > 0.02


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (("--home", "1,2"), 2, "home '1,2': it must be 6 numbers, of j1, j2, j3, j4, j5, j6"),
        (("--home", "0,0,0,0,-2,0"), 2, "home of 'j5': -2 rad is not within its range, -2 to 2 rad"),
        (("--speed", "0"), 2, "speed 0.0: it must be a number above 0"),
        (("--acceleration", "nan"), 2, "acceleration nan: it must be a number above 0"),
        (("--harmonics", "1"), 2, "harmonics 1: at least 2 are needed"),
        (("--rate", "10", "--harmonics", "30"), 2, "rate 10 Hz: sines of 3 Hz need at least 4 times theirs"),
        (("--out", "/nowhere/motion.csv"), 2, "/nowhere/motion.csv: there is no folder /nowhere"),
        (("--urdf", "nowhere.urdf"), 2, "nowhere.urdf: No such file"),
    ],
)
def test_wrong_options_are_answered_with_what_is_right(
    tmp_path: Path, options: tuple[str, ...], code: int, words: str
) -> None:
    done = called(tmp_path, *options)
    assert done.exit_code == code, done.output
    assert words in " ".join(done.output.split())
    assert not (tmp_path / "motion.csv").exists()


def test_an_arm_that_cannot_hold_itself_is_refused(tmp_path: Path) -> None:
    urdf = tmp_path / "weak.urdf"
    urdf.write_text(six_joint_urdf().replace('effort="150"', 'effort="5"'))
    done = called(tmp_path, "--tries", "20", "--urdf", str(urdf))
    assert done.exit_code == 1
    assert "hold more than their torque" in " ".join(done.output.split())

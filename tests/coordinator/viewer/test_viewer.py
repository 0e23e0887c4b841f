"""The file that a viewer writes, read back with Rerun's own reader."""

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from coordinator.viewer.recorder import FILE, LIVE, Pace, Recorder
from coordinator.viewer.scene.entity_paths import ESTIMATED_WORLD
from coordinator.viewer.scene.parameter_plot import Estimate
from coordinator.viewer.scene.robot_geometry import ball_around, modules
from coordinator.viewer.scene.time_series import INTERVAL_NS
from coordinator.viewer.targets import ViewerTargets
from coordinator.viewer.viewer import Viewer
from module_agent.model.chain import Chain
from module_agent.model.forward_kinematics import imu_poses
from module_agent.wire.feedback_rows import Rows
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain

Read = Callable[[Path, str], pd.DataFrame]
MakeRows = Callable[[int, int], Rows]
PERIOD_NS = 4_000_001  # not a round number, so that times stored as float seconds would differ


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "run.rrd"


@pytest.fixture
def viewer(file: Path) -> Viewer:
    return Viewer("arm", "run-1", ViewerTargets(rrd=file))


def entities(file: Path) -> list[str]:
    return sorted({chunk.entity_path for chunk in RrdReader(str(file)).stream()})


def times_ns(table: pd.DataFrame) -> list[int]:
    return table["session_time"].to_numpy().astype("timedelta64[ns]").astype(np.int64).tolist()


def column(table: pd.DataFrame, name: str) -> np.ndarray:
    return np.array([np.asarray(value.tolist()) for value in table[name].dropna()], dtype=float)


def done(viewer: Viewer) -> None:
    viewer.close()
    assert (viewer.dropped, viewer.failed) == (0, 0)


def test_rows_are_in_the_file_at_their_own_nanoseconds_two_per_interval(
    viewer: Viewer, file: Path, read: Read, make_rows: MakeRows
) -> None:
    t_ns = 10**15 + PERIOD_NS * np.arange(103)
    for i in range(0, 103, 5):
        count = min(5, 103 - i)
        viewer.rows("a", t_ns[i : i + count], make_rows(i, count))
    done(viewer)
    gyro = read(file, "/modules/a/gyro")
    retained = np.flatnonzero(np.isin(t_ns, times_ns(gyro)))
    assert times_ns(gyro) == t_ns[retained].tolist()
    # Rising values are logged as they are: the first and the last of every interval.
    intervals = t_ns // INTERVAL_NS
    assert retained.tolist() == [
        k
        for k in range(103)
        if k in (0, 102) or intervals[k - 1] != intervals[k] or intervals[k + 1] != intervals[k]
    ]
    expected = retained[:, None] + np.array([0.0, 0.25, 0.5])
    np.testing.assert_array_equal(column(gyro, "/modules/a/gyro:Scalars:scalars"), expected)
    position = column(read(file, "/modules/a/position"), "/modules/a/position:Scalars:scalars")
    np.testing.assert_array_equal(position[:, 0], 0.001 * retained)


def test_a_minute_of_feedback_needs_few_chunks(viewer: Viewer, file: Path, make_rows: MakeRows) -> None:
    for i in range(0, 15_000, 25):
        viewer.rows("a", 4_000_000 * np.arange(i, i + 25), make_rows(i, 25))
        viewer.estimate("link_length", "a", 4_000_000 * i, 0.25, 0.01, "m")
    done(viewer)
    chunks = [chunk.entity_path for chunk in RrdReader(str(file)).stream()]
    # Its styles, and a chunk for every ten seconds.
    assert 6 <= chunks.count("/modules/a/gyro") <= 8
    assert chunks.count("/estimates/link_length/a") <= 4


def test_a_command_that_is_not_set_is_not_drawn_at_zero(
    viewer: Viewer, file: Path, make_rows: MakeRows, read: Read
) -> None:
    viewer.rows("a", INTERVAL_NS * np.arange(5), make_rows(0, 5))
    done(viewer)
    velocity = read(file, "/modules/a/velocity_command")
    assert column(velocity, "/modules/a/velocity_command:Scalars:scalars")[:, 0].tolist() == [0, 2, 4, 6, 8]
    position = read(file, "/modules/a/position_command")
    assert "/modules/a/position_command:Scalars:scalars" not in position.columns


def test_the_state_is_logged_when_it_changes_and_not_in_between(
    viewer: Viewer, file: Path, make_rows: MakeRows, read: Read
) -> None:
    for i in range(0, 100, 5):
        rows = make_rows(i, 5)
        rows["state"] = [1 if n < 50 else 2 for n in range(i, i + 5)]
        viewer.rows("a", PERIOD_NS * np.arange(i, i + 5), rows)
    done(viewer)
    states = read(file, "/modules/a/state")
    named = [value[0] for value in states["/modules/a/state:StateChange:state"].dropna()]
    assert named == ["armed", "moving"]
    assert times_ns(states) == [0, 50 * PERIOD_NS]


def test_an_estimate_keeps_its_value_variance_and_unit(viewer: Viewer, file: Path, read: Read) -> None:
    viewer.estimate("link_length", "a", 5, 0.25, 0.01, "m")
    viewer.estimate("link_length", "a", 7, 0.26, float("inf"), "m")
    done(viewer)
    path = "/estimates/link_length/a"
    table = read(file, path)
    assert times_ns(table) == [5, 7]
    assert column(table, f"{path}:Measurements:values")[:, 0].tolist() == [0.25, 0.26]
    variances = table[f"{path}:Measurements:variances"]
    assert variances[0][0] == pytest.approx(1e-4)
    assert len(variances[1]) == 0  # not the one before
    assert table[f"{path}:Measurements:units"][0][0] == "m"


def test_an_estimate_has_the_ends_of_its_interval_and_its_true_value(
    viewer: Viewer, file: Path, read: Read
) -> None:
    viewer.true_value("link_length", "a", 0.3)
    viewer.estimate("link_length", "a", 5, 0.25, 0.01, "m")
    viewer.estimate("link_length", "a", 9, 0.26, float("inf"), "m")
    done(viewer)
    ends = read(file, "/estimates/link_length/a/interval")
    first, last = column(ends, "/estimates/link_length/a/interval:Scalars:scalars")
    # 1.96 sigma to either side hold 95 % of a normal distribution.
    assert first.tolist() == pytest.approx([0.2304, 0.2696])
    assert np.isnan(last).all()
    truth = read(file, "/estimates/link_length/a/true")
    assert times_ns(truth) == [5, 9]
    assert column(truth, "/estimates/link_length/a/true:Scalars:scalars")[:, 0].tolist() == [0.3, 0.3]


def test_the_truth_and_the_estimate_turn_together_even_where_only_some_joints_are_identified(
    viewer: Viewer, file: Path, read: Read, arm: Chain, types: dict[str, str]
) -> None:
    part = Chain(*(value[:1] for value in arm[:6]), arm.gravity)  # type: ignore[arg-type, call-arg]
    viewer.modules(["a"], {"a": types["a"]})
    viewer.true_chain(5, arm, types)
    viewer.chain(10, part)
    viewer.poses([20], [[-1.1, 0.7]], ["b/1", "a"])
    done(viewer)
    body = "/world/true/body/b\\/1"
    moved = _transform(read(file, "/world/true/**").iloc[-1], body)
    expected = imu_poses(arm, np.array([[0.7, -1.1]]))[0, 1] @ np.linalg.inv(arm.imu_home[1])
    np.testing.assert_allclose(moved, expected, atol=1e-6)
    turned = _transform(read(file, "/world/est/**").iloc[-1], "/world/est/body/a")
    assert turned[0, 0] == pytest.approx(np.cos(0.7))


def test_held_out_torque_and_its_residual(viewer: Viewer, file: Path, read: Read) -> None:
    viewer.residuals("a", np.array([1, 2]), [1.0, 2.0], [0.5, 2.25])
    done(viewer)
    error = read(file, "/residuals/a/error")
    assert column(error, "/residuals/a/error:Scalars:scalars")[:, 0].tolist() == [0.5, -0.25]
    torque = read(file, "/residuals/a/torque")
    assert column(torque, "/residuals/a/torque:Scalars:scalars").tolist() == [[1.0, 0.5], [2.0, 2.25]]


def test_steps_network_and_topology_are_at_their_times(viewer: Viewer, file: Path, read: Read) -> None:
    viewer.modules(["a", "b"], {"a": "X5-9", "b": "X5-1"})
    viewer.phase(3, "discover")
    viewer.note(4, "found 2: a, b")
    viewer.network("b", 4, 1.5, 6.0, 2)
    viewer.topology(5, ["a", "b"], [-1, 0], [False, True])
    done(viewer)
    log = read(file, "/phase/log")
    lines = [line[0] for line in log["/phase/log:TextLog:text"]]
    assert (times_ns(log), lines) == ([3, 4], ["discover", "  found 2: a, b"])
    assert column(read(file, "/network/b/age"), "/network/b/age:Scalars:scalars").tolist() == [[6.0]]
    assert column(read(file, "/network/b/refusals"), "/network/b/refusals:Scalars:scalars").tolist() == [
        [2.0]
    ]
    topology = read(file, "/topology")
    edges = [tuple(edge.values()) for edge in topology["/topology:GraphEdges:edges"][0]]
    assert (times_ns(topology), edges) == ([5], [("base", "a"), ("a", "b")])
    assert topology["/topology:GraphNodes:labels"][0].tolist() == ["base", "a · X5-9", "b · X5-1 · reversed"]


def test_there_is_no_robot_before_it_is_known(viewer: Viewer, file: Path, make_rows: MakeRows) -> None:
    viewer.modules(["a"], {"a": "X5-9"})
    viewer.rows("a", np.arange(5), make_rows(0, 5))
    viewer.poses([1], [[0.3]], ["a"])
    done(viewer)
    assert not [path for path in entities(file) if path.startswith("/world")]


def test_the_bodies_turn_so_that_the_imus_are_where_the_kinematics_says(
    viewer: Viewer, file: Path, read: Read, arm: Chain, types: dict[str, str]
) -> None:
    q = np.array([0.7, -1.1])
    viewer.modules(arm.serials, types)
    viewer.chain(10, arm, [0.0, 0.001])
    viewer.poses([20], [q], arm.serials)
    done(viewer)
    body = "/world/est/body/b\\/1"
    table = read(file, "/world/est/**")
    moved = _transform(table.iloc[-1], body)
    imu = _transform(table.iloc[0], f"{body}/imu/b\\/1")
    # Single precision in the recording: 1e-6 of lengths of a metre.
    np.testing.assert_allclose(moved @ imu, imu_poses(arm, q[None, :])[0, 1], atol=1e-6)
    assert times_ns(table) == [10, 20]


def test_a_file_opens_on_all_postures_that_the_robot_was_in() -> None:
    robot = load_robot("a2085_04")
    chain, types = true_chain(robot), {module.serial: module.type for module in robot.modules}
    stream = rr.RecordingStream("x5")
    stream.memory_recording()
    recorder = Recorder(stream, "arm", FILE)
    recorder.modules(chain.serials, types)
    # It turns about the vertical by a quarter to either side, and ends where it began.
    turned = np.zeros((3, len(chain.serials)))
    turned[:, 0] = 1.57, -1.57, 0.0
    recorder.chain(0, chain, None, ESTIMATED_WORLD)
    recorder.poses(np.array([1, 2, 3]) * 1_500_000_000, turned, chain.serials)
    recorder.finish()
    ball, placed = recorder._contents.ball, modules(chain, types)
    assert ball is not None
    alone = [ball_around(chain, placed, q[None]) for q in turned]
    assert all(ball.holds(one._replace(radius_m=0.0)) for one in alone)
    # An arm of 0.7 m to both sides.
    assert ball.radius_m > 1.5 * max(one.radius_m for one in alone)


def test_poses_that_come_together_are_logged_each_at_its_time(
    viewer: Viewer, file: Path, read: Read, arm: Chain, types: dict[str, str]
) -> None:
    t_ns, q = [20, 21, 40], np.array([[0.7, -1.1], [0.8, 0.3], [-2.0, 1.4]])
    viewer.modules(arm.serials, types)
    viewer.chain(10, arm)
    viewer.poses(t_ns, q, arm.serials)
    viewer.chain(50, arm)
    done(viewer)
    body = "/world/est/body/b\\/1"
    table = read(file, "/world/est/**")
    assert times_ns(table) == [10, *t_ns, 50]
    imu = _transform(table.iloc[0], f"{body}/imu/b\\/1")
    moved = np.array([_transform(table.iloc[k], body) for k in range(1, 5)])
    # Single precision in the recording; the last posture is that of the robot drawn anew.
    np.testing.assert_allclose(moved @ imu, imu_poses(arm, q[[0, 1, 2, 2]])[:, 1], atol=1e-6)


def _transform(row: pd.Series, path: str) -> np.ndarray:
    pose = np.eye(4)
    # Rerun keeps matrices column by column.
    pose[:3, :3] = np.asarray(row[f"{path}:Transform3D:mat3x3"][0]).reshape(3, 3).T
    pose[:3, 3] = row[f"{path}:Transform3D:translation"][0]
    return pose


def test_a_refined_robot_keeps_its_posture_and_loses_what_is_no_longer_known(
    viewer: Viewer, file: Path, read: Read, arm: Chain, types: dict[str, str]
) -> None:
    q = np.array([0.7, -1.1])
    viewer.modules(arm.serials, types)
    # The second joint may be 20 mm off in z, a tenth of that in y, and is exact in x.
    covariance = np.zeros((12, 12))
    covariance[[10, 11], [10, 11]] = 0.002**2, 0.02**2
    viewer.chain(10, arm, [0.0, 0.02], covariance)
    viewer.poses([20], [q], arm.serials)
    viewer.chain(30, arm, [0.0, float("nan")], covariance)
    done(viewer)
    table = read(file, "/world/est/**")
    body = "/world/est/body/b\\/1"
    np.testing.assert_array_equal(_transform(table.iloc[1], body), _transform(table.iloc[2], body))
    spread = table[f"{body}/spread:Ellipsoids3D:half_sizes"]
    # 95 % of a normal distribution in space.
    assert sorted(spread[0][0].tolist()) == pytest.approx([0.0, 0.0055910, 0.055910], abs=1e-6)
    turn = Rotation.from_quat(table[f"{body}/spread:Ellipsoids3D:quaternions"][0][0])
    longest = turn.apply(np.eye(3)[np.argmax(spread[0][0])])
    np.testing.assert_allclose(np.abs(longest), [0.0, 0.0, 1.0], atol=1e-6)
    assert len(spread[2]) == 0


def test_the_blueprint_of_the_same_application_is_in_the_file(viewer: Viewer, file: Path) -> None:
    viewer.modules(["a"], {"a": "X5-9"})
    done(viewer)
    reader = RrdReader(str(file))
    recordings = [(entry.application_id, entry.recording_id) for entry in reader.recordings()]
    assert recordings == [("x5", "run-1")]
    assert [entry.application_id for entry in reader.blueprints()] == ["x5"]


@pytest.mark.parametrize(("pace", "layouts"), [(LIVE, 3), (FILE, 2)])
def test_a_narrowing_estimate_does_not_change_the_layout_in_the_middle_of_a_step(
    file: Path, make_rows: MakeRows, pace: Pace, layouts: int
) -> None:
    stream = rr.RecordingStream("x5", recording_id="run-1")
    stream.set_sinks(rr.FileSink(str(file)))
    recorder = Recorder(stream, "arm", pace)
    recorder.modules(["a"], {"a": "X5-9"})
    for i in range(100):
        recorder.estimate(120_000_000 * i, Estimate("link_length", "a", 0.25, 0.1 / (1 + i), "m"))
        recorder.rows("a", 120_000_000 * i + np.array([0, 110_000_000]), make_rows(0, 2))
    recorder.finish()
    stream.disconnect()
    # The modules, for a live viewer the new parameter, and at the end its narrower plot.
    assert len(RrdReader(str(file)).blueprints()) == layouts


def test_viewers_one_after_the_other_leave_no_threads_behind(tmp_path: Path, make_rows: MakeRows) -> None:
    def threads() -> int:
        return len(list(Path("/proc/self/task").iterdir()))

    counts = []
    for run in range(4):
        viewer = Viewer("arm", f"run-{run}", ViewerTargets(rrd=tmp_path / f"{run}.rrd"))
        viewer.modules(["a"], {"a": "X5-9"})
        viewer.rows("a", np.arange(5), make_rows(0, 5))
        viewer.estimate("link_length", "a", 5, 0.25, 0.01, "m")
        done(viewer)
        counts.append(threads())
    assert counts[1:] == counts[:1] * 3


def test_a_library_that_hangs_at_the_end_is_given_up_and_named(
    viewer: Viewer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As it does on some full disks: the run ends all the same, and its process too."""
    gate = threading.Event()
    monkeypatch.setattr("coordinator.viewer.viewer.DISCONNECT_SECONDS", 0.05)
    # The layout's own stream disconnects as usual.
    file, disconnect = viewer._opened.file, rr.RecordingStream.disconnect
    monkeypatch.setattr(
        rr.RecordingStream, "disconnect", lambda stream: gate.wait() if stream is file else disconnect(stream)
    )
    unregistered: list[bool] = []
    monkeypatch.setattr(rr, "unregister_shutdown", lambda: unregistered.append(True))
    viewer.phase(0, "rest")
    viewer.close()
    assert "the view of the run is not complete" in caplog.text
    assert unregistered == [True]
    monkeypatch.undo()
    gate.set()


def test_a_module_without_a_type_is_reported_and_the_run_goes_on(
    viewer: Viewer, file: Path, read: Read, arm: Chain, caplog: pytest.LogCaptureFixture
) -> None:
    viewer.chain(0, arm)
    viewer.phase(1, "after")
    viewer.close()
    assert viewer.failed == 1
    assert "the type of module 'a' is not known" in caplog.text
    assert times_ns(read(file, "/phase/log")) == [1]


def test_mistakes_of_the_caller_are_raised_at_the_call(viewer: Viewer, make_rows: MakeRows) -> None:
    with pytest.raises(ValueError, match="times of shape"):
        viewer.rows("a", np.arange(4), make_rows(0, 5))
    with pytest.raises(ValueError, match="for poses of shape"):
        viewer.poses([1, 2], [[0.1, 0.2]], ["a", "b"])
    with pytest.raises(ValueError, match="3 serials for poses"):
        viewer.poses([1], [[0.1, 0.2]], ["a", "b", "c"])
    with pytest.raises(ValueError, match="have shapes"):
        viewer.residuals("a", np.arange(2), [1.0], [1.0, 2.0])
    with pytest.raises(ValueError, match=r"'b'.*parent index 1"):
        viewer.topology(0, ["a", "b"], [-1, 1], [False, False])
    done(viewer)
    with pytest.raises(RuntimeError, match="closed"):
        viewer.phase(0, "late")


def test_with_no_target_nothing_happens(make_rows: MakeRows) -> None:
    viewer = Viewer("arm", "run-1", ViewerTargets())
    viewer.rows("a", np.arange(5), make_rows(0, 5))
    viewer.close()
    assert (viewer.dropped, viewer.failed) == (0, 0)

import json
import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from module_agent.model.errors import DataError
from sim.robot.robot_file import load_robot
from sim.sensors.module_clock import module_time
from sim.world.truth import Motion, Truth, TruthLog, read_motion, read_truth, truth_of, write_truth
from sim.world.world import World


def _assert_same(one: Truth, two: Truth) -> None:
    assert (one.robot, one.module_types, one.clocks) == (two.robot, two.module_types, two.clocks)
    for a, b in zip(one.chain, two.chain, strict=True):
        if isinstance(a, np.ndarray):
            np.testing.assert_array_equal(a, b)
        else:
            assert a == b
    np.testing.assert_array_equal(one.inertia, two.inertia)


def test_truth_is_read_back_to_the_last_bit(tmp_path: Path) -> None:
    robot = load_robot("tree_y")
    world = World(robot, seed=3)
    write_truth(tmp_path / "truth.json", robot, world)
    truth = read_truth(tmp_path / "truth.json")
    _assert_same(truth, truth_of(robot, world))
    assert truth.imu_bias is not None
    np.testing.assert_array_equal(truth.imu_bias, world.sensors.errors.imu_bias)
    assert truth.sensor_errors is not None
    for read, drawn in zip(truth.sensor_errors, world.sensors.errors, strict=True):
        np.testing.assert_array_equal(read, drawn)
        assert not read.flags.writeable
    assert truth.sensor_errors.misalignment.shape == (6, 2, 3, 3)
    assert not truth.inertia.flags.writeable


def test_truth_of_a_robot_alone_has_no_clocks(tmp_path: Path) -> None:
    robot = load_robot("arm6")
    write_truth(tmp_path / "truth.json", robot)
    truth = read_truth(tmp_path / "truth.json")
    _assert_same(truth, truth_of(robot))
    assert truth.clocks is None
    assert truth.sensor_errors is None
    assert truth.chain.reversed == (False, False, True, False, False, False)


def test_truth_written_before_sensors_had_more_errors_than_biases_is_read(tmp_path: Path) -> None:
    robot = load_robot("tree_y")
    path = tmp_path / "truth.json"
    write_truth(path, robot, World(robot, seed=3))
    document = json.loads(path.read_text())
    del document["sensor_errors"]
    path.write_text(json.dumps(document))
    assert read_truth(path).sensor_errors is None


def test_a_file_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "truth.json"
    path.write_text(json.dumps({"version": 99}))
    with pytest.raises(DataError, match="version 1"):
        read_truth(path)


def test_a_crash_while_writing_leaves_the_old_file_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "truth.json"
    write_truth(path, load_robot("arm6"))
    old = path.read_bytes()

    def crash(*_: object) -> None:
        raise OSError("the disk is gone")

    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(OSError, match="the disk is gone"):
        write_truth(path, load_robot("tree_y"))
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["truth.json"]


def test_the_log_records_every_fourth_instant_of_the_true_motion(tmp_path: Path) -> None:
    world = World(load_robot("a2085_03"), seed=3)
    log = TruthLog(world)
    q, samples = [], []
    for k in range(42):
        samples.append(list(log.exchange([0.1, 0.2 * np.sin(0.1 * k), -0.1])))
        q.append(world.plant.q_rad)
    log.save(tmp_path / "truth.npz")
    motion = read_motion(tmp_path / "truth.npz")
    assert motion.serials == ("shoulder-yaw", "shoulder-lift", "elbow")
    np.testing.assert_array_equal(motion.t_ns, np.arange(0, 42, 4) * 1_000_000)
    np.testing.assert_array_equal(motion.q_rad, q[::4])
    # On a module's own clock the truth stands where its samples do.
    np.testing.assert_array_equal(motion.clock_ns, [[s.t_ns for s in row] for row in samples[::4]])
    assert motion.clock_ns[-1, 2] == module_time(world.sensors.clocks[2], 40_000_000)
    assert not motion.qd_rad_s.flags.writeable


def test_a_log_of_nothing_is_empty_but_whole(tmp_path: Path) -> None:
    log = TruthLog(World(load_robot("a2085_03"), seed=3))
    log.save(tmp_path / "truth.npz")
    assert read_motion(tmp_path / "truth.npz").q_rad.shape == (0, 3)


def test_rows_of_many_blocks_are_those_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def motion() -> Motion:
        log = TruthLog(World(load_robot("a2085_03"), seed=3), every=2)
        for k in range(100):
            log.exchange([0.1, 0.2 * np.sin(0.1 * k), -0.1])
        return log.motion()

    one = motion()
    monkeypatch.setattr("sim.world.truth._BLOCK_ROWS", 7)
    many = motion()
    assert len(one.t_ns) == 50
    for a, b in zip(one[1:], many[1:], strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_tick_takes_no_more_memory_however_much_is_recorded() -> None:
    """A log that copied what it has would stop the world for longer and longer."""
    log = TruthLog(World(load_robot("a2085_03"), seed=3), every=1)
    peaks = []
    for _ in range(8):
        tracemalloc.start()
        # The rows of these ticks fill a block.
        for _ in range(16):
            counts = log.begin_run(256)[-1]
            counts[1] += 256
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert max(peaks[1:]) < 1.5 * peaks[1]
    assert len(log.motion().t_ns) == 8 * 16 * 256


def test_a_log_without_rows_keeps_none() -> None:
    log = TruthLog(World(load_robot("a2085_03"), seed=3), every=None)
    for _ in range(9):
        log.exchange([0.1, 0.0, -0.1])
    assert log.motion().q_rad.shape == (0, 3)
    assert log.world.t_ns == 9_000_000
    with pytest.raises(DataError, match="at least 1"):
        TruthLog(log.world, every=0)

"""A sick sensor changes what it reads while its fault lasts, and nothing else of the robot."""

import asyncio
import math

import numpy as np
import pytest

from module_agent.hardware.hardware import Readings, SensorSample
from module_agent.network_emulation.profile import PROFILES
from sim.faults.fault import NATURES, Fault
from sim.faults.faulty_robot import FaultyRobot
from sim.faults.schedule import first_modules
from sim.faults.sick_sensors import DRIFT, FULL_SCALE, JUMP_RAD, JUMP_S, SickSensors
from sim.robot.robot_file import load_robot
from sim.virtual_time.loop import VirtualLoop
from sim.virtual_time.network import VirtualNetwork
from sim.virtual_time.robot import VirtualSettings

FIELDS = SensorSample._fields
GYRO_X, IMU = (
    FIELDS.index("gyro_x_rad_s"),
    slice(FIELDS.index("gyro_x_rad_s"), FIELDS.index("accel_z_m_s2") + 1),
)
MS, TICKS = 1_000_000, 400


def healthy(tick: int) -> Readings:
    """Two modules whose readings all grow with time; their clocks are 5 s ahead of the world's."""
    readings = Readings(2)
    readings.floats[:] = 0.001 * tick + np.arange(34.0).reshape(2, 17)
    readings.integers[:, :2] = 5000 * MS + tick * MS
    return readings


def history(*faults: Fault) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much times [ms], (T, 2, 2), and other values, (T, 2, 15), are not the healthy ones."""
    sensors, times, values = SickSensors(faults, 2), [], []
    for tick in range(TICKS):
        well = healthy(tick)
        sick = sensors.read(tick * MS, well)
        times.append((sick.integers[:, :2] - well.integers[:, :2]) / MS)
        values.append(sick.floats[:, 2:] - well.floats[:, 2:])
    return np.array(times), np.array(values)


def test_before_its_fault_a_sensor_reads_what_is_there_and_no_copy_of_it() -> None:
    sensors, readings = SickSensors([Fault("IMU dead", 0.1, 0.1, 1)], 2), healthy(50)
    assert sensors.read(50 * MS, readings) is readings


@pytest.mark.parametrize(
    ("kind", "field", "during"),
    [
        ("encoder stuck", "position_rad", lambda t: -0.001 * (t - 100)),
        ("encoder NaN", "position_rad", lambda t: math.nan),
        ("IMU dead", "accel_y_m_s2", lambda t: -(0.001 * t + 17 + FIELDS.index("accel_y_m_s2"))),
        ("IMU stuck", "gyro_z_rad_s", lambda t: -0.001 * (t - 100)),
        ("IMU NaN", "gyro_x_rad_s", lambda t: math.nan),
        ("torque stuck", "effort_nm", lambda t: -0.001 * (t - 100)),
        ("torque NaN", "effort_nm", lambda t: math.nan),
    ],
)
def test_a_sensor_is_sick_while_its_fault_lasts(kind: str, field: str, during) -> None:
    times, values = history(Fault(kind, 0.1, 0.2, 1))
    column = values[:, 1, FIELDS.index(field) - 2]
    expected = [during(t) if 100 <= t < 300 else 0.0 for t in range(TICKS)]
    np.testing.assert_allclose(column, expected, atol=1e-12)
    assert not times.any()
    assert not values[:, 0].any()


def test_a_saturated_axis_reads_the_end_of_its_range() -> None:
    sensors = SickSensors([Fault("IMU saturated", 0.0, math.inf, 0, size=0.99)], 2)
    sick = sensors.read(0, healthy(0)).floats[0]
    assert sick[FIELDS.index("accel_z_m_s2")] == FULL_SCALE[1]
    np.testing.assert_array_equal(sick[GYRO_X : IMU.stop - 1], healthy(0).floats[0, GYRO_X : IMU.stop - 1])


def test_swapped_imus_read_each_other() -> None:
    sick = SickSensors([Fault("IMU swapped", 0.0, math.inf, 1)], 2).read(7 * MS, healthy(7)).floats
    np.testing.assert_array_equal(sick[:, IMU], healthy(7).floats[::-1, IMU])


def test_an_encoder_that_jumps_stays_where_it_jumped_to() -> None:
    _, values = history(Fault("encoder jump", 0.1, math.inf, 0, size=0.5))
    np.testing.assert_allclose(values[:100, 0, 0], 0.0)
    np.testing.assert_allclose(values[100:, 0, 0], 0.1 * JUMP_RAD)


def test_clocks_jump_stand_still_and_drift() -> None:
    forward, _ = history(Fault("clock forward", 0.1, math.inf, 0, size=0.0))
    np.testing.assert_allclose(forward[99:101, 0, 0], [0.0, 1e3 * 0.01 * JUMP_S])
    back, _ = history(Fault("clock back", 0.1, math.inf, 0, size=0.0))
    np.testing.assert_allclose(back, -forward)
    stuck, _ = history(Fault("clock stuck", 0.1, 0.2, 0))
    np.testing.assert_allclose(stuck[[99, 150, 299, 350], 0, 0], [0.0, -50.0, -199.0, -200.0])
    slow, _ = history(Fault("clock drift", 0.1, 0.2, 0, size=0.498))
    assert slow[200, 0, 0] < 0.0
    drift, _ = history(Fault("clock drift", 0.1, 0.2, 0, size=0.499))
    rate = DRIFT * 10.0 ** (2.0 * 0.499 - 2.0)
    np.testing.assert_allclose(
        # Clocks count in nanoseconds.
        drift[[99, 200, 350], 0, 0],
        [0.0, 100.0 * rate, 200.0 * rate],
        atol=1e-6,
    )


def test_two_sick_sensors_are_sick_together() -> None:
    _, both = history(Fault("encoder jump", 0.1, math.inf, 0), Fault("torque NaN", 0.2, 0.1, 0))
    assert both[250, 0, 0] == pytest.approx(0.01 * JUMP_RAD)
    assert math.isnan(both[250, 0, FIELDS.index("effort_nm") - 2])
    assert both[350, 0, FIELDS.index("effort_nm") - 2] == 0.0


def rows_of_all(one_at_a_time: bool) -> tuple[list[bytes], int]:
    """Return the rows that two modules keep of 4 s with all faults of sensors, and the calls of ticks.

    The last fault ends at 1.75 s; bad samples are made up for 0.4 s later, and all ticks are quiet then.
    """
    kinds = [kind for kind, nature in NATURES.items() if nature.part in ("clock", "encoder", "imu", "torque")]
    faults = [
        Fault(kind, 0.2 + 0.1 * k, math.inf if NATURES[kind].ends == "never" else 0.25, k % 2, 0.3 + 0.04 * k)
        for k, kind in enumerate(kinds)
    ]
    settings = VirtualSettings(first_modules(load_robot("thesis_171_vertical"), 2), PROFILES["none"], 1, "x5")
    loop, calls = VirtualLoop(), list[int]()
    robot = FaultyRobot(settings, loop, VirtualNetwork(loop), faults)
    robot.on_run.append(lambda seen: calls.append(len(seen)))
    if one_at_a_time:
        robot.on_tick.append(lambda: None)
    robot.start()
    loop.run_until_complete(asyncio.sleep(4.0))
    histories = [robot.hosts[serial].modules[0].firmware.history for serial in robot.serials]
    rows = [history.block(history.first_row, history.next_row) for history in histories]
    robot.close()
    loop.close()
    return rows, len(calls)


def test_sick_sensors_read_the_same_in_runs_of_many_ticks() -> None:
    many, calls = rows_of_all(one_at_a_time=False)
    single, ticks = rows_of_all(one_at_a_time=True)
    assert many == single
    assert calls < 0.6 * ticks

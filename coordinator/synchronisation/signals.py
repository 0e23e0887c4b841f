"""Everything that a module reported, as arrays on the session's time base."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.recording.recording import ModuleRecord
from module_agent.model.chain import Array
from module_agent.signals.clock_map import ClockMap

_NS = 1e-9


class Signals(NamedTuple):
    """What one module reported, in the order of time; m samples.

    t_s, imu_t_s: (m,) time since the recording began, the module's clock mapped to the session's; encoder and
    torque are sampled at t_s, the IMU at imu_t_s. Commands are NaN where a loop is off. gyro_rad_s and
    accel_m_s2 (specific force) are (m, 3) in the IMU's frame, all others (m,). motion_id: what ran, 0 for
    none; state: index into `feedback_rows.STATE_NAMES`.
    """

    t_s: Array
    imu_t_s: Array
    position_rad: Array
    velocity_rad_s: Array
    effort_nm: Array
    position_command_rad: Array
    velocity_command_rad_s: Array
    effort_command_nm: Array
    pwm: Array
    deflection_rad: Array
    motor_velocity_rad_s: Array
    motor_current_a: Array
    winding_temperature_c: Array
    voltage_v: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    motion_id: NDArray[Any]
    state: NDArray[Any]


_WHOLE = ("motion_id", "state")


def module_signals(module: ModuleRecord, clock: ClockMap, start_ns: int) -> Signals:
    """Return all samples of a module.

    Args:
        module: its rows.
        clock: its clock's map to session time.
        start_ns: session time at which the recording began, zero of the samples' times.
    """
    rows = module.rows.rows(module.rows.first_row, module.rows.end_row)
    times = {
        name: _NS * (clock.to_session(rows[source]) - start_ns).astype(float)
        for name, source in (("t_s", "t_ns"), ("imu_t_s", "imu_t_ns"))
    }
    values: dict[str, NDArray[Any]] = {
        name: rows[name].astype(np.int64 if name in _WHOLE else float)
        for name in Signals._fields
        if name not in times
    }
    return Signals(**times, **values)

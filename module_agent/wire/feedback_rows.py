"""The samples inside a `Feedback` message: little-endian records of `ROW`, packed, 101 bytes each."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from module_agent.wire.messages import Feedback
from module_agent.wire.refusal import Refusal, WireError

ROW = np.dtype(
    [
        ("t_ns", "<i8"),  # module clock at the tick
        ("imu_t_ns", "<i8"),  # module clock at which the IMU values were taken
        ("motion_id", "<u4"),  # the motion that ran at this tick, 0 = none
        ("state", "u1"),  # index into STATE_NAMES
        ("position_rad", "<f8"),
        ("velocity_rad_s", "<f4"),
        ("effort_nm", "<f4"),
        ("position_command_rad", "<f8"),  # NaN = unset, as for the next two
        ("velocity_command_rad_s", "<f4"),
        ("effort_command_nm", "<f4"),
        ("pwm", "<f4"),
        ("deflection_rad", "<f4"),
        ("motor_velocity_rad_s", "<f4"),
        ("motor_current_a", "<f4"),
        ("winding_temperature_c", "<f4"),
        ("voltage_v", "<f4"),
        ("gyro_rad_s", "<f4", (3,)),
        ("accel_m_s2", "<f4", (3,)),
    ]
)
STATE_NAMES = ("idle", "armed", "moving", "streaming", "expired", "stopped", "fault")

Rows = NDArray[Any]


def unpack(feedback: Feedback) -> Rows:
    """Return the records of a feedback message, shape (count,), read-only.

    Raises:
        WireError: the block's length is not `count` records, or a sensor value is not finite.
    """
    if len(feedback.rows) != feedback.count * ROW.itemsize:
        raise WireError(
            Refusal.MALFORMED,
            f"{len(feedback.rows)} bytes of rows, {feedback.count} rows of {ROW.itemsize} bytes announced",
        )
    rows = np.frombuffer(feedback.rows, dtype=ROW)
    for field in ("position_rad", "velocity_rad_s", "effort_nm", "gyro_rad_s", "accel_m_s2"):
        if not np.isfinite(rows[field]).all():
            raise WireError(Refusal.NOT_FINITE, f"{field} of serial {feedback.serial} is not finite")
    return rows

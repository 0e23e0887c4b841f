"""The samples inside a `Feedback` message: little-endian records of `ROW`, packed, 101 bytes each."""

import math
import struct
from collections.abc import Sequence
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

_CODES = {"<i8": "q", "<u4": "I", "|u1": "B", "<f8": "d", "<f4": "f"}
_PACKING = struct.Struct(
    "<" + "".join(math.prod(f.shape) * _CODES[f.base.str] for f, *_ in (ROW.fields or {}).values())
)
_MAX_F4 = float(np.finfo(np.float32).max)

# What a module measures must be finite; commands may be unset. Row by row, as numpy takes 1.4 us a field for
# a message of 5 rows, and this 0.2 us a row.
_MEASURED = ("position_rad", "velocity_rad_s", "effort_nm", "gyro_rad_s", "accel_m_s2")
_MEASURED_PACKING = struct.Struct("<21x d 2f 40x 6f")


def pack_row(ring: bytearray, slot: int, values: Sequence[float]) -> None:
    """Write one record into its slot: the values in the order of `ROW`, vectors element by element.

    A value too large for its field is kept as infinite, which whoever reads the row refuses.
    """
    offset = slot * ROW.itemsize
    try:
        _PACKING.pack_into(ring, offset, *values)
    except OverflowError:
        _PACKING.pack_into(
            ring, offset, *(math.copysign(math.inf, v) if abs(v) > _MAX_F4 else v for v in values)
        )


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
    # A sum is finite if all its terms are: eight f4 are too little to make one f8 overflow.
    if not all(map(math.isfinite, map(sum, _MEASURED_PACKING.iter_unpack(feedback.rows)))):
        field = next(name for name in _MEASURED if not np.isfinite(rows[name]).all())
        raise WireError(Refusal.NOT_FINITE, f"{field} of serial {feedback.serial} is not finite")
    return rows

"""The samples inside a `Feedback` message: little-endian records of `ROW`, packed, 101 bytes each."""

import math
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple, SupportsBytes

import numpy as np
from numpy.typing import NDArray

from module_agent.wire.codec import decode
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Feedback
from module_agent.wire.refusal import Refusal, WireError
from module_agent.wire.topics import TOPICS

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
_TIMES_PACKING = struct.Struct(f"<2q {ROW.itemsize - 16}x")
# Differences of two times, and sums of a time and a clock's offset, are in the range of 64 bits.
MAX_T_NS = 2**62 - 1


def pack_row(ring: bytearray, slot: int, values: Sequence[float]) -> None:
    """Write one record into its slot: the values in the order of `ROW`, vectors element by element.

    A value too large for its field is kept as infinite, which makes readers refuse the row.
    """
    offset = slot * ROW.itemsize
    try:
        _PACKING.pack_into(ring, offset, *values)
    except OverflowError:
        bounded = (math.copysign(math.inf, v) if abs(v) > _MAX_F4 else v for v in values)
        _PACKING.pack_into(ring, offset, *bounded)


def unpack(feedback: Feedback) -> Rows:
    """Return the records of a feedback message, shape (count,), read-only.

    Raises:
        WireError: the block's length is not `count` records, a sensor value is not finite, or a time is
            beyond `MAX_T_NS` on either side of zero.
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
    if not all(
        -MAX_T_NS <= t_ns <= MAX_T_NS and -MAX_T_NS <= imu_ns <= MAX_T_NS
        for t_ns, imu_ns in _TIMES_PACKING.iter_unpack(feedback.rows)
    ):
        raise WireError(Refusal.MALFORMED, f"a time of serial {feedback.serial} is beyond {MAX_T_NS} ns")
    return rows


class FeedbackRows(NamedTuple):
    """The rows of one feedback message.

    boot: random number of the module's present boot; row numbers and times restart with it.
    first_row: number of `rows[0]` since that boot; the rows are consecutive.
    rows: (count,) structured array of `ROW`, read-only.
    """

    serial: str
    boot: int
    first_row: int
    rows: Rows


def decode_feedback(payload: SupportsBytes) -> FeedbackRows:
    """Return the rows of a message on `x5/{robot}/{serial}/feedback`, or of a reply on `.../history`.

    `rows` has one record for each sample, with the fields

    - `t_ns`, `imu_t_ns`: module clock [ns] at the tick, and when the IMU was read,
    - `motion_id`: the motion that ran, 0 for none; `state`: index into `STATE_NAMES`,
    - `position_rad`, `velocity_rad_s`, `effort_nm`: the joint as measured, effort by the spring,
    - `position_command_rad`, `velocity_command_rad_s`, `effort_command_nm`: NaN where unset,
    - `pwm`: -1 to 1; `deflection_rad`: of the spring; `motor_velocity_rad_s`, `motor_current_a`,
    - `winding_temperature_c`, `voltage_v`,
    - `gyro_rad_s`, `accel_m_s2`: (3,) each, in the IMU's frame; at rest the specific force is 9.8 upwards.

    Example, with plain zenoh::

        import zenoh
        from module_agent import decode_feedback

        def show(sample):
            feedback = decode_feedback(sample.payload)
            print(feedback.serial, feedback.rows["t_ns"][-1], feedback.rows["position_rad"][-1])

        with zenoh.open(zenoh.Config()) as session:
            subscriber = session.declare_subscriber("x5/arm6/*/feedback", show)
            input("Press Enter to end.")

    Raises:
        WireError: the bytes are not a feedback message of this schema version, or a measured value is not
            finite.
    """
    feedback = decode(Feedback, bytes(payload), TOPICS[Leaf.FEEDBACK].max_bytes_from_module)
    return FeedbackRows(feedback.serial, feedback.boot, feedback.first_row, unpack(feedback))

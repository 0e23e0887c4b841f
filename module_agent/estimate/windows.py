"""Windows of samples for the local estimates, and their alignment onto one time axis."""

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from module_agent.model.errors import DataError
from module_agent.wire.feedback_rows import Rows

Array = NDArray[np.float64]
Times = NDArray[np.int64]
# The time step of the estimates from aligned samples, and how far from it samples count as evenly spaced.
STEP_NS, EVEN_WITHIN = 4_000_000, 0.05
# A longer hole is not bridged.
MAX_HOLE_NS = 100_000_000
# As many samples as a motion of a minute has at 1 kHz, with its margins. Times that another module sends may
# be anything, and must not fill this one's memory.
MAX_EVEN_SAMPLES = 65_536


class ImuWindow(NamedTuple):
    """Samples of one IMU: `t_ns` (n,) in its module's clock, rates and specific forces (n, 3) in frame u."""

    t_ns: Times
    gyro_rad_s: Array
    accel_m_s2: Array


class JointWindow(NamedTuple):
    """Samples of one joint, (n,) each; `t_ns` in the clock of the module that moves."""

    t_ns: Times
    position_rad: Array
    velocity_rad_s: Array


class AlignedMotion(NamedTuple):
    """One motion at the times of the IMU samples, `t_s` (n,) from the first on; joint values interpolated."""

    t_s: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    position_rad: Array
    velocity_rad_s: Array


Samples = TypeVar("Samples", ImuWindow, JointWindow)


def imu_window(rows: Rows) -> ImuWindow:
    """Take the IMU's samples out of feedback rows (`feedback_rows.ROW`).

    Rows may be more frequent than IMU samples, or repeated after a gap: every IMU time counts once.
    """
    return ImuWindow(*_columns(rows, "imu_t_ns", "gyro_rad_s", "accel_m_s2"))


def joint_window(rows: Rows) -> JointWindow:
    """Take the joint's samples out of feedback rows (`feedback_rows.ROW`); every row time counts once."""
    return JointWindow(*_columns(rows, "t_ns", "position_rad", "velocity_rad_s"))


def _columns(rows: Rows, time: str, one: str, other: str) -> tuple[Times, Array, Array]:
    t_ns, first = np.unique(rows[time].astype(np.int64), return_index=True)
    return t_ns, rows[one][first].astype(np.float64), rows[other][first].astype(np.float64)


def even(window: Samples, step_ns: float = STEP_NS) -> Samples:
    """Return a window at even steps: interpolated by a cubic spline, unless it is so already.

    Raises:
        DataError: fewer than 4 samples, a hole over `MAX_HOLE_NS`, or over `MAX_EVEN_SAMPLES` to be made.
    """
    t_ns, *signals = window
    steps = np.diff(t_ns)
    if steps.size < 3:
        raise DataError(f"{t_ns.size} samples: at least 4 are needed to interpolate")
    if np.abs(steps - step_ns).max() <= EVEN_WITHIN * step_ns:
        return window
    if steps.max() > MAX_HOLE_NS:
        raise DataError(
            f"a hole of {1e-6 * steps.max():.0f} ms; at most {1e-6 * MAX_HOLE_NS:.0f} are bridged"
        )
    # As integers of any size: differences of times may be longer than 63 bits.
    span_ns = int(t_ns[-1]) - int(t_ns[0])
    if span_ns > MAX_EVEN_SAMPLES * max(step_ns, 1.0):
        raise DataError(
            f"{t_ns.size} samples over {1e-9 * span_ns:.1f} s, most of them "
            f"{1e-6 * step_ns:.3g} ms apart: at most {MAX_EVEN_SAMPLES} even ones are made of them"
        )
    at_ns = np.arange(t_ns[0], t_ns[-1] + 1, round(step_ns))
    knots, at = 1e-9 * (t_ns - t_ns[0]), 1e-9 * (at_ns - t_ns[0])
    return type(window)(at_ns, *(np.asarray(CubicSpline(knots, signal)(at)) for signal in signals))


def align(imu: ImuWindow, joint: JointWindow, offset_ns: int) -> AlignedMotion:
    """Interpolate the joint to the times of the IMU samples: t of the joint is t + offset_ns of the IMU.

    IMU samples outside the joint's window are dropped: nothing is extrapolated.

    Raises:
        DataError: the windows do not overlap, or hold too few samples to interpolate.
    """
    if joint.t_ns.size < 4:
        raise DataError(f"{joint.t_ns.size} joint samples: at least 4 are needed to interpolate")
    t_joint = imu.t_ns - offset_ns
    inside = (t_joint >= joint.t_ns[0]) & (t_joint <= joint.t_ns[-1])
    if not inside.any():
        apart_s = 1e-9 * float(t_joint[0] - joint.t_ns[0]) if t_joint.size else float("nan")
        raise DataError(
            f"no IMU sample falls into the joint's window; they begin {apart_s:.3f} s apart. Check the offset"
        )
    # Seconds from a common origin: nanoseconds of a long uptime do not fit a float64 mantissa.
    origin = int(joint.t_ns[0])
    knots = 1e-9 * (joint.t_ns - origin)
    at = 1e-9 * (t_joint[inside] - origin)
    values = CubicSpline(knots, np.stack([joint.position_rad, joint.velocity_rad_s], axis=1))(at)
    return AlignedMotion(
        at - at[0], imu.gyro_rad_s[inside], imu.accel_m_s2[inside], values[:, 0].copy(), values[:, 1].copy()
    )

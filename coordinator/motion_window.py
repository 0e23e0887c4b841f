"""Stretches of a recording with all modules on one time base: what estimators work on."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.chain import Array
from coordinator.clock_map import ClockMap
from coordinator.dynamics.differentiation import (
    differentiate,
    resample,
    settling_samples,
    zero_phase_low_pass,
)
from coordinator.journal import JournalEvent
from coordinator.kinematics.refinement import SensorData
from coordinator.recording import Recording

RATE_HZ = 250.0
STEP_NS = 4_000_000


class Window(NamedTuple):
    """All modules during one motion: `t_ns` (m,) session time; joints (m, n); IMUs (m, n, 3)."""

    t_ns: NDArray[np.int64]
    q_rad: Array
    qd_rad_s: Array
    tau_nm: Array
    gyro_rad_s: Array
    accel_m_s2: Array


def window(
    recording: Recording,
    clocks: Mapping[str, ClockMap],
    serials: Sequence[str],
    event: JournalEvent,
    margin_s: float = 0.0,
) -> Window:
    """Resample all modules over one motion, at 250 Hz of session time, with a margin on either side.

    The window is cut to what all modules have recorded.

    Raises:
        ValueError: a hole in the recording, with the module or its column.
    """
    start_ns, end_ns = _span(recording, clocks, event, margin_s)
    times: list[NDArray[np.int64]] = []
    imu_times: list[NDArray[np.int64]] = []
    picked = []
    for serial in serials:
        log = recording.modules[serial].rows
        rows = log.rows(log.first_row, log.end_row)
        session = clocks[serial].to_session(rows["t_ns"].astype(np.int64))
        near = (session >= start_ns - 10 * STEP_NS) & (session <= end_ns + 10 * STEP_NS)
        if not near.any():
            raise ValueError(_no_row(serial, event))
        picked.append(rows[near])
        times.append(session[near])
        imu_times.append(clocks[serial].to_session(rows["imu_t_ns"][near].astype(np.int64)))
    start_ns = max(start_ns, *(int(t[0]) for t in (*times, *imu_times)))
    end_ns = min(end_ns, *(int(t[-1]) for t in (*times, *imu_times)))
    common = np.arange(start_ns, end_ns, STEP_NS, dtype=np.int64)

    def joint(field: str) -> Array:
        return resample(times, [rows[field] for rows in picked], common)

    def imu(field: str) -> Array:
        axes = [_imu_axis(imu_times, picked, field, axis, common) for axis in range(3)]
        return np.stack(axes, axis=2)

    return Window(
        common,
        joint("position_rad"),
        joint("velocity_rad_s"),
        joint("effort_nm"),
        imu("gyro_rad_s"),
        imu("accel_m_s2"),
    )


def _imu_axis(
    times: Sequence[NDArray[np.int64]],
    picked: Sequence[NDArray[np.void]],
    field: str,
    axis: int,
    common: NDArray[np.int64],
) -> Array:
    unique = [np.unique(t, return_index=True) for t in times]
    values = [rows[field][index, axis] for rows, (_, index) in zip(picked, unique, strict=True)]
    return resample([t for t, _ in unique], values, common)


def _span(
    recording: Recording, clocks: Mapping[str, ClockMap], event: JournalEvent, margin_s: float
) -> tuple[int, int]:
    assert event.motion is not None
    assert event.motion.end_row is not None
    log = recording.modules[event.serial].rows
    rows = log.rows(event.motion.start_row, event.motion.end_row)
    if not len(rows):
        raise ValueError(_no_row(event.serial, event))
    session = clocks[event.serial].to_session(rows["t_ns"][[0, -1]].astype(np.int64))
    margin_ns = round(margin_s * 1e9)
    return int(session[0]) - margin_ns, int(session[1]) + margin_ns


def _no_row(serial: str, event: JournalEvent) -> str:
    motion = f"{event.purpose} motion of {event.serial}"
    return f"module {serial} has no row in the {motion}: its recording has a hole"


def sensor_data(windows: Sequence[Window], cutoff_hz: float, keep_every: int) -> SensorData:
    """Filter all signals of all windows alike, differentiate, and keep one sample in `keep_every`."""
    parts = [_filtered(one, cutoff_hz, keep_every) for one in windows]
    return SensorData(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _filtered(one: Window, cutoff_hz: float, keep_every: int) -> SensorData:
    edge = settling_samples(RATE_HZ, cutoff_hz)
    kept = slice(edge, len(one.t_ns) - edge, keep_every)
    q, qd, gyro, accel = (
        zero_phase_low_pass(signal, RATE_HZ, cutoff_hz)
        for signal in (one.q_rad, one.qd_rad_s, one.gyro_rad_s, one.accel_m_s2)
    )
    qdd = differentiate(qd, RATE_HZ)
    return SensorData(q[kept], qd[kept], qdd[kept], gyro[kept], accel[kept])

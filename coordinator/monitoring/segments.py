"""Resample all modules to one time grid, block by block as rows arrive, and cut the motion into segments.

Rows are interpolated by a cubic through the four around (Lagrange): at 250 Hz its error at 10 Hz is 0.02 %.
Short gaps are interpolated as well; after a longer one the grid starts again, and so do the filters on it.

Segments are half a second long, filtered and differentiated alike; all slow tests work on them.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import RATE_HZ, STEP_NS
from module_agent.model.chain import Array
from module_agent.model.read_only import make_read_only, read_only
from module_agent.signals.autocorrelation import autocovariance
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import (
    DYNAMIC_CUTOFF_HZ,
    differentiate,
    filtered_signals,
    settling_samples,
    zero_phase_low_pass,
)

Times = NDArray[np.int64]

# As many rows are bridged as two messages hold.
MAX_GAP_NS = 48_000_000
# Who is behind the others by so much is silent.
SILENT_NS = 500_000_000
_JOINT = ("position_rad", "velocity_rad_s", "effort_nm", "motor_velocity_rad_s", "motor_current_a")
_ROWS_AROUND = 3


class Block(NamedTuple):
    """m samples of n modules on a grid of 4 ms; `t_ns` (m,) is session time, IMUs are (m, n, 3).

    motor_rad_s: the motors' own speeds, before the gear.
    """

    t_ns: Times
    q_rad: Array
    qd_rad_s: Array
    tau_nm: Array
    motor_rad_s: Array
    current_a: Array
    gyro_rad_s: Array
    accel_m_s2: Array


class Gap(NamedTuple):
    """Where a module's rows have a hole that is too long: from its last row before, to its next [ns]."""

    serial: str
    from_ns: int
    to_ns: int


class Aligned(NamedTuple):
    """A block, if there is one, and what is missing: holes that ended the block before it, who is silent."""

    block: Block | None
    gaps: tuple[Gap, ...]
    silent: tuple[str, ...]


class _Track(NamedTuple):
    t_ns: Times
    joint: Array
    imu_t_ns: Times
    imu: Array


class Alignment:
    """Turns a recording that grows into blocks, each beginning where the last one ended.

    The first one begins at `from_ns` of session time, or once all modules have rows, whichever is later.
    """

    def __init__(self, serials: Sequence[str], from_ns: int = 0):
        self._serials, self._from_ns = tuple(serials), from_ns
        self._next_ns: int | None = None

    def advance(
        self, recording: Recording, clocks: Mapping[str, ClockMap], until_ns: int | None = None
    ) -> Aligned:
        """Return the samples that all modules have since the last call, before a session time if given.

        A hole that reaches beyond that time, or over `from_ns`, shortens the block and is not named.
        """
        spans = [self._span(recording, clocks, s) for s in self._serials]
        known = [span for span in spans if span is not None]
        if len(known) < len(spans):
            logs = {s: recording.modules[s].rows for s in self._serials if s in recording.modules}
            missing = tuple(s for s in self._serials if s not in logs or not logs[s].end_row)
            return Aligned(None, (), missing)
        newest = max(last for _, last in known)
        silent = tuple(
            s for s, (_, last) in zip(self._serials, known, strict=True) if newest - last > SILENT_NS
        )
        if self._next_ns is None:
            self._next_ns = _on_grid(max(self._from_ns, *(first for first, _ in known)))
        end = min(last for _, last in known)
        if until_ns is not None:
            end = min(end, until_ns + _ROWS_AROUND * STEP_NS)
        tracks = [_track(recording, clocks[s], s, self._next_ns, end) for s in self._serials]
        gaps = tuple(
            gap
            for serial, track in zip(self._serials, tracks, strict=True)
            if track is not None and (gap := _gap(serial, track, self._next_ns)) is not None
        )
        if gaps:
            # What lies before the last hole is given up: it is shorter than what any test looks at.
            self._next_ns = _on_grid(max(gap.to_ns for gap in gaps))
            return Aligned(None, gaps, silent)
        whole = [track for track in tracks if track is not None and len(track.t_ns) > _ROWS_AROUND]
        if len(whole) < len(tracks):
            return Aligned(None, (), silent)
        self._next_ns = max(self._next_ns, _on_grid(max(int(track.t_ns[0]) for track in whole)))
        # Two rows beyond the last sample are needed for the cubic.
        ends = [int(t[-2]) for track in whole for t in (track.t_ns, track.imu_t_ns)]
        stop = min(ends) if until_ns is None else min(*ends, until_ns)
        grid = np.arange(self._next_ns, stop, STEP_NS, dtype=np.int64)
        if not grid.size:
            return Aligned(None, (), silent)
        self._next_ns = int(grid[-1]) + STEP_NS
        return Aligned(_block(grid, whole), (), silent)

    def _span(
        self, recording: Recording, clocks: Mapping[str, ClockMap], serial: str
    ) -> tuple[int, int] | None:
        """Return the session times of the rows; None without rows or clock."""
        if serial not in recording.modules or serial not in clocks:
            return None
        log = recording.modules[serial].rows
        # The newest is always there; the oldest only matters while the grid has not begun.
        rows = log.rows(log.first_row if self._next_ns is None else log.end_row - 1, log.end_row)
        if not len(rows):
            return None
        begin, end = clocks[serial].to_session(rows["t_ns"][[0, -1]].astype(np.int64))
        return int(begin), int(end)


def _on_grid(t_ns: int) -> int:
    return -(-t_ns // STEP_NS) * STEP_NS


def _track(recording: Recording, clock: ClockMap, serial: str, start_ns: int, end_ns: int) -> _Track | None:
    around = np.array([start_ns - MAX_GAP_NS - 2 * STEP_NS, end_ns + STEP_NS])
    first, last = (int(t) for t in clock.to_module(around))
    rows = recording.modules[serial].rows.between(first, last)
    if len(rows) < 2:
        return None
    imu_t_ns, fresh = np.unique(rows["imu_t_ns"], return_index=True)
    return _Track(
        clock.to_session(rows["t_ns"].astype(np.int64)),
        np.column_stack([rows[field] for field in _JOINT]).astype(float),
        clock.to_session(imu_t_ns.astype(np.int64)),
        np.column_stack([rows["gyro_rad_s"], rows["accel_m_s2"]])[fresh].astype(float),
    )


def _gap(serial: str, track: _Track, from_ns: int) -> Gap | None:
    """Return the last hole after a time, if there is one that is too long."""
    steps = np.diff(track.t_ns)
    bad = np.flatnonzero((steps > MAX_GAP_NS) & (track.t_ns[1:] > from_ns))
    if not bad.size:
        return None
    return Gap(serial, int(track.t_ns[bad[-1]]), int(track.t_ns[bad[-1] + 1]))


def _block(grid: Times, tracks: Sequence[_Track]) -> Block:
    joint = np.stack([_cubic(track.t_ns, track.joint, grid) for track in tracks], axis=1)
    imu = np.stack([_cubic(track.imu_t_ns, track.imu, grid) for track in tracks], axis=1)
    make_read_only((joint, imu))
    q, qd, tau, motor, current = (joint[..., k] for k in range(len(_JOINT)))
    return Block(grid, q, qd, tau, motor, current, imu[..., :3], imu[..., 3:])


def _cubic(t_ns: Times, values: Array, at_ns: Times) -> Array:
    """Interpolate (k, c) values at times (m,) by the cubic through the four samples around each."""
    first = np.clip(np.searchsorted(t_ns, at_ns, side="right") - 2, 0, max(len(t_ns) - 4, 0))
    index = first[:, None] + np.arange(min(4, len(t_ns)))
    known = tuple(1e-9 * (t_ns[index] - at_ns[:, None]).T)
    found = np.zeros((len(at_ns), values.shape[1]))
    for k, own in enumerate(known):
        weight = np.ones(len(at_ns))
        for other in (*known[:k], *known[k + 1 :]):
            weight *= other / (other - own)
        found += weight[:, None] * values[index[:, k]]
    return found


def joined_blocks(blocks: Sequence[Block]) -> Block:
    """Return successive blocks as one."""
    times = np.concatenate([block.t_ns for block in blocks])
    return Block(times, *(np.concatenate(column) for column in zip(*(b[1:] for b in blocks), strict=True)))


def part_of(block: Block, begin: int, end: int) -> Block:
    """Return some samples of a block."""
    return Block(block.t_ns[begin:end], *(column[begin:end] for column in block[1:]))


def without_offsets(block: Block, offset_nm: Array) -> Block:
    """Return a block with the torque sensors' offsets (n,) [Nm] taken off."""
    return block._replace(tau_nm=read_only(block.tau_nm - offset_nm))


SEGMENT_SAMPLES = 125
SEGMENT_S = SEGMENT_SAMPLES / RATE_HZ
_EDGE = settling_samples(RATE_HZ, DYNAMIC_CUTOFF_HZ)


class DataSegment(NamedTuple):
    """m samples of n modules; all but `raw`, the same samples, went through the same low-pass.

    t_ns: (m,). q_rad, qd_rad_s, qdd_rad_s2, tau_nm, and how fast that changes: (m, n). gyro_rad_s,
    accel_m_s2: (m, n, 3), and how fast both change, (m, n, 6). drive: (m, n, 6) currents of motors that
    drive, of motors that are driven back, sign(w) |tau|, sign(w), w and w' with w the motor's speed.
    """

    raw: Block
    t_ns: NDArray[np.int64]
    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    tau_nm: Array
    tau_rate_nm_s: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    imu_rates: Array
    drive: Array


class Segmenter:
    """Cuts blocks that follow on each other into segments, a sixth of a second late for the filter."""

    def __init__(self) -> None:
        self._held: list[Block] = []

    def reset(self) -> None:
        """Begin anew: the next block does not follow on the last one."""
        self._held.clear()

    def add(self, block: Block) -> list[DataSegment]:
        """Take the next block; return the segments that are complete with it."""
        whole, begin, reach = joined_blocks([*self._held, block]), 0, SEGMENT_SAMPLES + 2 * _EDGE
        segments = []
        while begin + reach <= len(whole.t_ns):
            segments.append(_segment(part_of(whole, begin, begin + reach)))
            begin += SEGMENT_SAMPLES
        self._held = [part_of(whole, begin, len(whole.t_ns))]
        return segments


def _segment(block: Block) -> DataSegment:
    others = [block.tau_nm, block.gyro_rad_s, block.accel_m_s2]
    q, qd, qdd, (tau, gyro, accel), kept = filtered_signals(block.q_rad, others, RATE_HZ, DYNAMIC_CUTOFF_HZ)
    rates = np.concatenate([differentiate(gyro, RATE_HZ), differentiate(accel, RATE_HZ)], axis=2)
    return DataSegment(
        raw=part_of(block, kept.start, kept.stop),
        t_ns=block.t_ns[kept],
        q_rad=q[kept],
        qd_rad_s=qd[kept],
        qdd_rad_s2=qdd[kept],
        tau_nm=tau[kept],
        tau_rate_nm_s=differentiate(tau, RATE_HZ)[kept],
        gyro_rad_s=gyro[kept],
        accel_m_s2=accel[kept],
        imu_rates=rates[kept],
        drive=_drive(block)[kept],
    )


def _drive(block: Block) -> Array:
    speed, current = block.motor_rad_s, block.current_a
    driving = current * speed > 0.0
    sign = np.sign(speed)
    signals = (np.where(driving, current, 0.0), np.where(driving, 0.0, current), sign * np.abs(block.tau_nm))
    filtered = zero_phase_low_pass(np.stack([*signals, sign, speed], axis=2), RATE_HZ, DYNAMIC_CUTOFF_HZ)
    return np.concatenate([filtered, differentiate(filtered[..., 4:], RATE_HZ)], axis=2)


def noise_level(residuals: Sequence[Array]) -> tuple[Array, Array]:
    """Return the scatter (c,) of residuals (m, c) of successive stretches, and how many samples count as one.

    The latter is 1 + 2 sum of the autocorrelations up to the first that is not positive: the variance of a
    mean of m coloured samples is sigma^2 / m times that (Priestley, Spectral Analysis and Time Series, 5.3).
    """
    whole = np.concatenate(residuals)
    sigma = np.sqrt(np.mean(whole**2, axis=0))
    longest = len(whole) // 4
    counted = np.ones(whole.shape[1])
    shared = autocovariance(whole)[:longest]
    shared = shared / np.maximum(shared[0], 1e-300)
    for c in range(whole.shape[1]):
        negative = np.flatnonzero(shared[:, c] <= 0.0)
        end = int(negative[0]) if negative.size else longest
        counted[c] = 1.0 + 2.0 * float(shared[1:end, c].sum())
    return sigma, counted

"""Motions of a recording for the estimators: all modules resampled on one time base and filtered alike."""

from collections.abc import Mapping, Sequence
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.batch_estimation.sensor_data import NoiseFloor, SensorData, measured_base_motion
from coordinator.recording.journal import JournalEvent, Purpose
from coordinator.recording.recording import Recording
from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap
from module_agent.signals.filtering import (
    DYNAMIC_CUTOFF_HZ,
    INSTRUMENT_CUTOFF_HZ,
    MAX_GAP_NS,
    NS_PER_S,
    JointMotion,
    differentiate,
    filtered_motion,
    filtered_signals,
    resample,
    settling_samples,
    zero_phase_low_pass,
)

RATE_HZ = 250.0
STEP_NS = 4_000_000
# A joint whose position scatters by fewer steps of its encoder than this is taken to stand still.
MOVING_STEPS = 20.0
# Samples in a period of the cut-off: what lies above half their rate is folded into the motion, and with two
# of them all that the low-pass lets through is; with six nothing below five times the cut-off.
FEWEST, FEW = 3.0, 6.0
# Bands as wide as the cut-off, from twice the cut-off on, in which noise is looked for, below the IMU's
# own low-pass; and the share of its rate up to which its samples tell.
BANDS, IMU_BAND = 5, 0.4
# No IMU of the class is quieter behind the low-pass, gyro [rad/s] and accelerometer [m/s^2]: a quarter of
# what a real X5-1's log reads at rest.
QUIETEST = (5e-5, 1e-3)


class Window(NamedTuple):
    """All modules during one motion: `t_ns` (m,) session time; joints (m, n); IMUs (m, n, 3).

    step_rad: (n,) the smallest difference between two readings of every encoder, 0 if all were alike.
    Velocities are not included: those of the modules are delayed by their filters.
    """

    t_ns: NDArray[np.int64]
    q_rad: Array
    tau_nm: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    step_rad: Array


def window(
    recording: Recording,
    clocks: Mapping[str, ClockMap],
    serials: Sequence[str],
    event: JournalEvent,
    cutoff_hz: float | None = None,
    bridged_ns: int = MAX_GAP_NS,
) -> Window:
    """Resample all modules over one motion, at 250 Hz of session time.

    The margins on either side are those in which a low-pass of `cutoff_hz` settles; None for none. The window
    is cut to what all modules have recorded. Holes up to `bridged_ns` are bridged.

    Raises:
        DataError: a hole in the recording, with the module or its column.
    """
    times = span(recording, clocks, event, cutoff_hz)
    return _aligned([_track(recording, clocks[s], s, event, *times) for s in serials], *times, bridged_ns)


def unbroken_windows(
    recording: Recording,
    clocks: Mapping[str, ClockMap],
    serials: Sequence[str],
    event: JournalEvent,
    cutoff_hz: float | None = None,
) -> list[Window]:
    """Return `window`, split where a module has a hole; parts too short for the low-pass are dropped.

    Raises:
        DataError: a module has no row, or no part is long enough.
    """
    times = span(recording, clocks, event, cutoff_hz)
    tracks = [_track(recording, clocks[s], s, event, *times) for s in serials]
    holes = np.array(sorted(hole for track in tracks for hole in track.holes())).reshape(-1, 2)
    starts = np.maximum.accumulate([times[0], *holes[:, 1]])
    shortest_ns = 3 * settling_samples(RATE_HZ, cutoff_hz or DYNAMIC_CUTOFF_HZ) * STEP_NS
    spans = zip(starts, [*holes[:, 0], times[1]], strict=True)
    parts = [(start, end) for start, end in spans if end - start > shortest_ns]
    if not len(holes) or not parts:
        return [_aligned(tracks, *times)]
    return [_aligned([track.between(*part) for track in tracks], *part) for part in parts]


def sampling_notes(
    recording: Recording,
    clocks: Mapping[str, ClockMap],
    serials: Sequence[str],
    events: Sequence[JournalEvent],
    cutoff_hz: float,
) -> tuple[str, ...]:
    """Return notes on holes and low rates of joints' and IMUs' samples in some motions.

    Raises:
        DataError: a rate too low for the low-pass, with serial, motion, rate and what is needed.
    """
    notes: list[str] = []
    for event, serial in product(events, serials):
        motion = f"the {event.purpose} motion of {event.serial}"
        try:
            times = span(recording, clocks, event, cutoff_hz)
            track = _track(recording, clocks[serial], serial, event, *times)
        except DataError:
            continue  # It is raised again where the rows are needed.
        for what, t_ns in (("joint", track.t_ns), ("IMU", track.imu_t_ns)):
            interval_ns = float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else float(NS_PER_S)
            if interval_ns == 0.0:
                raise DataError(
                    f"{serial}: over half of the samples of its {what} in {motion} have the time of the one "
                    "before: its clock stood still"
                )
            rate_hz = NS_PER_S / interval_ns
            if rate_hz < FEWEST * cutoff_hz:
                raise DataError(
                    f"{serial}: its {what} has {rate_hz:.1f} samples per second in {motion}; a low-pass of "
                    f"{cutoff_hz:g} Hz needs at least {FEWEST * cutoff_hz:g}"
                )
            if rate_hz < FEW * cutoff_hz:
                notes.append(
                    f"{serial}: its {what} has {rate_hz:.0f} samples per second; with fewer than "
                    f"{FEW * cutoff_hz:g} vibration above {rate_hz - cutoff_hz:.0f} Hz looks like motion"
                )
        notes += [
            f"{serial}: a hole of {1e-6 * (end - start):.0f} ms in {motion}, which is split there"
            for start, end in track.holes()
        ]
    return tuple(dict.fromkeys(notes))


def _aligned(tracks: Sequence["_Track"], start_ns: int, end_ns: int, bridged_ns: int = MAX_GAP_NS) -> Window:
    start_ns = max(start_ns, *(int(t[0]) for track in tracks for t in (track.t_ns, track.imu_t_ns)))
    end_ns = min(end_ns, *(int(t[-1]) for track in tracks for t in (track.t_ns, track.imu_t_ns)))
    common = np.arange(start_ns, end_ns, STEP_NS, dtype=np.int64)
    names = [track.name for track in tracks]
    of_joints, of_imus = [track.t_ns for track in tracks], [track.imu_t_ns for track in tracks]
    joint = resample(of_joints, [track.joint for track in tracks], common, bridged_ns, names)
    imu = resample(of_imus, [track.imu for track in tracks], common, bridged_ns, names)
    changes = [np.diff(np.unique(track.joint[:, 0])) for track in tracks]
    step = np.array([float(change.min()) if change.size else 0.0 for change in changes])
    return Window(common, joint[..., 0], joint[..., 1], imu[..., :3], imu[..., 3:], step)


class _Track(NamedTuple):
    """One module in session time: position and effort (m, 2); gyro and accelerometer (k, 6).

    name: which module, in which motion.
    """

    name: str
    t_ns: NDArray[np.int64]
    imu_t_ns: NDArray[np.int64]
    joint: Array
    imu: Array

    def holes(self) -> set[tuple[int, int]]:
        """Return the times around what `resample` does not bridge."""
        return {
            (int(t[k]), int(t[k + 1]))
            for t in (self.t_ns, self.imu_t_ns)
            for k in np.flatnonzero(np.diff(t) > MAX_GAP_NS)
        }

    def between(self, start_ns: int, end_ns: int) -> "_Track":
        """Return the samples within a span, both ends included."""
        of_joint, of_imu = ((t >= start_ns) & (t <= end_ns) for t in (self.t_ns, self.imu_t_ns))
        times = self.t_ns[of_joint], self.imu_t_ns[of_imu]
        return _Track(self.name, *times, self.joint[of_joint], self.imu[of_imu])


def _track(
    recording: Recording, clock: ClockMap, serial: str, event: JournalEvent, start_ns: int, end_ns: int
) -> _Track:
    first_ns, last_ns = clock.module_span(start_ns, end_ns, STEP_NS)
    rows = recording.modules[serial].rows.between(first_ns, last_ns)
    if not len(rows):
        raise _no_row(serial, event)
    # An IMU that is slower than the rows repeats its samples.
    imu_t_ns, fresh = np.unique(rows["imu_t_ns"], return_index=True)
    return _Track(
        f"module {serial} in the {event.purpose} motion of {event.serial}",
        clock.to_session(rows["t_ns"].astype(np.int64)),
        clock.to_session(imu_t_ns.astype(np.int64)),
        np.column_stack([rows[field] for field in ("position_rad", "effort_nm")]),
        np.column_stack([rows["gyro_rad_s"], rows["accel_m_s2"]])[fresh],
    )


def span(
    recording: Recording, clocks: Mapping[str, ClockMap], event: JournalEvent, cutoff_hz: float | None
) -> tuple[int, int]:
    """Return start and end of a motion in session time, with margins as those of `window`.

    Raises:
        DataError: no row of the motion is recorded.
    """
    assert event.motion is not None
    assert event.motion.end_row is not None
    rows = recording.rows(event.serial, event.motion.start_row, event.motion.end_row)
    if not len(rows):
        raise _no_row(event.serial, event)
    session = clocks[event.serial].to_session(rows["t_ns"][[0, -1]].astype(np.int64))
    margin_ns = round(settling_samples(RATE_HZ, cutoff_hz) / RATE_HZ * 1e9) if cutoff_hz else 0
    return int(session[0]) - margin_ns, int(session[1]) + margin_ns


def _no_row(serial: str, event: JournalEvent) -> DataError:
    motion = f"{event.purpose} motion of {event.serial}"
    return DataError(f"module {serial} has no row in the {motion}: its recording has a hole")


def noise_floor(rest: Window, cutoff_hz: float) -> NoiseFloor:
    """Return the noise of the first module's IMU at rest, through the same low-pass as `filtered`."""
    edge = settling_samples(RATE_HZ, cutoff_hz)
    gyro, accel = (
        zero_phase_low_pass(signal[:, 0], RATE_HZ, cutoff_hz)[edge:-edge].var(axis=0)
        for signal in (rest.gyro_rad_s, rest.accel_m_s2)
    )
    return NoiseFloor(gyro, accel, cutoff_hz)


def motion_noise(windows: Sequence[Window], rest: Window, cutoff_hz: float, imu_rate_hz: float) -> Array:
    """Return the noise (2, k, n) of all gyros [rad/s] and accelerometers [m/s^2] in k motions, rms per axis.

    That is the larger one of two, through the same low-pass as `filtered`, and never less than `QUIETEST`:
    noise of the least density beyond twice the cut-off, in the motion, where gears shake, and at rest. No
    motion reaches up there, but in some bands links ring. Of IMUs that are too slow for such a band it is
    what is below the cut-off at rest.
    """
    each = [
        np.array([_above(signal, cutoff_hz, imu_rate_hz) for signal in (one.gyro_rad_s, one.accel_m_s2)])
        for one in (rest, *windows)
    ]
    noise = np.sqrt(np.maximum(each[0], each[1:]).swapaxes(0, 1))
    return np.asarray(np.maximum(noise, np.reshape(QUIETEST, (2, 1, 1))))


def _above(signal: Array, cutoff_hz: float, imu_rate_hz: float) -> Array:
    """Return the variance (n,) below a cut-off of noise as dense as signals (m, n, 3) have beyond."""
    edges = cutoff_hz * np.arange(2, BANDS + 3)
    edges = edges[edges < IMU_BAND * imu_rate_hz]
    if len(edges) < 2:
        edges = np.array([0.0, cutoff_hz])
    taper = np.hanning(len(signal))[:, None, None]
    density = 2.0 * np.abs(np.fft.rfft((signal - signal.mean(axis=0)) * taper, axis=0)) ** 2
    bands = np.searchsorted(np.fft.rfftfreq(len(signal), 1.0 / RATE_HZ), edges)
    least = np.min([density[i:j].mean(axis=(0, 2)) for i, j in pairwise(bands)], axis=0)
    return np.asarray(cutoff_hz * least / (RATE_HZ * float((taper**2).sum())))


def encoder_steps(windows: Sequence[Window]) -> Array:
    """Return the encoders' resolution (n,), the smallest change in any window; 0 if none."""
    steps = np.array([one.step_rad for one in windows])
    resolution = np.min(np.where(steps > 0.0, steps, np.inf), axis=0)
    return np.asarray(np.where(np.isfinite(resolution), resolution, 0.0))


def thinned(parts: Sequence[SensorData], keep_every: int) -> SensorData:
    """Join filtered windows, one sample in `keep_every` of each."""
    numbered = [part._replace(motion=np.full(len(part.q_rad), k, np.int64)) for k, part in enumerate(parts)]
    columns = zip(*numbered, strict=True)
    return SensorData(
        *(None if one[0] is None else np.concatenate([part[::keep_every] for part in one]) for one in columns)  # type: ignore[arg-type]
    )


def filtered(
    one: Window,
    cutoff_hz: float,
    floor: NoiseFloor | None = None,
    imu_late_s: float = 0.0,
    step_rad: Array | None = None,
) -> SensorData:
    """Filter all signals of a window alike and differentiate; the filter's settling time is cut.

    The joints are delayed as the IMUs are. Given the resolution (n,) of the encoders, whose noise
    differentiation amplifies, the instrument is the part of the motion above that noise. With the noise
    `floor` of the first module's IMU, which rides on the base, the data has the base's motion.
    """
    others = [one.gyro_rad_s, one.accel_m_s2]
    q, qd, qdd, (gyro, accel), settled = filtered_signals(
        one.q_rad, others, RATE_HZ, cutoff_hz, late_s=imu_late_s
    )
    instrument = None
    if step_rad is not None:
        slow = zero_phase_low_pass(q, RATE_HZ, INSTRUMENT_CUTOFF_HZ)
        smooth = np.where(q.std(axis=0) > MOVING_STEPS * step_rad, slow, q.mean(axis=0))
        speed = differentiate(smooth, RATE_HZ)
        instrument = np.concatenate([smooth, speed, differentiate(speed, RATE_HZ)], axis=1)[settled]
    rates = np.concatenate([differentiate(gyro, RATE_HZ), differentiate(accel, RATE_HZ)], axis=2)
    base = None
    if floor is not None:
        base = np.hstack(measured_base_motion(gyro[:, 0], accel[:, 0], floor, RATE_HZ))[settled]
    q, qd, qdd, gyro, accel, rates = (signal[settled] for signal in (q, qd, qdd, gyro, accel, rates))
    return SensorData(q, qd, qdd, gyro, accel, rates, base, None, instrument)


# Independent samples per sample after the low-pass.
INDEPENDENT_FRACTION = min(1.0, 2.0 * DYNAMIC_CUTOFF_HZ / RATE_HZ)


def dynamic_windows(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str], *purposes: Purpose
) -> list[Window]:
    """Return all motions of some purposes, columns in the order of `serials`, with the low-pass' margins.

    Of a repeated step the latest counts. Motions are split at holes (`unbroken_windows`).

    Raises:
        DataError: there is no such motion, or nothing is left of one between holes.
    """
    # Joints that move at once share their step, and its window.
    steps = {event.step: event for event in recording.motions(*purposes)}
    if not steps:
        raise DataError(f"the recording holds no motion for {' or '.join(purposes)}")
    return [
        one
        for event in steps.values()
        for one in unbroken_windows(recording, clocks, serials, event, DYNAMIC_CUTOFF_HZ)
    ]


def dynamic_motion(
    recording: Recording, clocks: Mapping[str, ClockMap], serials: Sequence[str], *purposes: Purpose
) -> JointMotion:
    """Return all motions of some purposes one after the other, filtered; see `dynamic_windows`.

    Raises:
        DataError: as there.
    """
    windows = dynamic_windows(recording, clocks, serials, *purposes)
    return joined_motions([filtered_window(one) for one in windows])


def joined_motions(motions: Sequence[JointMotion]) -> JointMotion:
    """Return motions one after the other."""
    return JointMotion(*(np.concatenate(column) for column in zip(*motions, strict=True)))


def filtered_window(one: Window) -> JointMotion:
    """Return a window as the regressor needs it, without its margins."""
    # No velocity: that of the modules is delayed by their filter.
    return filtered_motion(one.t_ns, one.q_rad, None, one.tau_nm, RATE_HZ, DYNAMIC_CUTOFF_HZ)

"""Modules with clocks of their own are brought onto one time base, and no missing row is invented."""

from types import SimpleNamespace

import numpy as np
import pytest

from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import Recording
from coordinator.synchronisation.motion_windows import (
    RATE_HZ,
    STEP_NS,
    Window,
    encoder_steps,
    filtered,
    motion_noise,
    sampling_notes,
    thinned,
    unbroken_windows,
    window,
)
from module_agent.model.errors import DataError
from module_agent.signals.clock_map import ClockMap
from module_agent.wire.feedback_rows import ROW
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import Rest

OFFSETS_S = {"A": 3.0, "B": -7.25, "C": 1e6}
DRIFT = {"A": 0.0, "B": 8e-5, "C": -5e-5}
SERIALS = ("A", "B", "C")
IMU_LATE_NS = 1_700_000
ROWS = 1500


def _clock(serial: str) -> ClockMap:
    """Session time of a module time: the modules started before or after the session did."""
    return ClockMap(0, OFFSETS_S[serial] * 1e9, DRIFT[serial], 0.0)


def _signal(t_s: np.ndarray, serial: str, order: int = 0) -> np.ndarray:
    """A swing at 2 Hz, other for every module, and its derivatives; at most 0.3 rad."""
    size, phase, rate = 0.1 * (1 + SERIALS.index(serial)), SERIALS.index(serial), 4 * np.pi
    return np.asarray(size * rate**order * np.sin(rate * t_s + phase + order * np.pi / 2))


def _rows(serial: str) -> np.ndarray:
    """Rows at 250 Hz of the module's own clock, its IMU read 1.7 ms before each, over 6 s of session time."""
    session = np.arange(ROWS) * 4_000_000 + 200_000 * SERIALS.index(serial)
    rows = np.zeros(ROWS, dtype=ROW)
    rows["t_ns"] = _clock(serial).to_module(session)
    rows["imu_t_ns"] = _clock(serial).to_module(session - IMU_LATE_NS)
    t_s, imu_s = session * 1e-9, (session - IMU_LATE_NS) * 1e-9
    rows["position_rad"] = _signal(t_s, serial)
    rows["velocity_rad_s"] = _signal(t_s, serial, 1)
    rows["effort_nm"] = _signal(t_s, serial, 2)
    rows["gyro_rad_s"] = _signal(imu_s, serial, 1)[:, None] * [1.0, -2.0, 0.5]
    rows["accel_m_s2"] = _signal(imu_s, serial, 2)[:, None] * [0.1, 0.2, -0.3]
    return rows


def _recording(wire: SimpleNamespace, gap: dict[str, tuple[int, int]] | None = None) -> Recording:
    """All rows of all modules but those in a module's gap."""
    recording = Recording()
    for serial in SERIALS:
        rows = _rows(serial)
        first_missing, end_missing = (gap or {}).get(serial, (ROWS, ROWS))
        for first in range(0, ROWS, 100):
            blocks = [(first, min(first + 100, first_missing)), (max(first, end_missing), first + 100)]
            for start, end in blocks:
                if start < end:
                    block = wire.feedback(serial, first=start, rows=rows[start:end])
                    recording.add(wire.publication(Leaf.FEEDBACK, block))
    return recording


def _event(wire: SimpleNamespace, start: int = 400, end: int = 1000) -> JournalEvent:
    motion = wire.record(1, Rest(duration_s=1.0), start, end)
    return JournalEvent(t_ns=0, what="motion", serial="A", purpose="constant", motion=motion)


CLOCKS = {serial: _clock(serial) for serial in SERIALS}


def test_all_modules_are_sampled_at_the_same_times(wire: SimpleNamespace) -> None:
    resampled = window(_recording(wire), CLOCKS, SERIALS, _event(wire))
    t_s = resampled.t_ns * 1e-9
    assert (resampled.t_ns[0], resampled.t_ns[-1]) == (400 * STEP_NS, 998 * STEP_NS)
    for column, serial in enumerate(SERIALS):
        # A cubic spline through a 2 Hz swing at 250 Hz: (2 pi 2 / 250)^4 / 384 = 2e-8 of it; the rows hold
        # positions in double, everything else in single precision.
        np.testing.assert_allclose(resampled.q_rad[:, column], _signal(t_s, serial), atol=1e-7)
        np.testing.assert_allclose(resampled.tau_nm[:, column], _signal(t_s, serial, 2), atol=2e-5)
        # The IMU has its own times; taken for the rows' they would put 1.7 ms * 47 rad/s^2 = 0.08 rad/s here.
        np.testing.assert_allclose(
            resampled.gyro_rad_s[:, column, 1], -2 * _signal(t_s, serial, 1), atol=5e-6
        )
        np.testing.assert_allclose(
            resampled.accel_m_s2[:, column, 2], -0.3 * _signal(t_s, serial, 2), atol=5e-6
        )


def test_a_clock_that_is_wrong_by_a_millisecond_shows(wire: SimpleNamespace) -> None:
    late = CLOCKS["B"]._replace(offset_ns=CLOCKS["B"].offset_ns + 1e6)
    resampled = window(_recording(wire), {**CLOCKS, "B": late}, SERIALS, _event(wire))
    t_s = resampled.t_ns * 1e-9
    np.testing.assert_allclose(resampled.q_rad[:, 0], _signal(t_s, "A"), atol=1e-7)
    np.testing.assert_allclose(resampled.q_rad[:, 1], _signal(t_s - 1e-3, "B"), atol=1e-7)


def test_a_margin_extends_the_motion_as_far_as_all_modules_have_rows(wire: SimpleNamespace) -> None:
    recording = _recording(wire)
    inside = window(recording, CLOCKS, SERIALS, _event(wire), cutoff_hz=4.0)  # half a second
    assert (inside.t_ns[0], inside.t_ns[-1]) == (275 * STEP_NS, 1123 * STEP_NS)
    beyond = window(recording, CLOCKS, SERIALS, _event(wire), cutoff_hz=1.0 / 30.0)  # a minute
    # The last module to begin has its first row at 0.4 ms; the first to end its last IMU sample 1.7 ms early.
    assert beyond.t_ns[0] == 400_000
    assert 1499 * STEP_NS - IMU_LATE_NS - STEP_NS <= beyond.t_ns[-1] <= 1499 * STEP_NS - IMU_LATE_NS


def test_repeated_rows_and_samples_do_not_change_the_window(wire: SimpleNamespace) -> None:
    recording = _recording(wire)
    once = window(recording, CLOCKS, SERIALS, _event(wire))
    rows = _rows("B")
    recording.add(wire.publication(Leaf.FEEDBACK, wire.feedback("B", first=500, rows=rows[500:600])))
    twice = window(recording, CLOCKS, SERIALS, _event(wire))
    for mine, theirs in zip(once, twice, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_hole_is_named_by_its_module_and_not_bridged(wire: SimpleNamespace) -> None:
    with pytest.raises(DataError, match=r"module B in the constant motion of A has a hole of 84\.0 ms"):
        window(_recording(wire, {"B": (600, 620)}), CLOCKS, SERIALS, _event(wire))


def test_a_motion_is_split_at_holes_of_any_module(wire: SimpleNamespace) -> None:
    gaps = {"A": (600, 650), "B": (690, 730), "C": (710, 720)}
    recording, event = _recording(wire, gaps), _event(wire)
    one, two = unbroken_windows(recording, CLOCKS, SERIALS, event, cutoff_hz=12.0)
    # With margins of 42 steps; the 40 samples from A's hole to B's are too few for the low-pass.
    assert [len(part.t_ns) for part in (one, two)] == pytest.approx([241, 311], abs=2)
    for part in (one, two):
        np.testing.assert_allclose(part.q_rad[:, 2], _signal(part.t_ns * 1e-9, "C"), atol=1e-7)
    notes = sampling_notes(recording, CLOCKS, SERIALS, [event], 12.0)
    assert "A: a hole of 204 ms in the constant motion of A, which is split there" in notes
    assert {note[0] for note in notes} == set(SERIALS)


def test_a_motion_without_holes_is_one_window(wire: SimpleNamespace) -> None:
    recording, event = _recording(wire), _event(wire)
    (part,) = unbroken_windows(recording, CLOCKS, SERIALS, event, cutoff_hz=12.0)
    for mine, theirs in zip(part, window(recording, CLOCKS, SERIALS, event, 12.0), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert sampling_notes(recording, CLOCKS, SERIALS, [event], 12.0) == ()


def test_a_motion_of_holes_alone_is_refused(wire: SimpleNamespace) -> None:
    recording = _recording(wire, {"B": (450, 950)})
    with pytest.raises(DataError, match=r"module B in the constant motion of A has a hole of 2004\.0 ms"):
        unbroken_windows(recording, CLOCKS, SERIALS, _event(wire), cutoff_hz=12.0)


def test_rates_too_low_for_the_low_pass_are_named(wire: SimpleNamespace) -> None:
    recording, event = _recording(wire), _event(wire)
    first, *_ = sampling_notes(recording, CLOCKS, SERIALS, [event], 42.0)
    assert first.startswith(
        "A: its joint has 250 samples per second; with fewer than 252 vibration above 208"
    )
    with pytest.raises(DataError, match=r"A: its joint has 250\.0 samples per second in .* at least 252"):
        sampling_notes(recording, CLOCKS, SERIALS, [event], 84.0)


def test_a_clock_that_stands_still_for_most_of_a_motion_is_named(
    wire: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def standing(serial: str) -> np.ndarray:
        rows = whole(serial)
        if serial == "B":
            rows["t_ns"][350:900], rows["imu_t_ns"][350:900] = rows["t_ns"][350], rows["imu_t_ns"][350]
        return rows

    whole = _rows
    monkeypatch.setattr(f"{__name__}._rows", standing)
    with pytest.raises(DataError, match=r"^B: over half of the samples of its joint .* clock stood still"):
        sampling_notes(_recording(wire), CLOCKS, SERIALS, [_event(wire)], 12.0)


def test_a_module_without_any_row_in_the_motion_is_named(wire: SimpleNamespace) -> None:
    with pytest.raises(DataError, match="module C has no row"):
        window(_recording(wire, {"C": (300, 1100)}), CLOCKS, SERIALS, _event(wire))
    with pytest.raises(DataError, match="module A has no row"):
        window(_recording(wire, {"A": (300, 1100)}), CLOCKS, SERIALS, _event(wire))


def test_filtered_data_is_the_motion_and_its_derivative(wire: SimpleNamespace) -> None:
    one = window(_recording(wire), CLOCKS, SERIALS, _event(wire), cutoff_hz=20.0 / 3.0)
    data = thinned([filtered(one, 15.0)] * 2, keep_every=5)
    samples = data.q_rad.shape[0]
    assert data.gyro_rad_s.shape == data.accel_m_s2.shape == (samples, 3, 3)
    # What is blocks lies inside by two periods of the cut-off, every fifth sample of it, twice.
    edge = int(np.ceil(2 * RATE_HZ / 15.0))
    assert samples == 2 * len(range(edge, len(one.t_ns) - edge, 5))
    half = samples // 2
    t_s = one.t_ns[edge:-edge:5] * 1e-9
    for column, serial in enumerate(SERIALS):
        size = np.abs(_signal(t_s, serial)).max()
        # Gain of the filter at 2 Hz with a cut-off of 15 Hz: 1 - (2 / 15)^8, 1e-7; the ends settle to 1 %.
        np.testing.assert_allclose(data.q_rad[:half, column], _signal(t_s, serial), atol=2e-3 * size)
        scale = np.abs(_signal(t_s, serial, 2)).max()
        np.testing.assert_allclose(data.qdd_rad_s2[:half, column], _signal(t_s, serial, 2), atol=5e-3 * scale)
    np.testing.assert_array_equal(data.q_rad[:half], data.q_rad[half:])


def _noisy_window(step_rad: float) -> Window:
    """Joint 0 swings at 1 Hz, joint 1 is held; both encoders resolve a step. No IMU sees anything."""
    t_s = np.arange(1500) / RATE_HZ
    true = np.stack([0.3 * np.sin(2 * np.pi * t_s), np.full_like(t_s, 0.2)], axis=1)
    jitter = np.random.default_rng(0).uniform(-step_rad, step_rad, true.shape)
    nothing = np.zeros((*true.shape, 3))
    read = step_rad * np.round((true + jitter) / step_rad)
    return Window(
        np.arange(1500) * STEP_NS, read, np.zeros_like(true), nothing, nothing, np.full(2, step_rad)
    )


def test_the_instrument_has_the_motion_and_not_the_encoders_noise() -> None:
    one = _noisy_window(1e-4)
    data = filtered(one, 12.0, step_rad=encoder_steps([one]))
    q, _, qdd = data.smooth
    # A held joint's noise is differentiated to 0.1 rad/s^2 as measured, and is nothing in the instrument.
    assert data.qdd_rad_s2[:, 1].std() > 0.02
    assert not qdd[:, 1].any()
    assert np.ptp(q[:, 1]) == 0.0
    # The one that moves keeps its motion to what a step hides, with less of the noise.
    t_s = (np.arange(len(q)) + (1500 - len(q)) // 2) / RATE_HZ
    true = -0.3 * (2 * np.pi) ** 2 * np.sin(2 * np.pi * t_s)
    middle = slice(100, -100)
    off, raw = (np.std((signal[:, 0] - true)[middle]) for signal in (qdd, data.qdd_rad_s2))
    assert off < 0.6 * raw
    assert off < 0.01 * true.std()


def test_without_a_known_step_the_instrument_is_what_was_measured() -> None:
    data = filtered(_noisy_window(1e-4), 12.0)
    assert data.smooth[2] is data.qdd_rad_s2


def _noisy(seed: int, size: float, imu_rate_hz: float, motion: float) -> Window:
    """Four seconds of two IMUs: a motion of the first at 2 Hz and its ringing, white noise of both."""
    t_ns = np.arange(1000) * STEP_NS
    read_ns = np.arange(0, int(t_ns[-1]) + 1, round(1e9 / imu_rate_hz))
    white = np.random.default_rng(seed).normal(0.0, size, (len(read_ns), 2, 3))
    noise = np.stack([[np.interp(t_ns, read_ns, axis) for axis in imu.T] for imu in white.swapaxes(0, 1)])
    moved = np.zeros((len(t_ns), 2, 3))
    moved[:, 0] = motion * (np.sin(4e-9 * np.pi * t_ns) + 0.01 * np.sin(70e-9 * np.pi * t_ns))[:, None]
    gyro = moved + noise.transpose(2, 0, 1)
    return Window(t_ns, np.zeros((1000, 2)), np.zeros((1000, 2)), gyro, 10.0 * gyro, np.zeros(2))


def test_noise_of_a_motion_is_told_apart_from_motion_and_ringing() -> None:
    rest, slow, fast = (_noisy(k, size, RATE_HZ, k) for k, size in enumerate((1e-3, 1e-3, 3e-3)))
    noise = motion_noise([slow, fast], rest, 12.0, RATE_HZ)
    assert noise.shape == (2, 2, 2)
    # White noise up to 125 Hz, of which 12 Hz are left; the least of five bands is a little below their mean.
    expected = np.sqrt(12.0 / 125.0) * np.array([1e-3, 3e-3])
    np.testing.assert_allclose(noise[0], np.tile(expected[:, None], 2), rtol=0.15)
    np.testing.assert_allclose(noise[1], 10.0 * noise[0])


def test_noise_of_slow_imus_is_that_of_rest() -> None:
    """At 50 Hz no band above the motion is left."""
    rest, moving = _noisy(0, 1e-3, 50.0, 0.0), _noisy(1, 1e-3, 50.0, 0.0)
    noise = motion_noise([moving], rest, 12.0, 50.0)
    np.testing.assert_allclose(noise[0], 1e-3 * np.sqrt(12.0 / 25.0), rtol=0.3)

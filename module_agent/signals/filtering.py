"""Positions, velocities, accelerations and torques on one time base, all through the same low-pass.

The regressor needs accelerations, and they come by differentiation (thesis section 5.1), which needs a
low-pass: the same linear filter over torque and motion, or every inertia would come out too large.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.linalg.lapack import dtbtrs

from module_agent.model.chain import Array
from module_agent.model.errors import DataError
from module_agent.model.read_only import read_only

FILTER_ORDER = 4

# The cut-offs of `zero_phase_low_pass` [Hz]; `settling_samples` either side of a motion are needed for each.
# One joint's slow motion, the others held: below what a held spring rings at; its ramps last 0.15 s and more.
HELD_JOINT_CUTOFF_HZ = 6.0
# Four times the 2 Hz of the windowed sine. Loads of links are differentiated four times, which amplifies an
# encoder's noise with the fourth power of the frequency.
INSTRUMENT_CUTOFF_HZ = 8.0
# Compliant joints ring at 3 to 20 Hz; a slow motion itself ends in about a second.
TOPOLOGY_CUTOFF_HZ = 10.0
# Six times the 2 Hz of the windowed sine, and above the resonance of any base that is usable.
REFINEMENT_CUTOFF_HZ = 12.0
# The same for torques, so that agents and coordinator share their filtered motions.
DYNAMIC_CUTOFF_HZ = 12.0
# Six times the fastest sine of all joints moving at once.
SIMULTANEOUS_CUTOFF_HZ = 15.0
# Seven times the 2 Hz of the windowed sine: a clock's lag shows in how fast rates change.
CLOCK_CUTOFF_HZ = 15.0

NS_PER_S = 1_000_000_000
# The longest hole between samples that is bridged: 10 samples at 250 Hz.
MAX_GAP_NS = 40_000_000
# Of signals of so many samples at most the slopes are a product with a matrix that is kept, 0.5 MB.
SHORT = 256


class JointMotion(NamedTuple):
    """Filtered signals of n joints on one time base, (m, n) each and read-only; `t_ns` is (m,)."""

    t_ns: NDArray[np.int64]
    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    tau_nm: Array


class FilteredSignals(NamedTuple):
    """Positions (m, n) with their first two derivatives and other signals (m, ...), all through one low-pass.

    Nothing is cut off; `kept` are the samples on which the low-pass has settled.
    """

    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    others: tuple[Array, ...]
    kept: slice

    def settled(self) -> tuple[Array, ...]:
        """Return positions, velocities, accelerations and the other signals without the unsettled samples."""
        return tuple(signal[self.kept] for signal in (*self[:3], *self.others))


def resample(
    t_ns: Sequence[ArrayLike],
    signals: Sequence[ArrayLike],
    t_common_ns: ArrayLike,
    max_gap_ns: int = MAX_GAP_NS,
    names: Sequence[str] = (),
) -> Array:
    """Interpolate the signal of every module onto one time base, by a cubic spline (0.005 % off at 10 Hz).

    Args:
        t_ns: per module the times (m_i,) of its samples, increasing, already mapped into one clock.
        signals: per module the values (m_i,), or (m_i, k) of k signals that were sampled together.
        t_common_ns: (m,) times to interpolate to.
        max_gap_ns: the longest hole between samples that is bridged.
        names: what messages call the modules; by default the columns.

    Returns:
        (m, n), or (m, n, k), read-only.

    Raises:
        DataError: times out of order, a hole that is too long, or a common time outside a module's samples;
            the message names the module.
    """
    common = np.asarray(t_common_ns, dtype=np.int64)
    if len(t_ns) != len(signals):
        raise DataError(
            f"{len(t_ns)} time bases for {len(signals)} signals; one of each per module is needed"
        )
    resampled = np.empty((common.size, len(signals), *np.shape(signals[0])[1:]))
    for column, (times, values) in enumerate(zip(t_ns, signals, strict=True)):
        known = np.asarray(times, dtype=np.int64)
        _check_times(names[column] if names else f"column {column}", known, common, max_gap_ns)
        # Nanoseconds since an epoch need more digits than a float has: subtract first.
        spline = make_interp_spline((known - known[0]) / NS_PER_S, np.asarray(values, dtype=float))
        resampled[:, column] = spline((common - known[0]) / NS_PER_S)
    return read_only(resampled)


def zero_phase_low_pass(signal: ArrayLike, rate_hz: float, cutoff_hz: float) -> Array:
    """Filter (m, ...) along its first axis without delay; read-only.

    A Butterworth low-pass of order 4 runs forward and backward, so that `cutoff_hz` is where half the
    amplitude is left; below a third of it the gain is above 0.9998. The ends are extended by odd reflection;
    the first and last `settling_samples` are less exact.

    Raises:
        DataError: a cut-off outside (0, rate / 2), or fewer samples than the reflection needs.
    """
    if not 0.0 < cutoff_hz < 0.5 * rate_hz:
        raise DataError(f"cutoff_hz {cutoff_hz} is outside 0 to {0.5 * rate_hz}, half the sampling rate")
    values = np.asarray(signal, dtype=float)
    padding = settling_samples(rate_hz, cutoff_hz)
    if values.shape[0] <= padding:
        raise DataError(f"{values.shape[0]} samples; a cut-off of {cutoff_hz} Hz needs more than {padding}")
    extended = np.concatenate(
        [2.0 * values[0] - values[padding:0:-1], values, 2.0 * values[-1] - values[-2 : -padding - 2 : -1]]
    ).reshape(len(values) + 2 * padding, -1)
    sections = _butterworth(cutoff_hz / rate_hz)
    for _ in range(2):
        for numerator, denominator in sections:
            extended = _second_order(numerator, denominator, extended)
        extended = extended[::-1]
    return read_only(extended[padding:-padding].reshape(values.shape).copy())


def _butterworth(cutoff: float) -> list[tuple[Array, Array]]:
    """Return the numerator and denominator (3,) of each second-order section, in powers of 1/z.

    Pairs of poles at -sin(a) +- i cos(a) on the unit circle, a = (2 k + 1) pi / 2 N, mapped by the bilinear
    transform s = (1 - 1/z) / (1 + 1/z) / tan(pi fc / fs) (Oppenheim and Schafer, Discrete-Time Signal
    Processing, section 7.1). Written out here because `scipy.signal` takes a third of an agent's start.

    Args:
        cutoff: as a part of the sampling rate.
    """
    warped = np.tan(np.pi * cutoff)
    sections = []
    for k in range(FILTER_ORDER // 2):
        damping = 2.0 * warped * np.sin((2 * k + 1) * np.pi / (2 * FILTER_ORDER))
        square = warped**2
        scale = 1.0 + damping + square
        numerator = np.array([1.0, 2.0, 1.0]) * square / scale
        denominator = np.array([1.0, 2.0 * (square - 1.0) / scale, (1.0 - damping + square) / scale])
        sections.append((numerator, denominator))
    return sections


def _second_order(numerator: Array, denominator: Array, signal: Array) -> Array:
    """Run one section of unit gain over (m, n) columns, as if each had always been at its first sample.

    For all k, y_k + a1 y_(k-1) + a2 y_(k-2) = b0 x_k + b1 x_(k-1) + b2 x_(k-2): a banded triangular system.
    """
    before = np.concatenate([signal[:1], signal[:1], signal])
    driven = numerator[0] * before[2:] + numerator[1] * before[1:-1] + numerator[2] * before[:-2]
    driven[0] -= (denominator[1] + denominator[2]) * signal[0]
    driven[1] -= denominator[2] * signal[0]
    bands = np.repeat(denominator[:, None], len(signal), axis=1)
    solved, _ = dtbtrs(bands, driven, uplo="L", diag="U")
    return np.asarray(solved)


def leaky_sum(signal: ArrayLike, keep: float, before: ArrayLike) -> Array:
    """Return y_k = x_k + keep y_(k-1) of (m, n) samples, m > 0, where y_(-1) is `before` (n,); read-only."""
    driven = np.array(signal, dtype=float)
    driven[0] += keep * np.asarray(before, dtype=float)
    bands = np.repeat([[1.0], [-keep]], len(driven), axis=1)
    solved, _ = dtbtrs(bands, driven, uplo="L", diag="U")
    return read_only(np.asarray(solved))


def settling_samples(rate_hz: float, cutoff_hz: float) -> int:
    """Return how many samples at either end the low-pass has not settled: its response is then below 1 %."""
    # The slowest poles of the fourth-order filter decay as exp(-0.38 * 2 pi fc t): 2 periods leave 0.8 %.
    return int(np.ceil(2.0 * rate_hz / cutoff_hz))


def differentiate(signal: ArrayLike, rate_hz: float) -> Array:
    """Return the time derivative of (m, ...) samples along the first axis, by a cubic spline; read-only.

    At a tenth of the sampling rate the derivative is 0.1 % short (a central difference: 6.5 %).
    """
    values = np.asarray(signal, dtype=float)
    if len(values) <= SHORT and np.isfinite(values).all():
        slopes = rate_hz * (_slopes(len(values)) @ values.reshape(len(values), -1))
        return read_only(slopes.reshape(values.shape))
    t = np.arange(values.shape[0]) / rate_hz
    return read_only(np.asarray(CubicSpline(t, values, axis=0)(t, 1)))


@lru_cache(maxsize=16)
def _slopes(samples: int) -> Array:
    """Return the matrix that turns samples a unit of time apart into their spline's slopes there."""
    t = np.arange(samples, dtype=float)
    return read_only(np.asarray(CubicSpline(t, np.eye(samples))(t, 1)))


def filtered_signals(
    q_rad: ArrayLike,
    others: Sequence[ArrayLike],
    rate_hz: float,
    cutoff_hz: float,
    keep_every: int = 1,
    late_s: float = 0.0,
) -> FilteredSignals:
    """Filter positions and other signals alike, and differentiate the positions twice.

    Velocities come from positions because those that modules report are late by a filter of their own.

    Args:
        q_rad: (m, n) at `rate_hz`. others: (m, ...) each, sampled with them.
        keep_every: thins the settled samples out, one in so many.
        late_s: delays the positions, to match other signals that are late.

    Raises:
        DataError: as `zero_phase_low_pass`.
    """
    edge = settling_samples(rate_hz, cutoff_hz)
    q, *filtered = (zero_phase_low_pass(signal, rate_hz, cutoff_hz) for signal in (q_rad, *others))
    if late_s:
        t_s = np.arange(len(q)) / rate_hz
        q = CubicSpline(t_s, q)(t_s - late_s)
    qd = differentiate(q, rate_hz)
    kept = slice(edge, len(q) - edge, keep_every)
    return FilteredSignals(q, qd, differentiate(qd, rate_hz), tuple(filtered), kept)


def filtered_motion(
    t_ns: ArrayLike,
    q_rad: ArrayLike,
    qd_rad_s: ArrayLike | None,
    tau_nm: ArrayLike,
    rate_hz: float,
    cutoff_hz: float,
) -> JointMotion:
    """Return what the regressor and the least squares need, through one low-pass.

    Args:
        t_ns: (m,) uniform times at `rate_hz`.
        q_rad, qd_rad_s, tau_nm: (m, n) as measured; without velocities positions are differentiated twice.
        cutoff_hz: of `zero_phase_low_pass`; at least three times the motion's highest frequency.

    Returns:
        The signals without the unsettled samples at both ends. The bandwidth left has about
        `2 * cutoff_hz / rate_hz` independent samples per sample (see `solve_information`).

    Raises:
        DataError: shapes that differ, times that are not uniform, too few samples, or a bad cut-off.
    """
    times = np.asarray(t_ns, dtype=np.int64)
    signals = [np.asarray(s, dtype=float) for s in (q_rad, tau_nm, *([] if qd_rad_s is None else [qd_rad_s]))]
    for signal in signals:
        if signal.shape != signals[0].shape or signal.shape[0] != times.size or signal.ndim != 2:
            raise DataError(
                f"a signal has shape {signal.shape}; ({times.size}, joints) is needed for all alike"
            )
    # Integer nanoseconds round by up to one; a drifting module clock is the business of `resample`.
    off = np.abs(np.diff(times) - NS_PER_S / rate_hz)
    if off.size and off.max() > 1.0:
        raise DataError(
            f"t_ns is not uniform at {rate_hz} Hz: sample {int(np.argmax(off)) + 1} is "
            f"{off.max() / 1e3:.1f} us off; resample first"
        )
    q, qd, qdd, (tau,), kept = filtered_signals(q_rad, [tau_nm], rate_hz, cutoff_hz)
    if qd_rad_s is not None:
        qd = zero_phase_low_pass(qd_rad_s, rate_hz, cutoff_hz)
        qdd = differentiate(qd, rate_hz)
    if kept.stop <= kept.start:
        raise DataError(f"{times.size} samples; {kept.start} at either end are unsettled and nothing is left")
    motion = (q, qd, qdd, tau)
    return JointMotion(read_only(times[kept].copy()), *(read_only(signal[kept].copy()) for signal in motion))


def _check_times(name: str, known: NDArray[np.int64], common: NDArray[np.int64], max_gap_ns: int) -> None:
    if known.size < 4:
        raise DataError(f"{name} has {known.size} samples; at least 4 are needed to interpolate")
    steps = np.diff(known)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        raise DataError(f"{name}: the time of sample {row} is not after that of the sample before it")
    if common.size and (common.min() < known[0] or common.max() > known[-1]):
        raise DataError(
            f"{name} has samples from {known[0]} to {known[-1]} ns; the common times run from "
            f"{common.min()} to {common.max()} ns, and nothing is extrapolated"
        )
    if steps.max() > max_gap_ns:
        row = int(np.argmax(steps)) + 1
        raise DataError(
            f"{name} has a hole of {steps.max() / 1e6:.1f} ms before sample {row}; "
            f"at most {max_gap_ns / 1e6:.1f} ms are bridged"
        )

"""Filter a recording for the fit: one low-pass over torque and motion, then fewer samples."""

from typing import NamedTuple

import numpy as np
from scipy.signal import welch

from coordinator.arm_fit.data_file import JointLog
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError
from module_agent.signals.filtering import NS_PER_S, filtered_motion, settling_samples, zero_phase_low_pass

# Of the speed's power in what counts as the motion, and how many times its highest frequency passes. Friction
# at reversals has harmonics up to several times the motion's frequency; what lies above the motion is noise.
_MOTION_POWER, _HARMONICS = 0.99, 5.0
# Samples kept per cut-off: half of that is three cut-offs, where the low-pass leaves 2e-4 of the amplitude to
# fold back.
_KEPT_PER_CUTOFF = 6.0
# A regressor of so many entries has 120 MB, and a fit holds some copies; a joint has about so many columns.
# Longer recordings are thinned further.
_MAX_ENTRIES = 1.5e7
_COLUMNS_PER_JOINT = 15


class FilteredLog(NamedTuple):
    """Filtered and thinned signals (m, n) of consecutive samples, read-only.

    tau_raw_nm: the torques as recorded at the same times. settling: samples over which the low-pass mixes
        earlier and later ones. noise: |raw - filtered| / |raw| over all recorded samples, which no model of
        this bandwidth can explain.
    fine_qd_rad_s, fine_qdd_rad_s2: filtered at the recording's own rate, for nonlinear columns; see
        `low_passed`.
    """

    rate_hz: float
    cutoff_hz: float
    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    tau_nm: Array
    tau_raw_nm: Array
    settling: int
    noise: float
    fine_rate_hz: float
    fine_qd_rad_s: Array
    fine_qdd_rad_s2: Array

    @property
    def top_rad_s(self) -> Array:
        """The joints' top speeds (n,)."""
        return np.asarray(np.abs(self.qd_rad_s).max(axis=0))

    def low_passed(self, fine: Array) -> Array:
        """Return a function (m', k) of the fine signals, low-passed as the torque is, at the kept samples."""
        edge = settling_samples(self.fine_rate_hz, self.cutoff_hz)
        filtered = zero_phase_low_pass(fine, self.fine_rate_hz, self.cutoff_hz)
        return _thinned(filtered, edge, round(self.fine_rate_hz / self.rate_hz))


def usual_cutoff_hz(log: JointLog) -> float:
    """Return a cut-off that suits a motion: five times the frequency that 99 % of the speeds' power is below.

    At most a fifth of the sampling rate.
    """
    speed = np.diff(log.q_rad, axis=0) * log.rate_hz
    frequencies, power = welch(
        speed, log.rate_hz, nperseg=min(len(speed), int(10.0 * log.rate_hz)), axis=0, detrend=False
    )
    # Joints count alike, however far they move.
    moving = power.sum(axis=0) > 0.0
    if not moving.any():
        return 0.2 * log.rate_hz
    shares = np.cumsum(power[:, moving] / power[:, moving].sum(axis=0), axis=0).mean(axis=1)
    highest = float(frequencies[min(int(np.searchsorted(shares, _MOTION_POWER)), len(frequencies) - 1)])
    return float(min(_HARMONICS * max(highest, frequencies[1]), 0.2 * log.rate_hz))


def max_samples(joints: int) -> int:
    """Return how many samples of n joints a fit uses at most, so that their regressor fits into memory."""
    return int(_MAX_ENTRIES / (_COLUMNS_PER_JOINT * joints**2))


def filtered_log(log: JointLog, cutoff_hz: float, max_count: int | None = None) -> FilteredLog:
    """Return a recording through one low-pass (`filtered_motion`), with at most `max_count` samples.

    Raises:
        UsageError: a cut-off out of range, or too few samples for it.
    """
    if not 0.0 < cutoff_hz < 0.5 * log.rate_hz:
        raise UsageError(f"cutoff_hz {cutoff_hz} is outside 0 to {0.5 * log.rate_hz}, half the sampling rate")
    edge = settling_samples(log.rate_hz, cutoff_hz)
    if len(log.q_rad) <= 4 * edge:
        raise UsageError(
            f"{len(log.q_rad)} samples, of which the low-pass unsettles {4 * edge}; a longer recording or a "
            "higher cut-off is needed"
        )
    t_ns = np.round(np.arange(len(log.q_rad)) * (NS_PER_S / log.rate_hz)).astype(np.int64)
    motion = filtered_motion(
        t_ns=t_ns,
        q_rad=log.q_rad,
        qd_rad_s=log.qd_rad_s,
        tau_nm=log.tau_nm,
        rate_hz=log.rate_hz,
        cutoff_hz=cutoff_hz,
    )
    raw = log.tau_nm[edge : len(log.tau_nm) - edge]
    size = float(np.linalg.norm(raw))
    step = max(1, int(log.rate_hz / (_KEPT_PER_CUTOFF * cutoff_hz)))
    if max_count is not None:
        step = max(step, -(-len(raw) // max_count))
    q, qd, qdd, tau, tau_raw = (
        _thinned(signal, edge, step)
        for signal in (motion.q_rad, motion.qd_rad_s, motion.qdd_rad_s2, motion.tau_nm, raw)
    )
    return FilteredLog(
        rate_hz=log.rate_hz / step,
        cutoff_hz=cutoff_hz,
        q_rad=q,
        qd_rad_s=qd,
        qdd_rad_s2=qdd,
        tau_nm=tau,
        tau_raw_nm=tau_raw,
        settling=-(-edge // step),
        noise=float(np.linalg.norm(raw - motion.tau_nm)) / size if size > 0.0 else float("nan"),
        fine_rate_hz=log.rate_hz,
        fine_qd_rad_s=motion.qd_rad_s,
        fine_qdd_rad_s2=motion.qdd_rad_s2,
    )


def _thinned(fine: Array, edge: int, step: int) -> Array:
    """Return every `step`-th sample without the ends, where a second low-pass has not settled."""
    return fine[edge : len(fine) - edge : step]

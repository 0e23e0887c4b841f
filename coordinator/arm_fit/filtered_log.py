"""Filter a recording for the fit: one low-pass over torque and motion, then fewer samples."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.arm_fit.data_file import JointLog
from module_agent.model.chain import Array
from module_agent.model.errors import UsageError
from module_agent.model.read_only import make_read_only, read_only
from module_agent.signals.filtering import differentiate, settling_samples, zero_phase_low_pass

# Samples kept per cut-off: half of that is three cut-offs, where the low-pass leaves 2e-4 of the amplitude to
# fold back.
_KEPT_PER_CUTOFF = 6.0
# A regressor of so many entries has 120 MB, and a fit holds some copies; a joint has about so many columns.
# Longer recordings are thinned further.
_MAX_ENTRIES = 1.5e7
_COLUMNS_PER_JOINT = 20


class FilteredLog(NamedTuple):
    """Filtered and thinned signals (m, n) of consecutive samples, read-only.

    tau_raw_nm: the torques as recorded at the same times. settling: samples over which the low-pass mixes
        earlier and later ones. noise: |raw - filtered| / |raw| over all recorded samples, which no model of
        this bandwidth can explain. dropped_s: recorded in pieces that are too short for the low-pass.
    fine_qd_rad_s, fine_qdd_rad_s2: filtered at the recording's own rate, piece by piece, with the ends on
        which the low-pass has not settled; for nonlinear columns, see `low_passed`. edge: samples of an end.
    t_s, piece: (m,) times of the samples, and the numbers of their pieces.
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
    dropped_s: float
    fine_rate_hz: float
    fine_qd_rad_s: tuple[Array, ...]
    fine_qdd_rad_s2: tuple[Array, ...]
    edge: int
    t_s: Array
    piece: NDArray[np.int64]

    @property
    def top_rad_s(self) -> Array:
        """The joints' top speeds (n,)."""
        return np.asarray(np.abs(self.qd_rad_s).max(axis=0))

    def low_passed(self, fine: Sequence[Array]) -> Array:
        """Return a function (m', k) of each piece's fine signals, low-passed as the torque is, thinned."""
        step = round(self.fine_rate_hz / self.rate_hz)
        filtered = (zero_phase_low_pass(piece, self.fine_rate_hz, self.cutoff_hz) for piece in fine)
        return np.concatenate([piece[self.edge : len(piece) - self.edge : step] for piece in filtered])


def max_samples(joints: int) -> int:
    """Return how many samples of n joints a fit uses at most, so that their regressor fits into memory."""
    return int(_MAX_ENTRIES / (_COLUMNS_PER_JOINT * joints**2))


def filtered_log(
    log: JointLog, cutoff_hz: float, max_count: int | None = None, settled_hz: float | None = None
) -> FilteredLog:
    """Return a recording through one low-pass (`zero_phase_low_pass`) over motion and torque.

    The pieces between breaks lose, at either end, the samples on which the low-pass has not settled; pieces
    that are too short for that are dropped.

    Args:
        log, cutoff_hz: the recording, and the low-pass [Hz].
        max_count: of samples that are kept at most.
        settled_hz: a lower cut-off whose ends are lost instead, to compare cut-offs on the same samples.

    Raises:
        UsageError: a cut-off out of range, or too few samples for it.
    """
    if not 0.0 < cutoff_hz < 0.5 * log.rate_hz:
        raise UsageError(f"cutoff_hz {cutoff_hz} is outside 0 to {0.5 * log.rate_hz}, half the sampling rate")
    edge = settling_samples(log.rate_hz, settled_hz or cutoff_hz)
    pieces = [piece for piece in log.pieces() if len(piece.q_rad) > 2 * edge + 4]
    usable = sum(len(piece.q_rad) - 2 * edge for piece in pieces)
    if usable <= edge:
        raise UsageError(
            f"{len(log.q_rad)} samples in {len(log.breaks) + 1} pieces, of which the low-pass unsettles "
            f"{2 * edge} each; a longer recording or a higher cut-off is needed"
        )
    step = max(1, int(log.rate_hz / (_KEPT_PER_CUTOFF * cutoff_hz)))
    if max_count is not None:
        step = max(step, -(-usable // max_count))
    motions = [_motion(piece, cutoff_hz) for piece in pieces]

    def settled(signals: Sequence[Array], every: int) -> Array:
        kept = [signal[edge : len(signal) - edge : every] for signal in signals]
        return read_only(np.concatenate(kept))

    raw, filtered = settled([piece.tau_nm for piece in pieces], 1), settled([m[3] for m in motions], 1)
    size = float(np.linalg.norm(raw))
    at = [np.arange(edge, len(piece.q_rad) - edge, step) for piece in pieces]
    times = [piece.starts_s[0] + rows / log.rate_hz for piece, rows in zip(pieces, at, strict=True)]
    q, qd, qdd, tau = (settled([motion[k] for motion in motions], step) for k in range(4))
    return FilteredLog(
        rate_hz=log.rate_hz / step,
        cutoff_hz=cutoff_hz,
        q_rad=q,
        qd_rad_s=qd,
        qdd_rad_s2=qdd,
        tau_nm=tau,
        tau_raw_nm=settled([piece.tau_nm for piece in pieces], step),
        settling=-(-edge // step),
        noise=float(np.linalg.norm(raw - filtered)) / size if size > 0.0 else float("nan"),
        dropped_s=log.duration_s - sum(piece.duration_s for piece in pieces),
        fine_rate_hz=log.rate_hz,
        fine_qd_rad_s=tuple(motion[1] for motion in motions),
        fine_qdd_rad_s2=tuple(motion[2] for motion in motions),
        edge=edge,
        t_s=read_only(np.concatenate(times)),
        piece=read_only(np.repeat(np.arange(len(pieces)), [len(rows) for rows in at])),
    )


def _motion(log: JointLog, cutoff_hz: float) -> tuple[Array, Array, Array, Array]:
    """Return positions, velocities, accelerations and torques (m, n) through the low-pass, ends included."""
    q, tau = (zero_phase_low_pass(signal, log.rate_hz, cutoff_hz) for signal in (log.q_rad, log.tau_nm))
    if log.qd_rad_s is None:
        qd = differentiate(q, log.rate_hz)
    else:
        qd = zero_phase_low_pass(log.qd_rad_s, log.rate_hz, cutoff_hz)
    motion = (q, qd, differentiate(qd, log.rate_hz), tau)
    make_read_only(motion)
    return motion

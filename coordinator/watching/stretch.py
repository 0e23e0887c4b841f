"""Half seconds of motion, filtered and differentiated alike: what every slow test looks at."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.dynamic_motions import DYNAMIC_CUTOFF_HZ
from coordinator.motion_window import RATE_HZ
from coordinator.watching.alignment import Block, joined_blocks, part_of
from module_agent.dynamics.chain import Array
from module_agent.dynamics.differentiation import differentiate, settling_samples, zero_phase_low_pass

STRETCH_SAMPLES = 125
STRETCH_S = STRETCH_SAMPLES / RATE_HZ
_EDGE = settling_samples(RATE_HZ, DYNAMIC_CUTOFF_HZ)


class Stretch(NamedTuple):
    """m samples of n modules; all but `raw` went through the same low-pass.

    t_ns: (m,). q_rad, qd_rad_s, qdd_rad_s2, tau_nm: (m, n). gyro_rad_s, accel_m_s2: (m, n, 3), and how fast
    both change, (m, n, 6). drive: (m, n, 6) currents of motors that drive, of motors that are driven back,
    sign(w) |tau|, sign(w), w and w' with w the motor's speed. raw: the same samples, unfiltered.
    """

    t_ns: NDArray[np.int64]
    q_rad: Array
    qd_rad_s: Array
    qdd_rad_s2: Array
    tau_nm: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    imu_rates: Array
    drive: Array
    raw: Block


class Stretches:
    """Cuts blocks that follow on each other into stretches, a sixth of a second late for the filter."""

    def __init__(self) -> None:
        self._held: list[Block] = []

    def reset(self) -> None:
        """Begin anew: the next block does not follow on the last one."""
        self._held.clear()

    def add(self, block: Block) -> list[Stretch]:
        """Take the next block; return the stretches that are complete with it."""
        self._held.append(block)
        if sum(len(part.t_ns) for part in self._held) < STRETCH_SAMPLES + 2 * _EDGE:
            return []
        whole = joined_blocks(self._held)
        found, begin = [], 0
        while begin + STRETCH_SAMPLES + 2 * _EDGE <= len(whole.t_ns):
            found.append(_stretch(part_of(whole, begin, begin + STRETCH_SAMPLES + 2 * _EDGE)))
            begin += STRETCH_SAMPLES
        self._held = [part_of(whole, begin, len(whole.t_ns))]
        return found


def _stretch(block: Block) -> Stretch:
    kept = slice(_EDGE, len(block.t_ns) - _EDGE)
    q, tau, gyro, accel = (
        zero_phase_low_pass(signal, RATE_HZ, DYNAMIC_CUTOFF_HZ)
        for signal in (block.q_rad, block.tau_nm, block.gyro_rad_s, block.accel_m_s2)
    )
    # The module's own velocity is late by its filter; positions are of their instant.
    qd = differentiate(q, RATE_HZ)
    qdd = differentiate(qd, RATE_HZ)
    rates = np.concatenate([differentiate(gyro, RATE_HZ), differentiate(accel, RATE_HZ)], axis=2)
    return Stretch(
        t_ns=block.t_ns[kept],
        q_rad=q[kept],
        qd_rad_s=qd[kept],
        qdd_rad_s2=qdd[kept],
        tau_nm=tau[kept],
        gyro_rad_s=gyro[kept],
        accel_m_s2=accel[kept],
        imu_rates=rates[kept],
        drive=_drive(block)[kept],
        raw=part_of(block, kept.start, kept.stop),
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
    size = 1 << int(np.ceil(np.log2(2 * len(whole))))
    spectrum = np.abs(np.fft.rfft(whole, size, axis=0)) ** 2
    shared = np.fft.irfft(spectrum, size, axis=0)[:longest]
    shared = shared / np.maximum(shared[0], 1e-300)
    for c in range(whole.shape[1]):
        negative = np.flatnonzero(shared[:, c] <= 0.0)
        end = int(negative[0]) if negative.size else longest
        counted[c] = 1.0 + 2.0 * float(shared[1:end, c].sum())
    return sigma, counted

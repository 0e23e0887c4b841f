"""Detect contacts from the fast part of the external torques.

A high-pass of `LASTING_S` removes what lasts: payloads and the model's errors in a pose. Without contact the
rest is noise of known standard deviation sigma. A Gaussian process with nu0 upward zero crossings per second
crosses a level u upward nu0 exp(-u^2 / 2 sigma^2) times a second (Rice 1945), which gives the level for a
rate of false alarms.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from module_agent.model.chain import Array

# What lasts longer than that is no blow.
LASTING_S = 0.8
# Of the largest that the known run has: another motion may be a little worse for the model.
MARGIN = 1.5
# Samples of 4 ms in a row: one alone is noise.
IN_A_ROW = 2
# It is over when all joints have been below the level for so long.
OVER_S = 0.25


class ContactModel(NamedTuple):
    """External torques without contact, (n,) each: standard deviation, maximum [Nm], upcrossings [Hz]."""

    sigma_nm: Array
    largest_nm: Array
    crossings_hz: Array

    def level_nm(self, alarms_per_hour: float) -> Array:
        """Return the levels (n,) that all joints together cross `alarms_per_hour` times without contact."""
        share = alarms_per_hour / (3600.0 * len(self.sigma_nm))
        # Up or down; and a level below two sigmas is none.
        ratio = np.maximum(2.0 * self.crossings_hz / share, np.e**2)
        by_noise = self.sigma_nm * np.sqrt(2.0 * np.log(ratio))
        return np.asarray(np.maximum(by_noise, MARGIN * self.largest_nm))


class Contact(NamedTuple):
    """Something touched the robot.

    joints: indices of those whose torque crossed its level. peak_nm: (n,) the largest torque of each, signed.
    end_ns: None as long as it lasts.
    """

    start_ns: int
    end_ns: int | None
    joints: tuple[int, ...]
    peak_nm: Array

    def strength(self, level_nm: Array) -> float:
        """How many times the level it was at its strongest."""
        return float(np.max(np.abs(self.peak_nm) / level_nm))


class FastPart:
    """The fast part of signals (m, n), sample by sample."""

    def __init__(self, rate_hz: float):
        self._keep = float(np.exp(-1.0 / (LASTING_S * rate_hz)))
        self._slow: Array | None = None

    def reset(self) -> None:
        """Begin anew."""
        self._slow = None

    def advance(self, signal: Array) -> Array:
        """Return the fast part of the next samples."""
        if self._slow is None:
            self._slow = signal[0].copy()
        share = 1.0 - self._keep
        slow, end = lfilter([share], [1.0, -self._keep], signal, axis=0, zi=(self._keep * self._slow)[None])
        self._slow = end[0] / self._keep
        return np.asarray(signal - slow)


def fast_part(signal: Array, rate_hz: float) -> Array:
    """Return the fast part of a whole signal."""
    return FastPart(rate_hz).advance(signal)


def contact_model(fast_nm: Array, rate_hz: float = 250.0) -> ContactModel:
    """Fit the model to the fast part (m, n) [Nm] of a run without contacts."""
    settled = fast_nm[round(LASTING_S * rate_hz) :]
    sigma = settled.std(axis=0)
    upward = (settled[:-1] < 0.0) & (settled[1:] >= 0.0)
    crossings = upward.sum(axis=0) * rate_hz / max(len(settled), 1)
    return ContactModel(sigma, np.abs(settled).max(axis=0), np.maximum(crossings, 0.1))


class ContactDetector:
    """Detects contacts in the fast part of the external torques, block by block."""

    def __init__(self, level_nm: Array):
        self.level_nm = level_nm
        self._above = np.zeros(len(level_nm), dtype=np.int64)
        self._now: Contact | None = None
        self._quiet_ns = 0

    def reset(self) -> Contact | None:
        """Begin anew; return the contact that this cuts off."""
        cut, self._now = self._now, None
        self._above[:] = 0
        return cut

    @property
    def now(self) -> Contact | None:
        """The contact that lasts."""
        return self._now

    def advance(self, t_ns: NDArray[np.int64], fast_nm: Array) -> list[Contact]:
        """Take the next samples, (m,) and (m, n); return contacts that begin or end in them."""
        findings = []
        for at_ns, sample in zip(t_ns, fast_nm, strict=True):
            at = int(at_ns)
            share = np.abs(sample) / self.level_nm
            self._above = np.where(share > 1.0, self._above + 1, 0)
            if self._now is None:
                if (self._above >= IN_A_ROW).any():
                    self._now = Contact(at, None, (), np.zeros_like(sample))
                    self._now = self._grown(self._now, sample)
                    findings.append(self._now)
                    self._quiet_ns = at
                continue
            self._now = self._grown(self._now, sample)
            if (share > 1.0).any():
                self._quiet_ns = at
            elif at - self._quiet_ns > OVER_S * 1e9:
                findings.append(self._now._replace(end_ns=self._quiet_ns))
                self._now = None
        return findings

    def _grown(self, contact: Contact, sample: Array) -> Contact:
        larger = np.abs(sample) > np.abs(contact.peak_nm)
        peak = np.where(larger, sample, contact.peak_nm)
        felt = tuple(int(k) for k in np.flatnonzero(np.abs(peak) > self.level_nm))
        return contact._replace(joints=felt, peak_nm=peak)

"""Detect contacts from the fast part of the external torques.

A high-pass of `LASTING_S` removes what lasts: payloads and the model's errors in a pose. Without contact the
rest is noise of known standard deviation sigma. A Gaussian process with nu0 upward zero crossings per second
crosses a level u upward nu0 exp(-u^2 / 2 sigma^2) times a second (Rice 1945), which gives the level for a
rate of false alarms.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coordinator.monitoring.momentum_observer import MomentumObserver
from coordinator.monitoring.segments import Block
from coordinator.synchronisation.motion_windows import RATE_HZ
from module_agent.model.chain import Array, Chain
from module_agent.signals.filtering import leaky_sum

# What lasts longer than that is no blow.
LASTING_S = 0.8
_KEEP = float(np.exp(-1.0 / (LASTING_S * RATE_HZ)))
# Of the largest that the known run has: another motion may be a little worse for the model.
MARGIN = 1.5
# Samples of 4 ms in a row: one alone is noise.
IN_A_ROW = 2
# It is over when all joints have been below the level for so long.
OVER_S = 0.25
# After a gap nothing is detected before the filters have settled.
_SETTLING_NS = 800_000_000
_RETAINED_NS = 20_000_000_000
# Share of an earlier load by which the changed model may be wrong, and for how long loads are remembered.
_LOADED_SHARE = 0.2
_REMEMBER_S = 10.0


class ContactModel(NamedTuple):
    """External torques without contact, (n,) each: standard deviation, maximum [Nm], upcrossings [Hz]."""

    sigma_nm: Array
    largest_nm: Array
    crossings_hz: Array

    def level_nm(self, alarms_per_hour: float) -> Array:
        """Return the levels (n,) that all joints together cross `alarms_per_hour` times without contact."""
        share = alarms_per_hour / (3600.0 * len(self.sigma_nm))
        # Up or down; and a level below two sigmas is none.
        ratio = np.maximum(2.0 * self.crossings_hz / share, math.e**2)
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

    def __init__(self) -> None:
        self._slow: Array | None = None

    def reset(self) -> None:
        """Begin anew."""
        self._slow = None

    def advance(self, signal: Array) -> Array:
        """Return the fast part of the next samples."""
        if self._slow is None:
            self._slow = signal[0].copy()
        slow = leaky_sum((1.0 - _KEEP) * signal, _KEEP, self._slow)
        self._slow = slow[-1]
        return np.asarray(signal - slow)


def contact_model(fast_nm: Sequence[Array]) -> ContactModel:
    """Fit the model to the fast parts (m, n) [Nm] of stretches without contacts.

    Each settles first; one at least is longer than that.
    """
    parts = [part[round(LASTING_S * RATE_HZ) :] for part in fast_nm]
    settled = np.concatenate(parts)
    upward = sum(((part[:-1] < 0.0) & (part[1:] >= 0.0)).sum(axis=0) for part in parts)
    crossings = upward * RATE_HZ / max(len(settled), 1)
    return ContactModel(settled.std(axis=0), np.abs(settled).max(axis=0), np.maximum(crossings, 0.1))


class ContactDetector:
    """Detects contacts in the fast part of the external torques, block by block; `now` is one that lasts."""

    def __init__(self, level_nm: Array):
        self.level_nm = level_nm
        self._above = np.zeros(len(level_nm), dtype=np.int64)
        self.now: Contact | None = None
        self._quiet_ns = 0

    def reset(self) -> None:
        """Begin anew."""
        self.now = None
        self._above[:] = 0

    def advance(self, t_ns: NDArray[np.int64], fast_nm: Array) -> list[Contact]:
        """Take the next samples, (m,) and (m, n); return contacts that begin or end in them."""
        if self.now is None and not (np.abs(fast_nm) > self.level_nm).any():
            self._above[:] = 0
            return []
        findings = []
        for at_ns, sample in zip(t_ns, fast_nm, strict=True):
            at = int(at_ns)
            share = np.abs(sample) / self.level_nm
            self._above = np.where(share > 1.0, self._above + 1, 0)
            if self.now is None:
                if (self._above >= IN_A_ROW).any():
                    self.now = self._grown(Contact(at, None, (), np.zeros_like(sample)), sample)
                    findings.append(self.now)
                    self._quiet_ns = at
                continue
            self.now = self._grown(self.now, sample)
            if (share > 1.0).any():
                self._quiet_ns = at
            elif at - self._quiet_ns > OVER_S * 1e9:
                findings.append(self.now._replace(end_ns=self._quiet_ns))
                self.now = None
        return findings

    def _grown(self, contact: Contact, sample: Array) -> Contact:
        larger = np.abs(sample) > np.abs(contact.peak_nm)
        peak = np.where(larger, sample, contact.peak_nm)
        felt = tuple(int(k) for k in np.flatnonzero(np.abs(peak) > self.level_nm))
        return contact._replace(joints=felt, peak_nm=peak)


class CollisionDetector:
    """Detects `contacts` of the last 20 s by momentum observer, high-pass and levels (n,) [Nm]."""

    def __init__(self, chain: Chain, phi: Array, level_nm: Array):
        self.contacts: list[Contact] = []
        self.outside_nm: Array | None = None
        self._chain = chain
        self._observer = MomentumObserver(chain, phi)
        self._fast = FastPart()
        self._level_nm = level_nm
        self._detector = ContactDetector(level_nm)
        # The largest of late, (n,).
        self._largest_nm = np.zeros_like(level_nm)
        self._settled_ns: int | None = None

    def reset(self) -> None:
        """Begin anew, after a hole."""
        self._observer.reset()
        self._fast.reset()
        self._detector.reset()
        self._settled_ns = None
        self.contacts = [c for c in self.contacts if c.end_ns is not None]

    def adapt(self, phi: Array) -> None:
        """Go on with other inertial parameters; a contact under way ends with that.

        The levels rise by a share of what the robot was loaded with when it was judged by the former ones.
        """
        self._observer = MomentumObserver(self._chain, phi)
        self._detector = ContactDetector(self._level_nm + _LOADED_SHARE * self._largest_nm)
        self.reset()

    def advance(self, block: Block) -> list[Contact]:
        """Return contacts that begin or end in a block."""
        outside = self._observer.advance(block.q_rad, block.qd_rad_s, block.tau_nm)
        self.outside_nm = outside[-1]
        forget = 1.0 - len(outside) / (RATE_HZ * _REMEMBER_S)
        self._largest_nm = np.maximum(np.abs(outside).max(axis=0), forget * self._largest_nm)
        fast = self._fast.advance(outside)
        if self._settled_ns is None:
            self._settled_ns = int(block.t_ns[0]) + _SETTLING_NS
        kept = block.t_ns >= self._settled_ns
        findings = self._detector.advance(block.t_ns[kept], fast[kept])
        for contact in findings:
            self.contacts = [*(c for c in self.contacts if c.start_ns != contact.start_ns), contact]
        oldest = int(block.t_ns[-1]) - _RETAINED_NS
        self.contacts = [c for c in self.contacts if c.end_ns is None or c.end_ns > oldest]
        return findings

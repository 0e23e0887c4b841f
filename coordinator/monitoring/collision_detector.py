"""From blocks to contacts: the momentum observer, its fast part, and the detector in a row."""

import numpy as np

from coordinator.monitoring.contact import Contact, ContactDetector, FastPart
from coordinator.monitoring.momentum_observer import MomentumObserver
from coordinator.monitoring.reference import Reference
from coordinator.monitoring.segments import Block
from coordinator.synchronisation.motion_windows import RATE_HZ
from module_agent.model.chain import Array

# What begins anew is not believed before it has settled.
_SETTLING_NS = 800_000_000
_RETAINED_NS = 20_000_000_000
# Of the torque that has come on: so much of it is no more exactly as the changed model has it.
_LOADED_SHARE = 0.2
_REMEMBER_S = 10.0


class CollisionDetector:
    """Who touches the robot: `contacts` of the last 20 s."""

    def __init__(self, reference: Reference, level_nm: Array):
        self.contacts: list[Contact] = []
        self.outside_nm: Array | None = None
        self._chain = reference.chain
        self._observer = MomentumObserver(reference.chain, reference.phi, RATE_HZ)
        self._fast = FastPart(RATE_HZ)
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
        self._observer = MomentumObserver(self._chain, phi, RATE_HZ)
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
            self.contacts = [c for c in self.contacts if c.start_ns != contact.start_ns]
            self.contacts.append(contact)
        oldest = int(block.t_ns[-1]) - _RETAINED_NS
        self.contacts = [c for c in self.contacts if c.end_ns is None or c.end_ns > oldest]
        return findings

"""Summary of a session of gravity compensation: range, speed and torque of every joint, in running sums."""

from typing import NamedTuple

import numpy as np

from module_agent.model.chain import Array


class JointSummary(NamedTuple):
    """A joint during compensation: start and end position, largest deviation, top speed and torques."""

    serial: str
    start_rad: float
    end_rad: float
    farthest_rad: float
    top_speed_rad_s: float
    effort_rms_nm: float
    effort_max_nm: float


class CompensationSummary(NamedTuple):
    """How a session ended: why, and whether by an exceeded limit.

    sent: set-points sent; missed: set-points that were due beyond those. joints is empty if the robot was not
    released.
    """

    why: str
    is_fault: bool
    compensated_s: float
    sent: int
    missed: int
    joints: tuple[JointSummary, ...]


class CompensationTally:
    """Accumulates the summary of n joints, moment by moment."""

    def __init__(self, serials: tuple[str, ...]):
        self._serials = serials
        self._start_s = self._end_s = 0.0
        self._start, self._end, self._farthest, self._fastest, self._squares, self._most = np.zeros(
            (6, len(serials))
        )
        self._count = 0
        self.sent = self.missed = 0

    @property
    def compensated_s(self) -> float:
        """How long gravity has been compensated so far."""
        return self._end_s - self._start_s

    def add(self, t_s: float, q_rad: Array, qd_rad_s: Array, effort_nm: Array) -> None:
        """Add a moment of compensation, (n,) each."""
        if not self._count:
            self._start_s, self._start = t_s, q_rad
        self._end_s, self._end = t_s, q_rad
        self._farthest = np.maximum(self._farthest, np.abs(q_rad - self._start))
        self._fastest = np.maximum(self._fastest, np.abs(qd_rad_s))
        self._most = np.maximum(self._most, np.abs(effort_nm))
        self._squares = self._squares + effort_nm**2
        self._count += 1

    def summary(self, why: str, is_fault: bool) -> CompensationSummary:
        """Return the summary."""
        rms = np.sqrt(self._squares / max(self._count, 1))
        rows = np.column_stack([self._start, self._end, self._farthest, self._fastest, rms, self._most])
        pairs = zip(self._serials, rows.tolist(), strict=True)
        joints = tuple(JointSummary(serial, *row) for serial, row in pairs) if self._count else ()
        return CompensationSummary(why, is_fault, self.compensated_s, self.sent, self.missed, joints)

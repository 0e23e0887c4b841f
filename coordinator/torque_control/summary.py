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
        self._began: tuple[float, Array] | None = None
        self._last: tuple[float, Array] = 0.0, np.zeros(len(serials))
        self._farthest, self._fastest, self._squares, self._most = np.zeros((4, len(serials)))
        self._count = 0
        self.sent = self.missed = 0

    @property
    def compensated_s(self) -> float:
        """How long gravity has been compensated so far."""
        return 0.0 if self._began is None else self._last[0] - self._began[0]

    def add(self, t_s: float, q_rad: Array, qd_rad_s: Array, effort_nm: Array) -> None:
        """Add a moment of compensation, (n,) each."""
        if self._began is None:
            self._began = t_s, q_rad
        self._last = t_s, q_rad
        self._farthest = np.maximum(self._farthest, np.abs(q_rad - self._began[1]))
        self._fastest = np.maximum(self._fastest, np.abs(qd_rad_s))
        self._most = np.maximum(self._most, np.abs(effort_nm))
        self._squares = self._squares + effort_nm**2
        self._count += 1

    def summary(self, why: str, is_fault: bool) -> CompensationSummary:
        """Return the summary."""
        if self._began is None:
            return CompensationSummary(why, is_fault, 0.0, self.sent, self.missed, ())
        columns = (
            self._began[1],
            self._last[1],
            self._farthest,
            self._fastest,
            np.sqrt(self._squares / self._count),
            self._most,
        )
        joints = tuple(
            JointSummary(serial, *(float(column[k]) for column in columns))
            for k, serial in enumerate(self._serials)
        )
        return CompensationSummary(why, is_fault, self.compensated_s, self.sent, self.missed, joints)

"""The rows of motions that an agent process keeps for its torque information, its own and other modules'.

A network drops feedback, so the rows of other modules are requested from their histories, which hold a
minute; rows kept here stay longer. No I/O: the requests to send are returned.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from module_agent.firmware.feedback import History
from module_agent.peers.motion_listener import MAX_MODULES, AskHistory, Fetch
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.information_messages import CollectRequest, RowRange
from module_agent.wire.messages import Feedback
from module_agent.wire.refusal import Refusal, WireError
from module_agent.wire.row_log import RowLog

GIVE_UP_NS = 30_000_000_000
# Of all motions of all modules together: 20 bytes each.
MAX_ROWS = 4_000_000
MAX_MOTIONS = 256
QUESTIONS_AT_ONCE = 8


class Track(NamedTuple):
    """Rows of one module in a motion: times of its own clock (m,), position (m,) and effort (m,)."""

    t_ns: NDArray[np.int64]
    position_rad: NDArray[np.float64]
    effort_nm: NDArray[np.float32]


class OwnRows(NamedTuple):
    """The rows of a module of this process, and the boot that they are of."""

    boot: int
    history: History


class _Part(Fetch):
    """The rows of one module in one motion, complete or on their way."""

    def __init__(self, wanted: RowRange, now_ns: int):
        super().__init__(wanted.serial, wanted.boot, now_ns, now_ns + GIVE_UP_NS)
        self.wanted = wanted
        self.track: Track | None = None
        self.asked: AskHistory | None = None
        self.lost = False

    @property
    def is_open(self) -> bool:
        return self.track is None and not self.lost

    def keep(self, rows: Rows) -> None:
        self.track = Track(*(rows[name].copy() for name in ("t_ns", "position_rad", "effort_nm")))
        self.log = RowLog(self.wanted.boot)

    def missing(self) -> list[tuple[int, int]]:
        return self.log.missing(self.wanted.first_row, self.wanted.end_row)


class MotionCollection:
    """Keeps motions by their number, which no two motions of a boot share, for all requesters alike.

    `has_work` says whether rows are still to be fetched, so that `poll` may return requests.
    """

    def __init__(self) -> None:
        self.has_work = False
        self._motions: dict[int, dict[str, _Part]] = {}
        self._open: list[_Part] = []

    def collect(self, request: CollectRequest, own: Mapping[str, OwnRows], now_ns: int) -> None:
        """Begin to keep a motion; rows of the process's `own` modules are copied from their histories.

        Rows of it that are kept already stay, unless their module has booted since: the histories may have
        dropped them. `now_ns` is any one steady clock of this process. A refused request changes nothing.

        Raises:
            WireError: GONE for own rows that are not kept, WRONG_BOOT for those of another boot, LIMIT for a
                motion of more modules or rows than are kept of all.
        """
        known = self._motions.get(request.motion_id, {})
        # All parts first, so that a refusal leaves no incomplete motion behind.
        parts = {
            wanted.serial: _begun(wanted, own.get(wanted.serial), now_ns)
            for wanted in request.rows
            if (kept := known.get(wanted.serial)) is None or kept.boot != wanted.boot or kept.lost
        }
        whole = known | parts
        if len(whole) > MAX_MODULES or _rows(whole) > MAX_ROWS:
            raise WireError(
                Refusal.LIMIT,
                f"motion {request.motion_id} would have {_rows(whole)} rows of {len(whole)} modules: "
                f"at most {MAX_ROWS} rows of {MAX_MODULES} modules are kept",
            )
        for serial in parts.keys() & known.keys():
            known[serial].lost = True
        self._motions.setdefault(request.motion_id, {}).update(parts)
        self._open += parts.values()
        self._forget()
        self.has_work = True

    def _forget(self) -> None:
        """Drop the oldest motions beyond the limits of motions and rows."""
        rows = sum(map(_rows, self._motions.values()))
        while len(self._motions) > MAX_MOTIONS or (len(self._motions) > 1 and rows > MAX_ROWS):
            oldest = self._motions.pop(next(iter(self._motions)))
            rows -= _rows(oldest)
            for part in oldest.values():
                part.lost = True

    def on_feedback(self, feedback: Feedback) -> None:
        """Take rows that some motion waits for."""
        first, end = feedback.first_row, feedback.first_row + feedback.count
        for part in self._open:
            wanted = part.wanted
            meant = part.is_open and (wanted.serial, wanted.boot) == (feedback.serial, feedback.boot)
            if not meant or first >= wanted.end_row or end <= wanted.first_row:
                continue
            part.log.add(feedback)
            part.asked_until_ns = 0
            if not part.missing():
                part.keep(part.log.rows(wanted.first_row, wanted.end_row))

    def on_lost(self, asked: AskHistory) -> None:
        """Mark the rows of a refused request as lost: the module no longer has them."""
        for part in self._open:
            if part.is_open and part.asked == asked:
                part.lost = True

    def poll(self, now_ns: int) -> list[AskHistory]:
        """Return the requests due now."""
        self._open = [part for part in self._open if part.is_open]
        self.has_work = bool(self._open)
        requests = []
        for part in self._open[:QUESTIONS_AT_ONCE]:
            if now_ns >= part.give_up_ns:
                part.lost = True
            elif question := part.question(part.missing()[0], now_ns):
                part.asked = question
                requests.append(question)
        return requests

    def tracks(self, motion_id: int) -> dict[str, Track]:
        """Return the rows of a motion by serial.

        Raises:
            WireError: BUSY while some are on their way; GONE if they never come, or the motion is not known.
        """
        parts = self._motions.get(motion_id)
        if parts is None:
            raise WireError(Refusal.GONE, f"motion {motion_id} was not collected here")
        lost = ", ".join(serial for serial, part in parts.items() if part.lost)
        if lost:
            raise WireError(Refusal.GONE, f"motion {motion_id}: rows of {lost[:200]} are gone")
        waiting = ", ".join(serial for serial, part in parts.items() if part.track is None)
        if waiting:
            raise WireError(Refusal.BUSY, f"motion {motion_id}: rows of {waiting[:200]} are on their way")
        return {serial: part.track for serial, part in parts.items() if part.track is not None}


def _begun(wanted: RowRange, own: OwnRows | None, now_ns: int) -> _Part:
    part = _Part(wanted, now_ns)
    if own is None:
        return part
    if own.boot != wanted.boot:
        raise WireError(
            Refusal.WRONG_BOOT,
            f"rows of boot {wanted.boot:016x} of {wanted.serial}, which has booted anew as {own.boot:016x}",
        )
    part.keep(own.history.rows(wanted.first_row, wanted.end_row))
    return part


def _rows(parts: Mapping[str, _Part]) -> int:
    return sum(part.wanted.end_row - part.wanted.first_row for part in parts.values())

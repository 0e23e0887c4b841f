"""The motions of all joints, collected for the modules of one agent process, which estimate from them.

A module announces its motion by its status, on `motion`. Its feedback is then subscribed to, and rows that
the network dropped are requested from its history. A complete motion goes to every module of the process. No
I/O: subscriptions and requests are returned as actions.
"""

from collections.abc import Mapping
from typing import NamedTuple

from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import (
    EXPLORATION_KINDS,
    MAX_BATCH_ROWS,
    MAX_ROWS_PER_MOTION,
    Feedback,
    MotionRecord,
    Status,
)
from module_agent.wire.refusal import Refusal, WireError
from module_agent.wire.row_log import RowLog

ANSWER_TIMEOUT_NS = 400_000_000
GIVE_UP_NS = 5_000_000_000
# One that moves its joints in a session is heard of more often; after this its place may be another's.
FORGET_NS = 60_000_000_000
ROWS_PER_QUESTION = 256
# Modules, and boots of them, whose announcements are remembered; more than any robot has.
MAX_MODULES, MAX_BOOTS = 256, 1024


class Listen(NamedTuple):
    """Subscribe to (or, with `on` false, leave) the feedback of a module."""

    serial: str
    on: bool


class AskHistory(NamedTuple):
    """Ask a module for feedback rows."""

    serial: str
    boot: int
    first_row: int
    end_row: int


Action = Listen | AskHistory


class Fetch:
    """Rows of one boot of a module on their way, what the network dropped asked for again."""

    def __init__(self, serial: str, boot: int, asked_until_ns: int, give_up_ns: int):
        self.serial = serial
        self.boot = boot
        self.log = RowLog(boot)
        self.asked_until_ns = asked_until_ns
        self.give_up_ns = give_up_ns

    def question(self, missing: tuple[int, int], now_ns: int) -> AskHistory | None:
        """Return the request for missing rows, None while the last one may still be answered."""
        if now_ns < self.asked_until_ns:
            return None
        self.asked_until_ns = now_ns + ANSWER_TIMEOUT_NS
        first, end = missing
        return AskHistory(self.serial, self.boot, first, min(end, first + ROWS_PER_QUESTION))


class JointMotion(NamedTuple):
    """A complete motion of one joint: its record and all its rows, and a rough mapping of its clock.

    `rough_offset_ns` per own module: own clock minus the joint's clock, too large by the network's delay.
    """

    serial: str
    boot: int
    record: MotionRecord
    rows: Rows
    rough_offset_ns: Mapping[str, int]


class _Track(Fetch):
    """One motion being collected."""

    def __init__(self, status: Status, record: MotionRecord, now_ns: int):
        super().__init__(status.serial, status.boot, 0, now_ns + GIVE_UP_NS)
        self.record = record
        self.offset_ns: dict[str, int] = {}

    def note_arrival(self, t_ns: int, own_ns: Mapping[str, int]) -> None:
        # The smallest difference belongs to the message with the smallest delay.
        for own, now_ns in own_ns.items():
            offset = now_ns - t_ns
            self.offset_ns[own] = min(self.offset_ns.get(own, offset), offset)


class MotionListener:
    """Collects exploration motions of all joints; `own_ns` maps own serials to their clocks now.

    `has_work` says whether `poll` may return anything: a message arrived since, or rows are missing.
    """

    def __init__(self) -> None:
        self.has_work = False
        self._tracks: dict[str, _Track] = {}
        self._finished: dict[str, tuple[int, int]] = {}
        self._actions: list[Action] = []
        self._boot: dict[str, int] = {}
        self._heard_ns: dict[str, int] = {}
        self._newest: dict[tuple[str, int], int] = {}

    def _is_outdated(self, status: Status) -> bool:
        """Return whether a later status or a later boot of this module has arrived."""
        newest = self._newest.get((status.serial, status.boot))
        # A module that was forgotten has no latest boot, but its numbers are remembered.
        latest = self._boot.get(status.serial, status.boot)
        if newest is not None and (latest != status.boot or status.seq <= newest):
            return True
        # The latest last, so that what is forgotten was not heard of for the longest time.
        self._boot.pop(status.serial, None)
        self._boot[status.serial] = status.boot
        self._newest.pop((status.serial, status.boot), None)
        self._newest[status.serial, status.boot] = status.seq
        if len(self._newest) > MAX_BOOTS:
            del self._newest[next(iter(self._newest))]
        return False

    def _forget_one(self, now_ns: int) -> bool:
        """Forget the module that was not heard of for the longest time, if that is long and it rests."""
        serial = next(iter(self._boot))
        if serial in self._tracks or now_ns - self._heard_ns[serial] < FORGET_NS:
            return False
        del self._boot[serial], self._heard_ns[serial]
        self._finished.pop(serial, None)
        return True

    def on_status(self, status: Status, now_ns: int, own_ns: Mapping[str, int]) -> None:
        """Take notice of a status; `now_ns` is any one steady clock of this process.

        Raises:
            WireError: LIMIT, it is of one module too many.
        """
        is_full = status.serial not in self._boot and len(self._boot) >= MAX_MODULES
        if is_full and not self._forget_one(now_ns):
            raise WireError(Refusal.LIMIT, f"{status.serial} is one module more than {MAX_MODULES}")
        if self._is_outdated(status):
            return
        self._heard_ns[status.serial] = now_ns
        self.has_work = True
        record = status.motion
        if record is None or record.pattern.kind not in EXPLORATION_KINDS:
            self._drop(status.serial)
            return
        if self._finished.get(status.serial) == (status.boot, record.motion_id):
            return
        if record.outcome not in ("running", "done"):
            self._drop(status.serial)
            return
        track = self._tracks.get(status.serial)
        if track is None or track.boot != status.boot or track.record.motion_id != record.motion_id:
            self._drop(status.serial)
            track = self._tracks[status.serial] = _Track(status, record, now_ns)
            self._actions.append(Listen(status.serial, True))
        if track.record.end_row is None:
            # From the last announcement without an end, and with it from when the end is known, so that
            # neither an end that never comes nor lost rows are waited for for ever.
            track.give_up_ns = now_ns + GIVE_UP_NS
        track.record = record
        track.note_arrival(status.t_ns, own_ns)

    def on_feedback(self, feedback: Feedback, own_ns: Mapping[str, int], live: bool = True) -> None:
        """Keep rows; `live` says that they were published, so that their arrival bounds the clock offset."""
        track = self._tracks.get(feedback.serial)
        if track is None or track.boot != feedback.boot:
            return
        # A motion without an end yet has at most as many rows as one that has ended.
        first = track.record.start_row
        if not first - MAX_BATCH_ROWS < feedback.first_row < first + MAX_ROWS_PER_MOTION:
            return
        self.has_work = True
        rows = track.log.add(feedback)
        if live and len(rows):
            track.note_arrival(int(rows["t_ns"][-1]), own_ns)
        if not live:
            track.asked_until_ns = 0

    def _drop(self, serial: str) -> None:
        if self._tracks.pop(serial, None) is not None:
            self._actions.append(Listen(serial, False))

    def poll(self, now_ns: int) -> tuple[list[Action], list[JointMotion]]:
        """Return the actions due now, and the motions that have become complete."""
        complete: list[JointMotion] = []
        for track in list(self._tracks.values()):
            end = track.record.end_row
            if end is None:
                if now_ns >= track.give_up_ns:
                    self._drop(track.serial)
                continue
            missing = track.log.missing(track.record.start_row, end)
            if not missing:
                rows = track.log.rows(track.record.start_row, end)
                complete.append(
                    JointMotion(track.serial, track.boot, track.record, rows, dict(track.offset_ns))
                )
            if not missing or now_ns >= track.give_up_ns:
                self._finished[track.serial] = (track.boot, track.record.motion_id)
                self._drop(track.serial)
            elif question := track.question(missing[0], now_ns):
                self._actions.append(question)
        self.has_work = any(track.record.end_row is not None for track in self._tracks.values())
        actions, self._actions = self._actions, []
        return actions, complete

"""What the modules of one agent process hear of whichever joint moves, so that each can estimate from it.

A joint that moves is noticed by its status; its feedback is then listened to, and whatever the network
dropped is asked for from its history. When the motion is complete it is handed to every module of the
process. Pure: what is to be sent or subscribed comes back as wishes.
"""

from collections.abc import Mapping
from typing import NamedTuple

from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import Feedback, MotionRecord, Status
from module_agent.wire.row_log import RowLog

EXPLORATION_KINDS = ("constant", "windowed_sine")
ANSWER_TIMEOUT_NS = 400_000_000
GIVE_UP_NS = 5_000_000_000
ROWS_PER_QUESTION = 256


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


Wish = Listen | AskHistory


class JointMotion(NamedTuple):
    """A complete motion of one joint: its record and all its rows, and a rough mapping of its clock.

    `rough_offset_ns` per own module: own clock minus the joint's clock, too large by the delay of the
    network.
    """

    serial: str
    boot: int
    record: MotionRecord
    rows: Rows
    rough_offset_ns: Mapping[str, int]


class _Track:
    """One motion being collected."""

    def __init__(self, status: Status, record: MotionRecord, now_ns: int):
        self.serial = status.serial
        self.boot = status.boot
        self.record = record
        self.log = RowLog(status.boot)
        self.offset_ns: dict[str, int] = {}
        self.asked_until_ns = 0
        self.give_up_ns = now_ns + GIVE_UP_NS

    def note_arrival(self, t_ns: int, own_ns: Mapping[str, int]) -> None:
        # The smallest difference is that of the message that was least delayed.
        for own, now_ns in own_ns.items():
            offset = now_ns - t_ns
            self.offset_ns[own] = min(self.offset_ns.get(own, offset), offset)


class MotionListener:
    """Collects exploration motions of all joints; `own_ns` maps own serials to their clocks now.

    `restless` says whether `poll` may have anything to say: something was heard since, or rows are missing.
    """

    def __init__(self) -> None:
        self.restless = False
        self._tracks: dict[str, _Track] = {}
        self._finished: dict[str, tuple[int, int]] = {}
        self._wishes: list[Wish] = []
        self._boot: dict[str, int] = {}
        self._newest: dict[tuple[str, int], int] = {}

    def _late(self, status: Status) -> bool:
        """Return whether something newer of this module was heard: a later status, or a later boot."""
        newest = self._newest.get((status.serial, status.boot))
        if newest is not None and (self._boot[status.serial] != status.boot or status.seq <= newest):
            return True
        self._boot[status.serial] = status.boot
        self._newest[status.serial, status.boot] = status.seq
        return False

    def on_status(self, status: Status, now_ns: int, own_ns: Mapping[str, int]) -> None:
        """Take notice of a status; `now_ns` is any one steady clock of this process."""
        if self._late(status):
            return
        self.restless = True
        record = status.motion
        if record is None or record.pattern.kind not in EXPLORATION_KINDS:
            self._drop(status.serial)
            return
        if self._finished.get(status.serial) == (status.boot, record.motion_id):
            return
        track = self._tracks.get(status.serial)
        if track is None or track.boot != status.boot or track.record.motion_id != record.motion_id:
            self._drop(status.serial)
            if record.outcome not in ("running", "done"):
                return
            track = self._tracks[status.serial] = _Track(status, record, now_ns)
            self._wishes.append(Listen(status.serial, True))
        if record.outcome not in ("running", "done"):
            self._drop(status.serial)
            return
        if track.record.end_row is None:
            # Counted from when the end is known: rows that are gone are not to be asked for for ever.
            track.give_up_ns = now_ns + GIVE_UP_NS
        track.record = record
        track.note_arrival(status.t_ns, own_ns)

    def on_feedback(self, feedback: Feedback, own_ns: Mapping[str, int], live: bool = True) -> None:
        """Keep rows; `live` says that they come as published, so that their age tells the clocks apart."""
        track = self._tracks.get(feedback.serial)
        if track is None or track.boot != feedback.boot:
            return
        self.restless = True
        rows = track.log.add(feedback)
        if live and len(rows):
            track.note_arrival(int(rows["t_ns"][-1]), own_ns)
        if not live:
            track.asked_until_ns = 0

    def _drop(self, serial: str) -> None:
        if self._tracks.pop(serial, None) is not None:
            self._wishes.append(Listen(serial, False))

    def poll(self, now_ns: int) -> tuple[list[Wish], list[JointMotion]]:
        """Return what to send or subscribe now, and the motions that have become complete."""
        complete: list[JointMotion] = []
        for track in list(self._tracks.values()):
            end = track.record.end_row
            if end is None:
                continue
            missing = track.log.missing(track.record.start_row, end)
            if not missing:
                rows = track.log.rows(track.record.start_row, end)
                complete.append(
                    JointMotion(track.serial, track.boot, track.record, rows, dict(track.offset_ns))
                )
                self._finished[track.serial] = (track.boot, track.record.motion_id)
                self._drop(track.serial)
            elif now_ns >= track.give_up_ns:
                self._finished[track.serial] = (track.boot, track.record.motion_id)
                self._drop(track.serial)
            elif now_ns >= track.asked_until_ns:
                first, stop = missing[0]
                track.asked_until_ns = now_ns + ANSWER_TIMEOUT_NS
                self._wishes.append(
                    AskHistory(track.serial, track.boot, first, min(stop, first + ROWS_PER_QUESTION))
                )
        self.restless = any(track.record.end_row is not None for track in self._tracks.values())
        wishes, self._wishes = self._wishes, []
        return wishes, complete

"""All modules of one robot under one sender's leases: presence, motions, complete recordings."""

import asyncio
from collections.abc import Callable, Container, Mapping, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

from coordinator.live_robot.backfill import RowCompletion
from coordinator.live_robot.commander import ATTEMPTS, POLL_S, SILENT_NS, Commander
from coordinator.live_robot.errors import ModuleLost, MotionInterrupted, RobotStopped
from coordinator.live_robot.messenger import Clock, Messenger, NoAnswer, Refused, Sender, gather_all
from coordinator.recording.recording import ModuleRecord, Recording
from module_agent.control.waveform import duration_s
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.wire.keys import Leaf
from module_agent.wire.messages import (
    Ack,
    Ask,
    EffortProfile,
    Estimate,
    EstimateRequest,
    GainsCommand,
    GainSet,
    HistoryRequest,
    Info,
    Message,
    MotionCommand,
    MotionRecord,
    Pattern,
    Setpoint,
    Status,
)
from module_agent.wire.refusal import Refusal

TOKEN_GONE_NS = 300_000_000
# Refusals of a motion that re-arming resolves. If every attempt is refused by SEQUENCE, the motion has ended
# already: it had begun, and the answer and the keep-alives were lost.
UNSTARTED = (Refusal.NOT_ARMED.value, Refusal.NO_LEASE.value, Refusal.SEQUENCE.value)

Gate = Callable[[Mapping[str, Pattern], Mapping[str, float]], None]
"""Raises `MotionForbidden` against motions that modules are to begin together from positions [rad] of all."""

M = TypeVar("M", bound=Message)


class _Started(NamedTuple):
    """A motion that was commanded to a module."""

    number: int
    pattern: Pattern
    effort: EffortProfile | None


class ModuleGroup:
    """Commands to the modules of one robot under this sender's leases.

    Every motion passes the `gate`, if there is one, before any of it is commanded.
    """

    def __init__(
        self,
        messenger: Messenger,
        recording: Recording,
        clock: Clock,
        sender: Sender,
        gate: Gate | None = None,
    ):
        self._gate = gate
        self.serials: tuple[str, ...] = ()
        self.commander = Commander(messenger, recording, clock, sender, self.check)
        self._messenger = messenger
        self._recording = recording
        self._clock = clock
        self._rows: dict[str, RowCompletion] = {}
        self._last_id = 0
        self._streams: set[str] = set()

    # ------------------------------------------------------------------ presence and state

    def module(self, serial: str) -> ModuleRecord:
        """Return the record of a module."""
        return self._recording.modules[serial]

    def kind(self, serial: str) -> ModuleType:
        """Return the catalogue entry of a module.

        Raises:
            KeyError: the catalogue does not have the type that the module reports.
        """
        return module_type(self.info(serial).module_type)

    def info(self, serial: str) -> Info:
        """Return a module's own description: type, limits, gains."""
        info = self.module(serial).info
        if info is None:
            again = any(record.info for (each, _), record in self._recording.past.items() if each == serial)
            since = " since it booted anew, or a second module has its serial" if again else ""
            raise NoAnswer(serial, Leaf.INFO, f"it has not told its type{since}")
        return info

    async def meet(self, serials: Sequence[str]) -> None:
        """Request every module's description, and note its boot."""
        for serial in serials:
            info = await self._ask(serial, Leaf.INFO, Info)
            self.commander.boots[serial] = info.boot
            log = self.module(serial).rows
            self._rows[serial] = RowCompletion(log, partial(self._fetch, serial))
        self.serials = tuple(serials)

    def position_rad(self, serial: str) -> float | None:
        """Return the latest position of a joint; None before any feedback."""
        log = self.module(serial).rows
        rows = log.rows(log.end_row - 1, log.end_row)
        return float(rows["position_rad"][-1]) if len(rows) else None

    def without_feedback(self) -> list[str]:
        """Return the serials of the modules whose feedback has not been received yet."""
        return [serial for serial in self.serials if self.module(serial).feedback_ns is None]

    async def ask_status(self, serial: str) -> Status:
        """Return the present status of a module; also one round trip for its clock."""
        return await self._ask(serial, Leaf.STATUS, Status)

    async def _ask(self, serial: str, leaf: Leaf, expected: type[M]) -> M:
        answer = await self.commander.persist(
            serial, lambda: self._messenger.ask(serial, leaf, self.commander.request(Ask, serial))
        )
        if isinstance(answer, Ack) and not answer.accepted:
            raise NoAnswer(serial, leaf, f"it refuses: {answer.reason}: {answer.detail}")
        if not isinstance(answer, expected):
            raise NoAnswer(serial, leaf, f"its answer is {type(answer).__name__}")
        return answer

    def check(self) -> None:
        """Check that every module is still present and held.

        Raises:
            ModuleLost: its token or feedback is missing, it has booted again, its lease was taken, or it
                follows set-points of another program that has the secret of the lease.
            RecordingFull: its feedback cannot be kept any more.
            RobotStopped: a module that this sender holds was stopped.
        """
        # First: rows that are not kept look like silence.
        self._recording.check_room(self.serials)
        now = self._clock()
        for serial in self.serials:
            record = self.module(serial)
            if record.boot != self.commander.boots[serial]:
                raise ModuleLost(serial, "it has booted anew")
            silent_ns = 0 if record.feedback_ns is None else now - record.feedback_ns
            if serial not in self._messenger.alive and silent_ns > TOKEN_GONE_NS:
                raise ModuleLost(serial, "its agent has left the network")
            if silent_ns > SILENT_NS:
                raise ModuleLost(
                    serial,
                    f"no feedback for {silent_ns / 1e9:.1f} s{_trouble(self.status_under_lease(serial))}",
                )
            self.commander.check_lease(serial)
            status = self.status_under_lease(serial)
            if status is not None and status.state == "stopped":
                raise RobotStopped(serial, status.note)
            if status is not None and status.state == "streaming" and serial not in self._streams:
                raise ModuleLost(serial, "it follows set-points of another program, which has its secret")

    def status_under_lease(self, serial: str) -> Status | None:
        """Return the status; None before the lease, as it may report an earlier stop or expiry."""
        status, armed_ns = self.module(serial).status, self.commander.armed_ns(serial)
        fresh = status is not None and armed_ns is not None and status.t_ns > armed_ns
        return status if fresh else None

    async def check_now(self) -> None:
        """Request every module's status, then `check`."""
        for serial in self.serials:
            await self.ask_status(serial)
        self.check()

    async def wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until a condition holds; False when the time is up.

        Raises:
            ModuleLost: see `check`.
        """
        end = self._clock() + int(timeout_s * 1e9)
        while not condition():
            self.check()
            if self._clock() >= end:
                return False
            await asyncio.sleep(POLL_S)
        return True

    @property
    def is_poor(self) -> bool:
        """Whether keep-alives were late or lost within the last seconds."""
        return self.commander.is_poor

    # ------------------------------------------------------------------ leases

    async def acquire_all(self) -> None:
        """Take the leases of all modules; see `acquire`."""
        await self.acquire(*self.serials)

    async def acquire(self, *serials: str) -> None:
        """Take the leases of modules, which arms them; they are renewed until given back.

        Raises:
            Refused: another sender holds one; the message names the holder and the time left. The others are
                held.
        """
        await gather_all(self.commander.acquire(serial) for serial in serials)

    def forget_lease(self, serial: str) -> None:
        """Renew the lease of a module no more, which lapses then, and expect nothing of it."""
        self.commander.forget(serial)

    async def release_all(self) -> None:
        """Release all modules; their motors are off then."""
        await self.commander.release_all()

    async def stop_all(self, why: str) -> list[str]:
        """Stop every module that this sender holds; return the serials that did not confirm."""
        return await self.commander.stop_all(why)

    # ------------------------------------------------------------------ motions

    async def set_gains(self, serial: str, gains: GainSet, keep: bool = False) -> None:
        """Replace a module's gains, until the end of the lease or, to `keep`, of its boot."""
        await self.commander.achieve(
            serial, Leaf.GAINS, lambda: self.commander.command(GainsCommand, serial, gains=gains, keep=keep)
        )

    def stream(
        self, serial: str, position_rad: float | None, velocity_rad_s: float | None, effort_nm: float | None
    ) -> None:
        """Send one set-point, which is not acknowledged; None switches a loop off."""
        # The set-point replaces the last motion, which must not be commanded again.
        self.commander.repeat_no_more(serial)
        self._streams.add(serial)
        point = {"position_rad": position_rad, "velocity_rad_s": velocity_rad_s, "effort_nm": effort_nm}
        self.commander.publish(serial, Leaf.SETPOINT, self.commander.command(Setpoint, serial, **point))

    def _next_id(self) -> int:
        # Numbers grow from one coordinator to the next, so that none repeats.
        clock_ms = self._clock() // 1_000_000 & 0x3FFFFFFF
        self._last_id = max(self._last_id + 1, clock_ms)
        return self._last_id

    async def run(
        self, patterns: Mapping[str, Pattern], efforts: Mapping[str, EffortProfile] | None = None
    ) -> dict[str, MotionRecord]:
        """Run one motion on each of the given modules at the same time; return their records.

        `efforts` are fed forward along the motions of their modules; the effort loops of the others are off.

        Raises:
            KeyError: efforts of a module that has no motion.
            MotionForbidden: the gate does not let the motions pass.
            MotionInterrupted: one of them expired or was stopped, or another held module expired meanwhile.
            ModuleLost: see `check`.
        """
        fed = efforts or {}
        if self._gate is not None:
            self._gate(patterns, {s: q for s in self.serials if (q := self.position_rad(s)) is not None})
        if idle := [serial for serial in fed if serial not in patterns]:
            raise KeyError(
                f"efforts for {idle[0]}, which has no motion; of those that have one: {', '.join(patterns)}"
            )
        started = {s: _Started(self._next_id(), pattern, fed.get(s)) for s, pattern in patterns.items()}
        stood_rad = {serial: self.position_rad(serial) or 0.0 for serial in patterns}
        await gather_all(self._start(serial, motion) for serial, motion in started.items())
        # Where the last other joint has been excluded, nothing is left to move.
        durations_s = [duration_s(pattern, stood_rad[serial]) for serial, pattern in patterns.items()]
        longest = max(durations_s, default=0.0)
        ended = await self.wait(
            lambda: (
                all(self._ended(serial, motion.number) for serial, motion in started.items())
                or self._expired(started) is not None
            ),
            longest + 3.0,
        )
        if self.is_poor:
            # The status of a module that expired may itself be lost.
            await gather_all(self.ask_status(serial) for serial in self.commander.held)
        if (expired := self._expired(started)) is not None:
            raise MotionInterrupted(
                next(iter(patterns)), f"interrupted: module {expired} expired and released its joint"
            )
        records: dict[str, MotionRecord] = {}
        for serial in started:
            status = self.module(serial).status if ended else await self.ask_status(serial)
            motion = status.motion if status is not None else None
            if motion is None or motion.motion_id != started[serial].number or motion.outcome != "done":
                raise MotionInterrupted(serial, _unfinished(status))
            records[serial] = motion
        return records

    def running(self, serial: str) -> MotionRecord | None:
        """Return the motion that a module says it is running, up to its newest row; None if there is none."""
        status, end_row = self.module(serial).status, self.module(serial).rows.end_row
        motion = status.motion if status is not None else None
        if motion is None or motion.outcome != "running" or end_row <= motion.start_row:
            return None
        return motion.model_copy(update={"end_row": end_row})

    def _expired(self, moved: Container[str]) -> str | None:
        """Return a held module without a motion that has expired meanwhile."""
        for serial in self.commander.held:
            status = self.status_under_lease(serial)
            if serial not in moved and status is not None and status.state == "expired":
                return serial
        return None

    def _ended(self, serial: str, number: int) -> bool:
        status = self.status_under_lease(serial)
        if status is None:
            return False
        motion = status.motion
        if motion is None or motion.motion_id != number:
            return status.state in ("expired", "stopped", "fault", "idle")
        return motion.outcome != "running"

    def _motion(self, serial: str, motion: _Started) -> MotionCommand:
        what = {"motion_id": motion.number, "pattern": motion.pattern, "effort": motion.effort}
        return self.commander.command(MotionCommand, serial, **what)

    async def _start(self, serial: str, motion: _Started) -> None:
        self.commander.repeat_no_more(serial)
        command = partial(self._motion, serial, motion)
        try:
            await self.commander.achieve(serial, Leaf.MOTION, command)
            # It begins no motion twice.
            self.commander.repeat(serial, Leaf.MOTION, command)
        except Refused as refused:
            if refused.ack.reason in UNSTARTED:
                trouble = _trouble(await self.ask_status(serial))
                raise MotionInterrupted(serial, f"refused: {refused.ack.detail}{trouble}") from refused
            raise

    # ------------------------------------------------------------------ recordings

    async def complete_rows(self) -> None:
        """Fetch the feedback rows that the network has lost, of every module, up to now."""
        await gather_all(self._complete_now(serial) for serial in self.serials)

    async def _complete_now(self, serial: str) -> None:
        status = await self.ask_status(serial)
        await self._rows[serial].complete(status.next_row)

    async def close_gaps(self) -> None:
        """Fetch the rows missing before the newest of every module that has arrived.

        None is missing on return, until the caller next yields to the event loop.
        """
        for _ in range(ATTEMPTS):
            ends = {serial: self.module(serial).rows.end_row for serial in self.serials}
            gaps = [serial for serial, end in ends.items() if self._rows[serial].has_gap(end)]
            if not gaps:
                return
            await gather_all(self._rows[serial].complete(ends[serial]) for serial in gaps)

    async def _fetch(self, serial: str, first: int, end: int) -> None:
        """Request rows until they, or a refusal, have come."""
        what = {"boot": self.commander.boots[serial], "first_row": first, "end_row": end}

        async def attempt() -> None:
            request = self.commander.request(HistoryRequest, serial, **what)
            answer = await self._messenger.ask(serial, Leaf.HISTORY, request)
            if isinstance(answer, Ack):
                raise Refused(serial, Leaf.HISTORY, answer)

        await self.commander.persist(serial, attempt)

    async def estimate(self, observer: str, joint: str, motion_id: int, timeout_s: float) -> Estimate | None:
        """Wait for the observer's estimate of a motion, requested again if lost; None if there is none."""

        def received() -> Estimate | None:
            of_joint = self._recording.estimates.get((joint, observer), {})
            return next((one for ids, one in of_joint.items() if motion_id in ids), None)

        if await self.wait(lambda: received() is not None, timeout_s):
            return received()
        for _ in range(ATTEMPTS):
            try:
                await self._messenger.ask(
                    observer, Leaf.ESTIMATE, self.commander.request(EstimateRequest, observer, joint=joint)
                )
            except NoAnswer:
                self.check()
            if await self.wait(lambda: received() is not None, 0.3):
                break
        return received()


def _trouble(status: Status | None) -> str:
    """Return what a module says is wrong with it, to be added to a sentence."""
    if status is None or status.state not in ("fault", "expired") or not status.note:
        return ""
    return f"; it says: {status.note}"


def _unfinished(status: Status | None) -> str:
    motion = status.motion if status is not None else None
    if status is None or motion is None:
        return "lost"
    if motion.outcome == "running":
        return "still running 3 s after its end: the module, or a simulated world, is slower than real time"
    if motion.outcome == "fault":
        # Once its lease is acquired anew, a module says no more what was wrong.
        return f"ended by its protection{f': {status.note}' if status.state == 'fault' else ''}"
    return motion.outcome

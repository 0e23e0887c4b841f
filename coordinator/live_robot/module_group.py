"""All modules of one robot under one sender's leases: keep-alives, motions, complete recordings."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Container, Coroutine, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

from coordinator.live_robot.backfill import RowCompletion
from coordinator.live_robot.errors import ModuleLost, MotionInterrupted, RobotStopped
from coordinator.live_robot.messenger import Clock, Messenger, NoAnswer, Refused, Sender, gather_all
from coordinator.recording.recording import ModuleRecord, Recording
from module_agent.control.waveform import duration_s
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.model.errors import RobotError
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
    LeaseRequest,
    Message,
    MotionCommand,
    MotionRecord,
    Pattern,
    Setpoint,
    Status,
)
from module_agent.wire.refusal import Refusal

POLL_S = 0.02
# Four keep-alives within the default lifetime of 250 ms.
KEEP_ALIVE_S = 0.06
# So many modules are asked to answer each keep-alive: a lost lease shows at once, and the answer is a round
# trip for the module's clock. Question and answer cost five times what a publication does, so that of more
# modules these are asked in turn, and all others are told.
ANSWERED = 8
# A renewal that takes longer, or is lost, marks the network as poor for a while.
LATE_NS = 100_000_000
POOR_NS = 10_000_000_000
LEASE_NS = 1_000_000_000
ATTEMPTS = 8
SILENT_NS = 1_000_000_000
TOKEN_GONE_NS = 300_000_000
# Refusals that the next attempt can resolve: it carries a newer echo and a newer sequence number.
PASSING = (Refusal.STALE.value, Refusal.SEQUENCE.value)
# Refusals of a motion that re-arming resolves. If every attempt is refused by SEQUENCE, the motion has ended
# already: it had begun, and the answer and the keep-alives were lost.
UNSTARTED = (Refusal.NOT_ARMED.value, Refusal.NO_LEASE.value, Refusal.SEQUENCE.value)

Gate = Callable[[Mapping[str, Pattern], Mapping[str, float]], None]
"""Raises `MotionForbidden` against motions that modules are to begin together from positions [rad] of all."""

T = TypeVar("T")
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
        self.sender, self._secret = sender
        self._messenger = messenger
        self._recording = recording
        self._clock = clock
        self._tokens: dict[str, int] = {}
        self._boots: dict[str, int] = {}
        self._armed_ns: dict[str, int] = {}
        self._rows: dict[str, RowCompletion] = {}
        self._last_id = 0
        self._renewals: set[asyncio.Task[None]] = set()
        self._turn = 0
        self._taken_by: dict[str, str] = {}
        self._running: dict[str, _Started] = {}
        self._streams: set[str] = set()
        self._poor_until_ns = 0

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
            self._boots[serial] = info.boot
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
        answer = await self._persist(
            serial, lambda: self._messenger.ask(serial, leaf, self._request(Ask, serial))
        )
        if isinstance(answer, Ack) and not answer.accepted:
            raise NoAnswer(serial, leaf, f"it refuses: {answer.reason}: {answer.detail}")
        if not isinstance(answer, expected):
            raise NoAnswer(serial, leaf, f"its answer is {type(answer).__name__}")
        return answer

    def _request(self, kind: type[M], serial: str, **fields: Any) -> M:
        """Return a message that needs no lease, by default to whatever boot of the module is there."""
        head = {"serial": serial, "boot": 0, "seq": self._messenger.next_seq(), "sender": self.sender}
        return kind.model_validate(head | fields)

    def _command(self, kind: type[M], serial: str, **fields: Any) -> M:
        """Return a command under the lease; it echoes the newest module time."""
        head = {
            "boot": self._boots[serial],
            "token": self._tokens.get(serial, 0),
            "echo_ns": self.module(serial).newest_ns,
        }
        return self._request(kind, serial, **head, **fields)

    def _lease(self, serial: str, action: str) -> LeaseRequest:
        # No other program hears an acquisition; renewals are proven like every other command.
        secret = self._secret if action == "acquire" else b""
        return self._command(LeaseRequest, serial, action=action, duration_ns=LEASE_NS, secret=secret)

    async def _commanded(self, serial: str, leaf: Leaf, command: Message, timeout_s: float = 0.5) -> Ack:
        """Send a command under the lease, with the proof that it is this sender's."""
        return await self._messenger.command(serial, leaf, command, timeout_s, self._secret)

    async def _achieve(self, serial: str, leaf: Leaf, command: Callable[[], Message]) -> Ack:
        """Send commands, each made anew, until one is acknowledged."""
        return await self._persist(serial, lambda: self._commanded(serial, leaf, command()))

    async def _persist(self, serial: str, attempt: Callable[[], Awaitable[T]]) -> T:
        """Try until answered; a network may lose requests and answers."""
        for left in reversed(range(ATTEMPTS)):
            try:
                return await attempt()
            except NoAnswer:
                self.check()
                if not left:
                    # Of an agent that has died the network says at once that none answers, many times before
                    # its silence shows.
                    await self.wait(lambda: False, 1e-9 * SILENT_NS + POLL_S)
                    raise
            except Refused as refused:
                if refused.ack.reason not in PASSING or not left:
                    raise
                # The echo is renewed by the next feedback.
                await asyncio.sleep(POLL_S)
        raise AssertionError("unreachable")

    def check(self) -> None:
        """Check that every module is still present and held.

        Raises:
            ModuleLost: its token or feedback is missing, it has booted again, its lease was taken, or it
                follows set-points of another program that has the secret of the lease.
            RobotStopped: a module that this sender holds was stopped.
        """
        now = self._clock()
        for serial in self.serials:
            record = self.module(serial)
            if record.boot != self._boots[serial]:
                raise ModuleLost(serial, "it has booted anew")
            silent_ns = 0 if record.feedback_ns is None else now - record.feedback_ns
            if serial not in self._messenger.alive and silent_ns > TOKEN_GONE_NS:
                raise ModuleLost(serial, "its agent has left the network")
            if silent_ns > SILENT_NS:
                raise ModuleLost(serial, f"no feedback for {silent_ns / 1e9:.1f} s")
            if serial in self._taken_by:
                raise ModuleLost(serial, f"its lease was taken: {self._taken_by[serial]}")
            status = self.status_under_lease(serial)
            if status is not None and status.state == "stopped":
                raise RobotStopped(serial, status.note)
            if status is not None and status.state == "streaming" and serial not in self._streams:
                raise ModuleLost(serial, "it follows set-points of another program, which has its secret")

    def status_under_lease(self, serial: str) -> Status | None:
        """Return the status; None before the lease, as it may report an earlier stop or expiry."""
        status = self.module(serial).status
        fresh = status is not None and serial in self._tokens and status.t_ns > self._armed_ns[serial]
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
        """Whether renewals were late or lost within the last `POOR_NS`."""
        return self._clock() < self._poor_until_ns

    # ------------------------------------------------------------------ leases

    async def acquire(self, serial: str) -> None:
        """Take the lease of a module and arm it.

        Raises:
            Refused: another sender holds it; the message names the holder and the time left.
        """
        self._running.pop(serial, None)
        try:
            ack = await self._achieve(serial, Leaf.LEASE, lambda: self._lease(serial, "acquire"))
        except Refused as refused:
            # One that was this sender's must not be stopped as if it still were.
            if refused.ack.reason == Refusal.HELD.value and serial in self._tokens:
                self._taken_by[serial] = refused.ack.detail
            raise
        self._taken_by.pop(serial, None)
        self._tokens[serial], self._armed_ns[serial] = ack.token, ack.t_ns
        # Its lifetime counts from the echo in the request: on a slow network little of it is left.
        self._send(self._renew(serial))

    def forget_lease(self, serial: str) -> None:
        """Renew the lease of a module no more, which lapses then, and expect nothing of it."""
        self._tokens.pop(serial, None)

    async def keep_alive(self) -> None:
        """Renew all leases until cancelled; a late answer does not hold up the next renewal.

        While renewals are late or lost, running motions of the modules that were asked are commanded again in
        between, which renews the lease too: messages keep their order on one key, and are seldom late on two
        keys at the same time.
        """
        while True:
            self.renew()
            await asyncio.sleep(0.5 * KEEP_ALIVE_S)
            if self.is_poor:
                self._renew_by(self._repeat_or_renew)
            await asyncio.sleep(0.5 * KEEP_ALIVE_S)

    def renew(self) -> None:
        """Renew all leases once; needed every `KEEP_ALIVE_S` without `keep_alive`."""
        self._turn += ANSWERED
        self._renew_by(self._renew)

    def _renew_by(self, ask: Callable[[str], Coroutine[None, None, None]]) -> None:
        """Renew all leases: of the `ANSWERED` modules whose turn it is by what `ask` returns."""
        held = list(self._tokens)
        begin = self._turn % len(held) if len(held) > ANSWERED else 0
        in_turn = held[begin:] + held[:begin]
        for serial in in_turn[:ANSWERED]:
            self._send(ask(serial))
        for serial in in_turn[ANSWERED:]:
            # One that fails must not end those of the others, which follow for as long as the leases last.
            with contextlib.suppress(RobotError):
                self._messenger.publish(serial, Leaf.LEASE, self._lease(serial, "renew"), self._secret)

    def _send(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.create_task(work)
        self._renewals.add(task)
        task.add_done_callback(self._renewals.discard)

    async def _renew(self, serial: str) -> None:
        sent_ns = self._clock()
        try:
            await self._commanded(serial, Leaf.LEASE, self._lease(serial, "renew"), timeout_s=0.3)
        except NoAnswer:
            pass  # lost; the next one follows, and `check` notices missing feedback
        except Refused as refused:
            if refused.ack.reason == Refusal.HELD.value:
                self._taken_by[serial] = refused.ack.detail
        if self._clock() - sent_ns > LATE_NS:
            self._poor_until_ns = self._clock() + POOR_NS

    def _repeat_or_renew(self, serial: str) -> Coroutine[None, None, None]:
        return (self._repeat if serial in self._running else self._renew)(serial)

    async def _repeat(self, serial: str) -> None:
        """Command a module's latest motion again; a module begins no motion twice."""
        running = self._running.get(serial)
        if running is None:
            return
        # Lost or refused: the next renewal follows.
        with contextlib.suppress(NoAnswer, Refused):
            await self._commanded(serial, Leaf.MOTION, self._motion(serial, running), timeout_s=0.3)

    async def release_all(self) -> None:
        """Release all modules; their motors are off then."""
        await gather_all(self._release(serial) for serial in list(self._tokens))

    async def _release(self, serial: str) -> None:
        try:
            await self._achieve(serial, Leaf.LEASE, lambda: self._lease(serial, "release"))
        except Refused as refused:
            # The first answer may have been lost: then there is nothing left to release.
            if refused.ack.reason not in (Refusal.NO_LEASE.value, Refusal.HELD.value):
                raise
        self._tokens.pop(serial, None)

    async def stop_all(self, why: str) -> list[str]:
        """Stop every module that this sender holds; return the serials that did not confirm."""
        # Not the modules whose lease another coordinator has taken.
        held = [serial for serial in self._tokens if serial not in self._taken_by]
        self._tokens.clear()
        stops = (self._messenger.stop(serial, self.sender, why) for serial in held)
        done = await asyncio.gather(*stops, return_exceptions=True)
        return [s for s, r in zip(held, done, strict=True) if isinstance(r, BaseException)]

    # ------------------------------------------------------------------ motions

    async def set_gains(self, serial: str, gains: GainSet, keep: bool = False) -> None:
        """Replace a module's gains, until the end of the lease or, to `keep`, of its boot."""
        await self._achieve(
            serial, Leaf.GAINS, lambda: self._command(GainsCommand, serial, gains=gains, keep=keep)
        )

    def stream(
        self, serial: str, position_rad: float | None, velocity_rad_s: float | None, effort_nm: float | None
    ) -> None:
        """Send one set-point, which is not acknowledged; None switches a loop off."""
        # The set-point replaces the last motion, which must not be commanded again.
        self._running.pop(serial, None)
        self._streams.add(serial)
        point = {"position_rad": position_rad, "velocity_rad_s": velocity_rad_s, "effort_nm": effort_nm}
        self._messenger.publish(serial, Leaf.SETPOINT, self._command(Setpoint, serial, **point), self._secret)

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
            await gather_all(self.ask_status(serial) for serial in self._tokens)
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
        for serial in self._tokens:
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
        return self._command(MotionCommand, serial, **what)

    async def _start(self, serial: str, motion: _Started) -> None:
        self._running.pop(serial, None)
        try:
            await self._achieve(serial, Leaf.MOTION, lambda: self._motion(serial, motion))
            self._running[serial] = motion
        except Refused as refused:
            if refused.ack.reason in UNSTARTED:
                raise MotionInterrupted(serial, f"refused: {refused.ack.detail}") from refused
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
        what = {"boot": self._boots[serial], "first_row": first, "end_row": end}

        async def attempt() -> None:
            request = self._request(HistoryRequest, serial, **what)
            answer = await self._messenger.ask(serial, Leaf.HISTORY, request)
            if isinstance(answer, Ack):
                raise Refused(serial, Leaf.HISTORY, answer)

        await self._persist(serial, attempt)

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
                    observer, Leaf.ESTIMATE, self._request(EstimateRequest, observer, joint=joint)
                )
            except NoAnswer:
                self.check()
            if await self.wait(lambda: received() is not None, 0.3):
                break
        return received()


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

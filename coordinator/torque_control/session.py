"""A session of gravity compensation: lease, release, hold, return, end of the leases.

Set-points and the renewals of the leases come from one loop: if it stalls, both end, and the modules switch
their motors off when the lifetime of their commands is over.
"""

import asyncio
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from coordinator.live_robot.commander import POLL_S
from coordinator.live_robot.messenger import Clock, Messenger, Post, Sender, gather_all
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.recording.recording import Recording
from coordinator.torque_control.gains import compensation_gains, holding_gains
from coordinator.torque_control.gravity_compensation import (
    CompensationRefused,
    CompensationSettings,
    GravityCompensator,
    Phase,
    Reading,
)
from coordinator.torque_control.gravity_model import GravityModel
from coordinator.torque_control.preconditions import check_gravity, find_robot
from coordinator.torque_control.streamed_states import StreamedStates
from coordinator.torque_control.summary import CompensationSummary, CompensationTally
from module_agent.model.catalogue import ModuleType
from module_agent.model.chain import Array
from module_agent.transport.transport import Transport
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import GainSet

# The oldest feedback to act on, as a share of the command lifetime: modules refuse commands that echo older
# feedback.
STALE_SHARE = 0.8
# Gravity and load at rest are averaged over a tenth of a second.
_REST_ROWS = 25
# Retained rows; older ones are dropped at this interval.
_RETAINED_ROWS, _FORGET_EVERY_S = 250, 2.0


class CompensationPlan(NamedTuple):
    """The course of a session. rate_hz: of the set-points. for_s: duration, None until `end` is called.

    final_hold_s: how long the position is held at the end. returns: whether the robot then returns to its
    start position; after an exceeded limit it is released where it is.
    """

    settings: CompensationSettings = CompensationSettings()
    rate_hz: float = 200.0
    for_s: float | None = None
    final_hold_s: float = 1.0
    returns: bool = True


class Moment(NamedTuple):
    """The state of a session at one moment, for display."""

    phase: Phase
    compensated_s: float
    missed: int
    reading: Reading
    effort_nm: Array


class CompensationScreen(Protocol):
    """Shows the course of a session; a terminal implements it."""

    def note(self, text: str) -> None:
        """Show a line of text."""

    def moment(self, now: Moment) -> None:
        """Show a moment; called at the rate of the set-points."""


class CompensationSession:
    """Gravity compensation of the robot `name` by `sender`, on any transport and clock.

    `post` runs a function on the event loop from any thread.
    """

    def __init__(
        self,
        transport: Transport,
        name: str,
        model: GravityModel,
        plan: CompensationPlan,
        clock: Clock,
        post: Post,
        screen: CompensationScreen,
        sender: Sender,
    ):
        self._recording = Recording()
        self._messenger = Messenger(transport, name, clock, post, self._recording.accept)
        self._group = ModuleGroup(self._messenger, self._recording, clock, sender)
        self._model, self._plan, self._clock, self._screen = model, plan, clock, screen
        self._serials = model.chain.serials
        self._tally = CompensationTally(self._serials)
        self._asked = ""
        # The number of calls of `end`, and that number when the robot was held.
        self._end_requests = self._end_requests_seen = 0
        self._states = StreamedStates(self._group, clock)
        self._is_under_torque = False
        self._streaming: asyncio.Task[None] | None = None

    @property
    def is_asked_to_end(self) -> bool:
        """Whether `end` was called."""
        return bool(self._asked)

    def end(self, why: str = "asked to end") -> None:
        """Ask for the end: the robot is held, returns and is released. To be called from the loop's thread.

        When it is held already, it does not return any more; on its way back, it stops there.
        """
        self._asked = self._asked or why
        self._end_requests += 1

    async def run(self) -> CompensationSummary:
        """Compensate until the plan's time is over, `end` is called, or a limit is exceeded.

        Raises:
            RobotMismatch, CompensationRefused: nothing has moved.
            StaleFeedback, ModuleLost, RobotStopped, NoAnswer, Refused: the robot has been told to stop.
        """
        self._messenger.start()
        try:
            return await self._run()
        finally:
            self._messenger.close()

    async def _run(self) -> CompensationSummary:
        await find_robot(self._group, self._messenger, self._model, self._clock)
        reported = [self._group.info(serial) for serial in self._serials]
        stale_s = STALE_SHARE * 1e-9 * min(info.lifetime_ns for info in reported)
        settings = self._plan.settings._replace(stale_s=min(stale_s, self._plan.settings.stale_s))
        compensator = GravityCompensator(self._model, tuple(info.limits for info in reported), settings)
        stood = self._reading(_REST_ROWS)
        try:
            compensator.check_start(stood)
        except CompensationRefused:
            # Another orientation of the base changes the weight too, and explains more.
            self._check_gravity()
            raise
        if self._asked:
            return self._tally.summary(self._asked, is_fault=False)
        try:
            await self._group.acquire_all()
            self._streaming = asyncio.create_task(self._stream(compensator))
            await self._compensate(compensator)
            await self._return(compensator, stood.q_rad)
            await _cancelled(self._streaming)
            await self._group.release_all()
        except BaseException as error:
            if self._streaming is not None:
                await _cancelled(self._streaming)
            why = str(error) or type(error).__name__
            unconfirmed = await self._group.stop_all(why[:200])
            missing = f"; no confirmation from {', '.join(unconfirmed)}" if unconfirmed else ""
            self._screen.note(f"stopped: {why}{missing}")
            raise
        return self._tally.summary(compensator.why, compensator.is_fault)

    # ------------------------------------------------------------------ compensating

    async def _compensate(self, compensator: GravityCompensator) -> None:
        """Release the robot once its motors exert its weight, and hold it at the end."""
        await self._until(lambda: not compensator.is_in("loading") or bool(self._asked))
        if compensator.is_in("loaded") and not self._asked:
            # Only while it is held: an IMU in free fall measures no gravity.
            self._check_gravity()
            damping = self._plan.settings.damping_nm_s_rad
            await self._set_gains(lambda kind: compensation_gains(kind, damping))
            self._is_under_torque = True
            compensator.release(self._now_s())
            await self._until(lambda: not compensator.is_in("releasing") or bool(self._asked))
            if compensator.is_in("compensating"):
                self._screen.note("gravity is compensated: lead the robot by hand")
            await self._until(lambda: self._is_over(compensator))
        self._end_requests_seen = self._end_requests
        compensator.hold(self._now_s(), self._asked or "the time is over")
        self._screen.note(f"holding: {compensator.why}")
        await self._until(lambda: compensator.is_in("held"))
        if self._is_under_torque:
            await self._set_gains(holding_gains)

    async def _set_gains(self, gains: Callable[[ModuleType], GainSet]) -> None:
        """Give every joint its gains, as long as the set-points go on meanwhile."""
        work = (self._group.set_gains(s, gains(self._group.kind(s))) for s in self._serials)
        given = asyncio.create_task(gather_all(work))
        try:
            await self._until(given.done)
        finally:
            await _cancelled(given)
        given.result()

    def _is_over(self, compensator: GravityCompensator) -> bool:
        over = self._plan.for_s is not None and self._tally.compensated_s >= self._plan.for_s
        return over or bool(self._asked) or not compensator.is_in("compensating")

    async def _until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            if self._streaming is not None and self._streaming.done():
                self._streaming.result()
            self._group.check()
            await asyncio.sleep(POLL_S)

    async def _stream(self, compensator: GravityCompensator) -> None:
        """Send set-points at their rate, and drop old rows."""
        period_s = 1.0 / self._plan.rate_hz
        due_s = forgot_s = self._now_s()
        while True:
            now_s = self._now_s()
            self._states.check()
            self._step(compensator, now_s)
            if now_s - forgot_s >= _FORGET_EVERY_S:
                for serial in self._serials:
                    self._group.module(serial).forget(_RETAINED_ROWS, 0)
                forgot_s = now_s
            due_s += period_s
            if (late_s := self._now_s() - due_s) > period_s:
                self._tally.missed += int(late_s / period_s)
                due_s += late_s
            await asyncio.sleep(max(0.0, due_s - self._now_s()))

    def _step(self, compensator: GravityCompensator, now_s: float) -> None:
        reading = self._reading()
        targets = compensator.step(now_s, reading)
        for k, serial in enumerate(self._serials):
            place = None if targets.position_rad is None else float(targets.position_rad[k])
            rate, effort = float(targets.velocity_rad_s[k]), float(targets.effort_nm[k])
            self._group.stream(serial, place, rate, effort)
        tally = self._tally
        tally.sent += 1
        if compensator.phase == "compensating":
            tally.add(now_s, reading.q_rad, reading.qd_rad_s, targets.effort_nm)
        self._screen.moment(
            Moment(compensator.phase, tally.compensated_s, tally.missed, reading, targets.effort_nm)
        )

    # ------------------------------------------------------------------ the end

    async def _return(self, compensator: GravityCompensator, stood_rad: Array) -> None:
        """Hold the robot still, then return to its start position, where it stood with its motors off.

        After an exceeded limit it stays: it may have hit a person, and the way back may be blocked.
        """
        await self._hold_still()
        if not (self._plan.returns and self._is_under_torque):
            return
        if not compensator.is_fault and self._end_requests == self._end_requests_seen:
            self._screen.note("returning to the start position")
            compensator.return_to(self._now_s(), stood_rad)
            await self._until(
                lambda: not compensator.is_in("returning") or self._end_requests > self._end_requests_seen
            )
            if compensator.is_in("held"):
                return
            compensator.hold(self._now_s(), self._asked)
            self._screen.note(
                f"holding on the way back: {compensator.why if compensator.is_fault else self._asked}"
            )
            await self._until(lambda: compensator.is_in("held"))
            await self._hold_still()
        self._screen.note("released at its position without returning: support the arm")

    async def _hold_still(self) -> None:
        end_s = self._now_s() + self._plan.final_hold_s
        await self._until(lambda: self._now_s() >= end_s)

    # ------------------------------------------------------------------ feedback

    def _now_s(self) -> float:
        return 1e-9 * self._clock()

    def _newest(self, serial: str, count: int = 1) -> Rows:
        log = self._group.module(serial).rows
        return log.rows(log.end_row - count, log.end_row)

    def _reading(self, count: int = 1) -> Reading:
        """Return the mean of the newest `count` rows of each module."""
        now_ns = self._clock()
        ages = [1e-9 * (now_ns - self._group.module(s).newest_row_arrival_ns) for s in self._serials]
        return Reading(np.array(ages), *self._means(count, "position_rad", "velocity_rad_s", "effort_nm"))

    def _means(self, count: int, *names: str) -> list[Array]:
        rows = [self._newest(serial, count) for serial in self._serials]
        return [np.array([row[name].mean(axis=0, dtype=float) for row in rows]) for name in names]

    def _check_gravity(self) -> None:
        check_gravity(self._model.chain, *self._means(_REST_ROWS, "position_rad", "accel_m_s2"))


async def _cancelled(task: "asyncio.Task[None]") -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)

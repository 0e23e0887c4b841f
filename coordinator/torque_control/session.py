"""A known robot floats: it is taken, set free, held again, led back to where it stood, and let go.

Set-points and the renewals of the leases come from one loop: if it stalls both end, and the modules' motors
are off when their commands' life is over.
"""

import asyncio
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from coordinator.live_robot.errors import ModuleLost, RobotStopped
from coordinator.live_robot.messenger import Clock, Messenger, Post, gather_all
from coordinator.live_robot.module_group import KEEP_ALIVE_S, POLL_S, ModuleGroup
from coordinator.recording.recording import Entry, Recording
from coordinator.torque_control.gains import compensation_gains, holding_gains
from coordinator.torque_control.gravity_compensation import (
    CompensationRefused,
    CompensationSettings,
    GravityCompensator,
    Phase,
    Reading,
    Targets,
)
from coordinator.torque_control.gravity_model import GravityModel
from coordinator.torque_control.preconditions import Felt, check_mounting, find_baseline_robot
from coordinator.torque_control.summary import CompensationSummary, CompensationTally
from module_agent.model.chain import Array
from module_agent.transport.transport import Transport
from module_agent.wire.feedback_rows import STATE_NAMES, Rows
from module_agent.wire.messages import Message
from module_agent.wire.refusal import WireError

# The feedback that is acted on is at most so much of a command's life old; a little later the modules would
# refuse what follows from it.
STALE_SHARE = 0.8
# Gravity and the load are felt for a tenth of a second.
_FELT_ROWS = 25
# Rows that are kept; older ones are dropped every so often.
_KEPT_ROWS, _FORGET_EVERY_S = 250, 2.0
_LET_GO = ("idle", "expired", "stopped", "fault")
_READ = ("position_rad", "velocity_rad_s", "effort_nm")


class CompensationPlan(NamedTuple):
    """What a float is told. rate_hz: of the set-points. for_s: None until it is asked to end.

    then_hold_s: how long it is held still before it is led back to where it stood; is_led_back: whether it
    is, or let go where it is. After a limit was met it is let go where it is.
    """

    settings: CompensationSettings = CompensationSettings()
    rate_hz: float = 200.0
    for_s: float | None = None
    then_hold_s: float = 1.0
    is_led_back: bool = True


class Moment(NamedTuple):
    """What is to be seen of a float at one moment."""

    phase: Phase
    compensated_s: float
    missed: int
    reading: Reading
    effort_nm: Array


class Watcher(Protocol):
    """Hears how a float goes; a terminal implements it."""

    def note(self, text: str) -> None:
        """Something worth a line."""
        ...

    def moment(self, now: Moment) -> None:
        """Set-points have been sent; called at their rate."""
        ...


class CompensationSession:
    """One float of the robot `name`, whose modules nobody holds yet, by `sender`; on any transport and clock.

    `post` runs a function on the event loop from any thread.
    """

    def __init__(
        self,
        transport: Transport,
        name: str,
        weight: GravityModel,
        plan: CompensationPlan,
        clock: Clock,
        post: Post,
        watcher: Watcher,
        sender: str,
    ):
        self._recording = Recording()
        self._radio = Messenger(transport, name, clock, post, self._record)
        self._link = ModuleGroup(self._radio, self._recording, clock, sender)
        self._weight, self._plan, self._clock, self._watcher = weight, plan, clock, watcher
        self._serials = weight.chain.serials
        self._tally = CompensationTally(self._serials)
        self._asked = ""
        # How often the end was asked for, and how often as the robot was taken hold of.
        self._asks = self._asks_heard = 0
        self._held_all = False
        self._is_under_torque = False

    @property
    def is_asked_to_end(self) -> bool:
        """Whether somebody has asked for the end."""
        return bool(self._asked)

    def end(self, why: str = "asked to end") -> None:
        """Ask for the end: the robot is held, led back and let go. To be called from the loop's thread.

        Asked when it is held already, it does not set out any more; asked on its way back, it stops there.
        """
        self._asked = self._asked or why
        self._asks += 1

    async def run(self) -> CompensationSummary:
        """Float until the plan's time is over, the end is asked for, or a limit is met; say how it went.

        Raises:
            NotTheKnownRobot, FloatRefused: nothing has moved.
            StaleFeedback, ModuleLost, RobotStopped, NoAnswer, Refused: the robot has been told to stop.
        """
        self._radio.start()
        try:
            return await self._run()
        finally:
            self._radio.close()

    def _record(self, entry: Entry) -> Message | None:
        try:
            message = self._recording.add(entry)
        except WireError:
            return None  # counted by the recording, by reason
        return message if isinstance(message, Message) else None

    async def _run(self) -> CompensationSummary:
        await find_baseline_robot(self._link, self._radio, self._weight, self._clock)
        told = [self._link.info(serial) for serial in self._serials]
        stale_s = STALE_SHARE * 1e-9 * min(info.lifetime_ns for info in told)
        settings = self._plan.settings._replace(stale_s=min(stale_s, self._plan.settings.stale_s))
        floater = GravityCompensator(self._weight, tuple(info.limits for info in told), settings)
        stood = self._reading(_FELT_ROWS)
        try:
            floater.check_start(stood)
        except CompensationRefused:
            # A base that stands otherwise changes the weight too, and says more.
            check_mounting(self._weight.chain, self._felt())
            raise
        if self._asked:
            return self._tally.summary(self._asked, is_fault=False)
        streaming: asyncio.Task[None] | None = None
        try:
            await gather_all(self._link.acquire(serial) for serial in self._serials)
            streaming = asyncio.create_task(self._stream(floater))
            await self._float(floater, streaming)
            await self._return(floater, stood.q_rad, streaming)
            await _cancelled(streaming)
            await self._let_go()
        except BaseException as error:
            if streaming is not None:
                await _cancelled(streaming)
            await self._abandon(error)
            raise
        return self._tally.summary(floater.why, floater.is_fault)

    # ------------------------------------------------------------------ floating

    async def _float(self, floater: GravityCompensator, streaming: "asyncio.Task[None]") -> None:
        """Set the robot free once its motors bear it, and take hold of it in the end."""
        await self._until(lambda: not floater.is_in("loading") or bool(self._asked), streaming)
        if floater.is_in("loaded") and not self._asked:
            # Not before it is held: what falls feels no gravity.
            check_mounting(self._weight.chain, self._felt())
            damping = self._plan.settings.damping_nm_s_rad
            await gather_all(
                self._link.set_gains(s, compensation_gains(self._link.kind(s), damping))
                for s in self._serials
            )
            self._is_under_torque = True
            floater.release(self._now_s())
            await self._until(lambda: not floater.is_in("freeing") or bool(self._asked), streaming)
            if floater.is_in("floating"):
                self._watcher.note("it floats: lead it by hand")
            await self._until(lambda: self._is_over(floater), streaming)
        self._asks_heard = self._asks
        floater.hold(self._now_s(), self._asked or "its time is over")
        self._watcher.note(f"it is held: {floater.why}")
        await self._until(lambda: floater.is_in("held"), streaming)
        if self._is_under_torque:
            await gather_all(
                self._link.set_gains(s, holding_gains(self._link.kind(s))) for s in self._serials
            )

    def _is_over(self, floater: GravityCompensator) -> bool:
        over = self._plan.for_s is not None and self._tally.compensated_s >= self._plan.for_s
        return over or bool(self._asked) or not floater.is_in("floating")

    async def _until(self, condition: Callable[[], bool], streaming: "asyncio.Task[None]") -> None:
        while not condition():
            if streaming.done():
                streaming.result()
            self._link.check()
            await asyncio.sleep(POLL_S)

    async def _stream(self, floater: GravityCompensator) -> None:
        """Send set-points at their rate, renew the leases, and keep no more of the past than it takes."""
        period_s = 1.0 / self._plan.rate_hz
        due_s = forgot_s = self._now_s()
        renewed_s = due_s - KEEP_ALIVE_S
        while True:
            now_s = self._now_s()
            self._check_states()
            self._step(floater, now_s)
            if now_s - renewed_s >= KEEP_ALIVE_S:
                self._link.renew()
                renewed_s = now_s
            if now_s - forgot_s >= _FORGET_EVERY_S:
                self._forget()
                forgot_s = now_s
            due_s += period_s
            if (late_s := self._now_s() - due_s) > period_s:
                self._tally.missed += int(late_s / period_s)
                due_s += late_s
            await asyncio.sleep(max(0.0, due_s - self._now_s()))

    def _step(self, floater: GravityCompensator, now_s: float) -> None:
        reading = self._reading()
        targets = floater.step(now_s, reading)
        self._send(targets)
        if floater.phase == "floating":
            self._tally.add(now_s, reading.q_rad, reading.qd_rad_s, targets.effort_nm)
        tally = self._tally
        self._watcher.moment(
            Moment(floater.phase, tally.compensated_s, tally.missed, reading, targets.effort_nm)
        )

    def _send(self, targets: Targets) -> None:
        for k, serial in enumerate(self._serials):
            place = None if targets.position_rad is None else float(targets.position_rad[k])
            rate, effort = float(targets.velocity_rad_s[k]), float(targets.effort_nm[k])
            self._link.stream(serial, place, rate, effort)
        self._tally.sent += 1

    def _check_states(self) -> None:
        """Check that no module has let go of its joint, once all have taken set-points.

        Raises:
            RobotStopped, ModuleLost: one has.
        """
        states = {s: STATE_NAMES[int(self._newest(s)["state"][0])] for s in self._serials}
        self._held_all = self._held_all or set(states.values()) == {"streaming"}
        for serial, state in states.items():
            if self._held_all and state in _LET_GO:
                status = self._link.module(serial).status
                note = status.note if status is not None and status.state == state else ""
                if state == "stopped":
                    raise RobotStopped(serial, note or "stopped")
                raise ModuleLost(serial, f"its motor is off, {state}" + (f": {note}" if note else ""))

    # ------------------------------------------------------------------ the end

    async def _return(
        self, floater: GravityCompensator, stood_rad: Array, streaming: "asyncio.Task[None]"
    ) -> None:
        """Hold the robot still, and lead it back to where it stood, where its motors were off before.

        A robot that met a limit met perhaps somebody, and what lies on its way back is not known: it stays.
        """
        await self._stand(streaming)
        if not (self._plan.is_led_back and self._is_under_torque):
            return
        if not floater.is_fault and self._asks == self._asks_heard:
            self._watcher.note("it goes back to where it stood")
            floater.lead_back(self._now_s(), stood_rad)
            await self._until(
                lambda: not floater.is_in("returning") or self._asks > self._asks_heard, streaming
            )
            if floater.is_in("held"):
                return
            floater.hold(self._now_s(), self._asked)
            self._watcher.note(
                f"it is held on its way back: {floater.why if floater.is_fault else self._asked}"
            )
            await self._until(lambda: floater.is_in("held"), streaming)
            await self._stand(streaming)
        self._watcher.note("it does not go back, and is let go where it is: support it")

    async def _stand(self, streaming: "asyncio.Task[None]") -> None:
        end_s = self._now_s() + self._plan.then_hold_s
        await self._until(lambda: self._now_s() >= end_s, streaming)

    async def _let_go(self) -> None:
        keeper = asyncio.create_task(self._link.keep_alive())
        try:
            await self._link.release_all()
        finally:
            await _cancelled(keeper)

    async def _abandon(self, error: BaseException) -> None:
        why = str(error) or type(error).__name__
        deaf = await self._link.stop_all(why[:200])
        self._watcher.note(f"stopped: {why}" + (f"; no confirmation from {', '.join(deaf)}" if deaf else ""))

    # ------------------------------------------------------------------ what is known of the robot

    def _now_s(self) -> float:
        return 1e-9 * self._clock()

    def _newest(self, serial: str, count: int = 1) -> Rows:
        log = self._link.module(serial).rows
        return log.rows(log.end_row - count, log.end_row)

    def _reading(self, count: int = 1) -> Reading:
        """Return what the newest rows say, the mean of `count` of each module."""
        now_ns = self._clock()
        ages = [1e-9 * (now_ns - self._heard_ns(serial)) for serial in self._serials]
        rows = [self._newest(serial, count) for serial in self._serials]
        means = ([row[name].mean(dtype=float) for row in rows] for name in _READ)
        return Reading(np.array(ages), *(np.array(values) for values in means))

    def _heard_ns(self, serial: str) -> int:
        """Return when the newest row of a module came; what is known of later arrivals is dropped."""
        arrivals = self._link.module(serial).arrivals
        arrivals[:] = [first_of_newest(arrivals)]
        return arrivals[0][0]

    def _felt(self) -> Felt:
        rows = [self._newest(serial, _FELT_ROWS) for serial in self._serials]
        q = [float(row["position_rad"].mean()) for row in rows]
        return Felt(np.array(q), np.array([row["accel_m_s2"].astype(float).mean(axis=0) for row in rows]))

    def _forget(self) -> None:
        for serial in self._serials:
            record = self._link.module(serial)
            record.rows.forget_before(record.rows.end_row - _KEPT_ROWS)
            record.round_trips.clear()


def first_of_newest(arrivals: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Return the arrival, (session time, newest module time) [ns], that first brought the newest of all.

    Messages that overtake one another, or come twice, bring nothing newer.
    """
    return min(arrivals, key=lambda one: (-one[1], one[0]))


async def _cancelled(task: "asyncio.Task[None]") -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)

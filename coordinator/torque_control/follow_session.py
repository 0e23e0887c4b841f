"""A session that follows a motion in several input modes, and measures the tracking of each.

Checks, leases, and for each mode: slowly to the motion's start, settling there under the mode's set-points,
the motion, a rest; then back to where the robot stood, and the end of the leases. Set-points are streamed;
what goes wrong stops all modules.
"""

import asyncio
from typing import NamedTuple, Protocol

import numpy as np

from coordinator.live_robot.commander import POLL_S
from coordinator.live_robot.messenger import Clock, Messenger, Post, Sender
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.recording.recording import Recording
from coordinator.torque_control.feed_forward import RATE_HZ, Reference, standing
from coordinator.torque_control.gravity_compensation import StaleFeedback
from coordinator.torque_control.gravity_model import GravityModel
from coordinator.torque_control.motion_file import MotionFile
from coordinator.torque_control.preconditions import check_gravity, find_robot
from coordinator.torque_control.streamed_states import StreamedStates
from coordinator.torque_control.tracking import (
    MODE_NAMES,
    MODES,
    FollowResult,
    InputMode,
    ModeTracking,
    calculated_nm,
    check_motion_limits,
    mode_tracking,
)
from module_agent.model.chain import Array
from module_agent.model.errors import RobotError
from module_agent.transport.transport import Transport
from module_agent.wire.feedback_rows import Rows
from module_agent.wire.messages import GoTo

# As in gravity compensation: modules refuse commands that echo feedback older than their commands live.
STALE_SHARE = 0.8
_REST_ROWS = 25
# A robot nearer than that to the motion's start is there.
_AT_START_RAD = 0.02
# The measured torque fades into the calculated one within the first half of settling.
SETTLE_S, _FADE = 1.5, 0.5
REST_S = 0.3
# From the end of a way to where the joints are at rest.
_STILL_S = 0.5
_RETAINED_ROWS = 250


class TrackingLost(RobotError):
    """A joint is farther from its set-point than accepted; the robot has been stopped."""


class FollowPlan(NamedTuple):
    """How a motion is followed.

    drive: whether torques have the motors' losses added. max_error_rad: from where on the robot is stopped.
    travel_rad_s: speed on the way to the motion's start and back.
    """

    modes: tuple[InputMode, ...] = MODES
    rate_hz: float = 200.0
    drive: bool = True
    max_error_rad: float = 0.5
    travel_rad_s: float = 0.5


class FollowScreen(Protocol):
    """Shows the course of a session."""

    def step(self, index: int, total: int, text: str) -> None:
        """Show that a step begins."""

    def note(self, text: str) -> None:
        """Show a line of text."""


class _SetPoints(NamedTuple):
    """What is streamed at 1 kHz, (m, n) each."""

    q_rad: Array
    qd_rad_s: Array
    effort_nm: Array


class FollowSession:
    """Follows a motion with the robot `name` by `sender`, on any transport and clock.

    `post` runs a function on the event loop from any thread.
    """

    def __init__(
        self,
        transport: Transport,
        name: str,
        model: GravityModel,
        motion: MotionFile,
        plan: FollowPlan,
        clock: Clock,
        post: Post,
        screen: FollowScreen,
        sender: Sender,
    ):
        self._recording = Recording()
        self._messenger = Messenger(transport, name, clock, post, self._recording.accept)
        self._group = ModuleGroup(self._messenger, self._recording, clock, sender)
        self._name, self._model, self._motion, self._plan = name, model, motion, plan
        self._clock, self._screen = clock, screen
        self._serials = model.chain.serials
        self._states = StreamedStates(self._group, clock)
        self._stale_s = 0.0
        self._missed = 0

    async def run(self) -> FollowResult:
        """Follow the motion in every mode of the plan.

        Raises:
            RobotMismatch, MotionRefused: nothing has moved.
            TrackingLost, StaleFeedback, ModuleLost, RobotStopped, MotionInterrupted, NoAnswer, Refused: the
                robot has been told to stop.
        """
        self._messenger.start()
        try:
            return await self._run()
        finally:
            self._messenger.close()

    async def _run(self) -> FollowResult:
        await find_robot(self._group, self._messenger, self._model, self._clock)
        check_gravity(self._model.chain, *self._means("position_rad", "accel_m_s2"))
        (stood_rad,) = self._means("position_rad")
        reference = self._motion.reference(self._serials, stood_rad)
        infos = [self._group.info(serial) for serial in self._serials]
        check_motion_limits(self._model, reference, [info.limits for info in infos])
        self._stale_s = STALE_SHARE * 1e-9 * min(info.lifetime_ns for info in infos)
        try:
            await self._group.acquire_all()
            measured = [await self._mode(mode, reference) for mode in self._plan.modes]
            await self._go(stood_rad)
            await self._group.release_all()
        except BaseException as error:
            why = str(error) or type(error).__name__
            unconfirmed = await self._group.stop_all(why[:200])
            missing = f"; no confirmation from {', '.join(unconfirmed)}" if unconfirmed else ""
            self._screen.note(f"stopped: {why}{missing}")
            raise
        return FollowResult(
            robot=self._name,
            motion=self._motion.path.name,
            duration_s=float(self._motion.t_s[-1]),
            rate_hz=self._plan.rate_hz,
            drive=self._plan.drive,
            missed=self._missed,
            modes=tuple(measured),
            suspicions=self._model.suspicions,
        )

    # ------------------------------------------------------------------ one mode

    async def _mode(self, mode: InputMode, reference: Reference) -> ModeTracking:
        """Go to the start, settle there under the mode's set-points, and follow the motion."""
        away = float(np.abs(self._means("position_rad")[0] - reference.q_rad[0]).max())
        if away > _AT_START_RAD:
            self._screen.note(
                f"the motion starts {away:.2f} rad away: moving there at {self._plan.travel_rad_s:g} rad/s"
            )
        await self._go(reference.q_rad[0])
        index = self._plan.modes.index(mode)
        self._screen.step(index + 1, len(self._plan.modes), f"mode {mode}: {MODE_NAMES[mode]}")
        settling, motion, rest = self._phases(reference)
        await self._stream(settling, mode)
        begin = self._ends()
        await self._stream(motion, mode)
        end = self._ends()
        await self._stream(rest, mode)
        rows = {s: self._group.module(s).rows.rows(begin[s], end[s]) for s in self._serials}
        tracking = mode_tracking(mode, rows)
        for serial in self._serials:
            self._group.module(serial).forget(_RETAINED_ROWS, 0)
        return tracking

    def _phases(self, reference: Reference) -> list[_SetPoints]:
        """Return the set-points of settling at the start, the motion, and the rest after it.

        While settling, the measured torque fades into that of the start.
        """
        gains = [self._group.info(serial).gains for serial in self._serials]
        q_rad, measured_nm, winding_c = self._means("position_rad", "effort_nm", "winding_temperature_c")
        # At rest the spring exerts the weight, whatever friction holds: what differs is the sensors' offset.
        offset_nm = measured_nm - self._model.effort_nm(q_rad, np.zeros_like(q_rad))
        phases = []
        # Each by itself: a motion may begin with an acceleration, which no motor compensates at once.
        for phase in (standing(reference, 0, SETTLE_S), reference, standing(reference, -1, REST_S)):
            torque = calculated_nm(self._model, phase, gains, winding_c.tolist(), self._plan.drive)
            phases.append(_SetPoints(phase.q_rad, phase.qd_rad_s, torque + offset_nm))
        settling = phases[0].effort_nm
        share = np.minimum(np.arange(len(settling)) / (_FADE * len(settling)), 1.0)[:, None]
        phases[0] = phases[0]._replace(effort_nm=measured_nm + share * (settling - measured_nm))
        return phases

    async def _go(self, target_rad: Array) -> None:
        goals = {
            serial: GoTo(target_rad=float(q), max_speed_rad_s=self._plan.travel_rad_s)
            for serial, q in zip(self._serials, target_rad, strict=True)
        }
        await self._group.run(goals)
        await asyncio.sleep(_STILL_S)

    async def _stream(self, points: _SetPoints, mode: InputMode) -> None:
        """Stream set-points at the plan's rate to their end; no feedback of that time is missing then."""
        stream, filling = asyncio.create_task(self._send(points, mode)), asyncio.create_task(self._fill())
        try:
            while not stream.done():
                self._group.check()
                # A module that does not answer must not delay the stop, if the guard has ended the stream.
                await asyncio.wait((stream, filling), return_when=asyncio.FIRST_COMPLETED)
                if filling.done():
                    filling.result()
                    filling = asyncio.create_task(self._fill())
            stream.result()
        finally:
            await _cancelled(filling)
            await _cancelled(stream)
        await self._group.close_gaps()

    async def _fill(self) -> None:
        await self._group.close_gaps()
        await asyncio.sleep(POLL_S)

    async def _send(self, points: _SetPoints, mode: InputMode) -> None:
        period_s = 1.0 / self._plan.rate_hz
        begin_s = due_s = self._now_s()
        last = len(points.q_rad) - 1
        while True:
            row = min(round((self._now_s() - begin_s) * RATE_HZ), last)
            self._states.check()
            self._guard(points.q_rad[row])
            for k, serial in enumerate(self._serials):
                rate = float(points.qd_rad_s[row, k]) if mode > 1 else None
                effort = float(points.effort_nm[row, k]) if mode > 2 else None
                self._group.stream(serial, float(points.q_rad[row, k]), rate, effort)
            if row == last:
                return
            due_s += period_s
            if (late_s := self._now_s() - due_s) > period_s:
                self._missed += int(late_s / period_s)
                due_s += late_s
            await asyncio.sleep(max(0.0, due_s - self._now_s()))

    def _guard(self, wanted_rad: Array) -> None:
        """Check age of the feedback, and distance of every joint from its set-point.

        Raises:
            StaleFeedback, TrackingLost
        """
        now_ns = self._clock()
        for k, serial in enumerate(self._serials):
            record = self._group.module(serial)
            age_s = 1e-9 * (now_ns - record.newest_row_arrival_ns)
            if age_s > self._stale_s:
                raise StaleFeedback(
                    f"module {serial}: newest feedback is {1e3 * age_s:.0f} ms old, at most "
                    f"{1e3 * self._stale_s:.0f} ms are accepted; check the network"
                )
            log = record.rows
            place = float(log.rows(log.end_row - 1, log.end_row)["position_rad"][0])
            if abs(place - wanted_rad[k]) > self._plan.max_error_rad:
                raise TrackingLost(
                    f"joint {serial} is {abs(place - wanted_rad[k]):.2f} rad from its set-point, at most "
                    f"{self._plan.max_error_rad:g} rad are accepted: it is blocked, or cannot follow"
                )

    # ------------------------------------------------------------------ feedback

    def _now_s(self) -> float:
        return 1e-9 * self._clock()

    def _ends(self) -> dict[str, int]:
        return {serial: self._group.module(serial).rows.end_row for serial in self._serials}

    def _newest(self, serial: str) -> Rows:
        log = self._group.module(serial).rows
        return log.rows(max(log.first_row, log.end_row - _REST_ROWS), log.end_row)

    def _means(self, *names: str) -> list[Array]:
        """Return means over a tenth of a second, (n, ...) each."""
        rows = [self._newest(serial) for serial in self._serials]
        return [np.array([row[name].mean(axis=0, dtype=float) for row in rows]) for name in names]


async def _cancelled(task: "asyncio.Task[None]") -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)

"""The steps of an identification run, from discovery to the last motion; `identify` evaluates its recording.

Steps are journaled; a resumed run skips the steps that are done.
"""

import asyncio
import itertools
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from typing import Protocol

from coordinator.excitation.plan import Plan
from coordinator.excitation.segment import RobotMotion
from coordinator.live_robot.discovery import await_modules
from coordinator.live_robot.errors import ModulesJoined, MotionInterrupted
from coordinator.live_robot.excluded_modules import ExcludedModules
from coordinator.live_robot.link_check import check_link
from coordinator.live_robot.messenger import Clock, Messenger, Refused, gather_all
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.recording.journal import (
    JournalEvent,
    Purpose,
    exclusion_event,
    refused_by_limits,
    since_joined,
)
from coordinator.recording.recording import Recording
from coordinator.session.expected_times import ExpectedTimes
from coordinator.session.motion_selection import TRIAL_RAD, MotionChoice, resting
from coordinator.topology.next_motion import MAX_REPEATS, NextMotion
from coordinator.viewer.feed import Screen
from module_agent.model.catalogue import ModuleType
from module_agent.model.errors import RobotError
from module_agent.wire.messages import GoTo, MotionRecord, Pattern

DISCOVERY_POLL_S = 0.05
# Estimates take some tens of milliseconds; one that has not come by then was lost, and is requested.
ESTIMATE_WAIT_S = 0.6
# A poor network interrupts more than one motion in ten: factor on the plan's retries.
POOR_RETRIES = 4
# The share of the way that a joint has to come along with a slow trial: held joints give under gravity, an
# X5-4 that holds a whole arm by a third of the way.
MIN_MOVED_SHARE = 0.5


class Reporter(Screen, Protocol):
    """Receives the progress of the session, and designs motions; implemented by `Run`."""

    def estimates(self, joint: str) -> None:
        """Report that all estimates of the motions of a joint have arrived."""
        ...

    async def moving(self, serials: Sequence[str]) -> None:
        """Report on joints that move all at once, until it is cancelled: their motion is over."""
        ...

    async def doubts(self) -> Sequence[NextMotion]:
        """Return the motions to repeat to settle doubts about the topology, after all joints are explored."""
        ...

    async def explored(self) -> None:
        """Assemble topology and chain, after all joints are explored; raises if they cannot be."""
        ...

    async def excitation(self) -> Sequence[RobotMotion]:
        """Return excitation motions of all joints at once, the last to be held out.

        Empty if none is feasible on this robot.
        """
        ...


class JointBlocked(RobotError):
    """A joint did not come along with a slow motion of its own; the message names it."""


class NoModulesFound(RobotError):
    """No module, or another number than expected, is on the network."""


class Session:
    """Runs the steps on a robot. `journal` records an event; `reporter` receives the progress.

    `single_joints` returns, after a motion of all joints at once, which of them to explore one by one too.
    `share` is called after every excitation motion, while the modules still have its rows.
    """

    def __init__(
        self,
        group: ModuleGroup,
        messenger: Messenger,
        recording: Recording,
        plan: Plan,
        clock: Clock,
        journal: Callable[[JournalEvent], None],
        reporter: Reporter,
        single_joints: Callable[[], Awaitable[Sequence[str]]] | None = None,
        share: Callable[[], Awaitable[None]] | None = None,
    ):
        self.group = group
        self._share = share
        self._single_joints = single_joints
        self._messenger = messenger
        self._recording = recording
        self._plan = plan
        self._speed_rad_s = plan.travel_speed_rad_s
        self._clock = clock
        self._journal = journal
        self._reporter = reporter
        self._choice = MotionChoice(plan, recording, lambda: self._excluded.movers(), group.kind)
        self._done = {e.step: e for e in since_joined(recording.journal) if e.what == "done"}
        self._index = 0
        self._total = 4
        # None before the modules are known.
        self._times: ExpectedTimes | None = None
        self._excluded = ExcludedModules(group, self._note_exclusion)
        # Modules that were there so far, and where the joints of those that take part stood.
        self._known = frozenset[str]()
        self._starts: dict[str, float] = {}

    # ------------------------------------------------------------------ the run

    async def run(self, expect: int | None = None) -> None:
        """Discover, check, acquire, move and release; on an error, stop the robot and raise it.

        If modules join the robot meanwhile, all is measured again with them; where their number is said to be
        as it was, this is an error.

        Raises:
            ModulesJoined: modules came that are not expected.
            RecordingFull: its feedback would not fit into the memory; nothing has moved.
        """
        await self._discover(expect)
        self._report("checking the network")
        await check_link(self.group, self._clock, self._plan.link_s, self._reporter.note)
        self._total = 2 + self._steps()
        self._begin_anew_if_changed()
        self._repeat_journeys()
        self._starts = {s: self._position(s) for s in self.group.serials}
        self._times = self._expected()
        self._recording.check_room_for(self.group.serials, self._times.left_s)
        try:
            await self._arm()
            while True:
                try:
                    await self._measure()
                    break
                except ModulesJoined as joined:
                    if expect is not None:
                        raise
                    await self._begin_anew(joined)
            await self._finish()
        except BaseException as error:
            await self._abandon(error)
            raise

    def _steps(self) -> int:
        """Return how many steps there are from the first motion on, as far as that is known before."""
        joints = len(self.group.serials)
        all_at_once = self._plan.mode == "simultaneous"
        return (
            4
            + (self._plan.trial_speed_rad_s is not None)
            + (1 if all_at_once else joints + (self._plan.motions == "optimised"))
            + (self._excitations(joints) if self._plan.dynamics else 0)
        )

    def _expected(self) -> ExpectedTimes:
        away_rad = max(abs(self._position(s) - self._plan.home_rad) for s in self.group.serials)
        kinds = {s: self.group.kind(s) for s in self.group.serials}
        return ExpectedTimes(self._plan, kinds, away_rad, self._done)

    async def _measure(self) -> None:
        """Run all motions that show what the robot is.

        Raises:
            ModulesJoined: modules have come, and the robot stands still.
        """
        if self._plan.trial_speed_rad_s is not None:
            # The ways home of the attempts that follow an interrupted one, too.
            self._speed_rad_s = self._plan.trial_speed_rad_s
            work = partial(self._try_slowly, self._plan.trial_speed_rad_s)
            await self._step("trial", "every joint slowly, a little", work)
        self._speed_rad_s = self._plan.travel_speed_rad_s
        await self._step_unless_excluded("home", "all joints to their home position", self._home)
        await self._step("rest", "listening at rest", self._rest)
        if self._plan.mode == "simultaneous":
            single = await self._explore_at_once()
            self._total += len(single)
            if self._times is not None:
                self._times.explore(single)
            await self._explore_each(single)
        else:
            await self._explore_each(self.group.serials)
            if self._plan.motions == "optimised" and not self._plan.topology_only:
                await self._step("explore", "exploring all joints at once", self._explore_all)
        await self._settle_doubts()
        self._report("topology and chain")
        await self._reporter.explored()
        if self._plan.dynamics and not self._excluded.missing:
            await self._show_inertia()
        elif self._plan.dynamics:
            self._total -= self._excitations(len(self.group.serials))
            if self._times is not None:
                self._times.excite((), ())
            gone = ", ".join(self._excluded.missing)
            self._reporter.note(f"no motions for the inertia: the robot is not known whole without {gone}")

    # ------------------------------------------------------------------ modules that join the robot

    async def _look_for_joined(self) -> None:
        """Register modules that have come and respond.

        Raises:
            ModulesJoined: there are some.
        """
        present = frozenset(self._messenger.alive)
        before, new = self.group.serials, sorted(present - self._known)
        self._known |= present
        if not new:
            return
        await self._excluded.meet(new)
        joined = [serial for serial in self.group.serials if serial not in before]
        if joined:
            raise ModulesJoined(joined, before)

    async def _begin_anew(self, joined: ModulesJoined) -> None:
        """Let modules take part that have joined the robot; what was measured before does not count."""
        text = f"{joined}: the robot is measured anew with {'it' if len(joined.serials) == 1 else 'them'}"
        self._note_anew(text)
        self._starts |= {serial: self._position(serial) for serial in joined.serials}
        await gather_all(self._arm_one(serial) for serial in joined.serials)
        self._total = self._index + self._steps()
        self._times = self._expected()

    def _begin_anew_if_changed(self) -> None:
        """Keep no step of a session that is resumed if the robot is not as it was then.

        It may have other modules. One that has booted since may have lost its zero, and what it measured of
        the others' motions is of its earlier boot.
        """
        journal = self._recording.journal
        rested = {
            e.serial: e.boot for e in since_joined(journal) if e.what == "motion" and e.purpose == "rest"
        }
        here = set(self.group.serials)
        changes = [f"{s} came" for s in sorted(here - rested.keys() - refused_by_limits(journal))]
        changes += [f"{s} went" for s in sorted(rested.keys() - here)]
        changes += [
            f"{s} booted" for s in sorted(here & rested.keys()) if rested[s] != self.group.module(s).boot
        ]
        if rested and changes:
            self._note_anew(f"since the session before {', '.join(changes)}: the robot is measured anew")

    def _note_anew(self, text: str) -> None:
        self._reporter.note(text)
        self._journal(JournalEvent(t_ns=self._clock(), what="anew", text=text))
        self._done.clear()

    async def _discover(self, expect: int | None) -> None:
        self._report("discovering modules")
        quiet_s, count = self._plan.discover_s, expect or 1
        known = await await_modules(
            self._messenger,
            self._clock,
            lambda present, settled_s: settled_s >= quiet_s and len(present) >= count,
            quiet_s + (10.0 if expect else 3.0),
            DISCOVERY_POLL_S,
        )
        if not known or (expect is not None and len(known) != expect):
            names = ", ".join(sorted(known)) or "none"
            wanted = "at least one" if expect is None else str(expect)
            raise NoModulesFound(f"{wanted} module expected, found {len(known)}: {names}")
        self._known = known
        await self._excluded.meet(sorted(known))
        if not self.group.serials:
            why = "; ".join(self._excluded.why[serial] for serial in sorted(known))
            raise NoModulesFound(f"none of the modules that announced themselves responds: {why}")
        for serial in self.group.serials:
            self.group.kind(serial)
        self._reporter.note(f"found {len(self.group.serials)}: {', '.join(self.group.serials)}")

    def _repeat_journeys(self) -> None:
        """Do the steps again that bring the robot to where it is measured, and back."""
        for journey in ("home", "back"):
            self._done.pop(journey, None)
        if self._done:
            self._reporter.note(f"resuming: {len(self._done)} steps are done already")

    async def _arm(self) -> None:
        """Acquire every module, and set the plan's gains if they are not the factory's."""
        # Concurrently: a module that is armed without a motion expires sooner.
        await gather_all(self._arm_one(serial) for serial in self._excluded.movers())

    async def _arm_one(self, serial: str) -> None:
        await self.group.acquire(serial)
        if self._plan.hold_stiffness != 1.0:
            strategy = self.group.info(serial).gains.strategy
            gains = self._plan.exploring_gains(self.group.kind(serial), strategy)
            await self.group.set_gains(serial, gains)

    async def _step(
        self, name: str, text: str, work: Callable[..., Awaitable[None]], *arguments: str
    ) -> None:
        self._report(text)
        if self._times is not None:
            self._times.over(name)
        if name in self._done:
            return
        self._journal(JournalEvent(t_ns=self._clock(), what="begin", step=name))
        for attempt in itertools.count():
            try:
                if attempt:
                    await self._rearm()
                await work(*arguments)
                break
            except MotionInterrupted as error:
                await self.group.check_now()
                if attempt >= self._plan.retries * (POOR_RETRIES if self.group.is_poor else 1):
                    raise
                self._reporter.note(f"{error}; re-arming and trying again")
                self._journal(JournalEvent(t_ns=self._clock(), what="note", step=name, text=str(error)))
        await self.group.complete_rows()
        serial = arguments[0] if arguments else ""
        boot = self.group.module(serial).boot if serial else 0
        self._journal(JournalEvent(t_ns=self._clock(), what="done", step=name, serial=serial, boot=boot))
        await self._look_for_joined()

    async def _step_unless_excluded(
        self, name: str, text: str, work: Callable[..., Awaitable[None]], *arguments: str
    ) -> None:
        """Run a step; exclude a module that refuses to move, and go on without it."""
        while not (arguments and arguments[0] in self._excluded.why):
            try:
                await self._step(name, text, work, *arguments)
                return
            except (Refused, MotionInterrupted) as error:
                if not self._excluded.without(error):
                    raise
                await self._rearm_the_rest()

    def _note_exclusion(self, serial: str, why: str, by_limits: bool) -> None:
        self._reporter.note(f"going on without {serial}: {why}")
        self._journal(exclusion_event(self._clock(), serial, why, by_limits))

    async def _rearm(self) -> None:
        """Take the modules again and go home."""
        # An excluded module that no longer holds its joint interrupts no other one.
        for serial in self._excluded.look_again():
            self.group.forget_lease(serial)
        await self._arm()
        await self._home()

    async def _rearm_the_rest(self) -> None:
        """Take the modules again and go home, without those that refuse or cannot."""
        while True:
            try:
                await self._rearm()
                return
            except (Refused, MotionInterrupted) as error:
                if not self._excluded.without(error):
                    raise

    async def _finish(self) -> None:
        speed = self._plan.travel_speed_rad_s

        async def back() -> None:
            goals = {
                s: self._allowed(s, self._starts[s]) for s in self._excluded.movers() if s in self._starts
            }
            await self.group.run({s: GoTo(target_rad=q, max_speed_rad_s=speed) for s, q in goals.items()})

        try:
            await self._step("back", "back to where it stood", back)
        except ModulesJoined as late:
            self._note_late(late.serials)
        self._excluded.look_again()
        await self.group.release_all()
        await self.group.close_gaps()
        self._note_late(sorted(frozenset(self._messenger.alive) - self._known))

    def _note_late(self, serials: Sequence[str]) -> None:
        for serial in serials:
            why = f"module {serial} came when all had been measured"
            self._note_exclusion(serial, why, by_limits=False)

    async def _abandon(self, error: BaseException) -> None:
        why = str(error) or type(error).__name__
        unconfirmed = await self.group.stop_all(why[:200])
        text = f"stopped: {why}" + (f"; no confirmation from {', '.join(unconfirmed)}" if unconfirmed else "")
        self._journal(JournalEvent(t_ns=self._clock(), what="failed", text=text, deaf=tuple(unconfirmed)))
        self._reporter.note(text)

    # ------------------------------------------------------------------ the steps

    async def _home(self) -> None:
        await self._go(dict.fromkeys(self._excluded.movers(), self._plan.home_rad))

    async def _try_slowly(self, speed_rad_s: float) -> None:
        """Go home slowly, then move every joint by itself a little to either side.

        Raises:
            JointBlocked: one does not come along.
        """
        home = self._plan.home_rad
        await self._go(dict.fromkeys(self._excluded.movers(), home), speed_rad_s)
        for serial in self._excluded.movers():
            for target, wanted in ((home + TRIAL_RAD, TRIAL_RAD), (home - TRIAL_RAD, -2.0 * TRIAL_RAD)):
                before = self._position(serial)
                await self._go({serial: target}, speed_rad_s)
                # Under gravity a held joint stands aside of where it is to be, before as after.
                moved = self._position(serial) - before
                if moved / wanted < MIN_MOVED_SHARE:
                    raise JointBlocked(
                        f"joint {serial} was to move by {wanted:+.3f} rad and moved by {moved:+.3f} rad, "
                        "slowly and by itself: something is in its way, or holds it; see that it is free"
                    )
            await self._go({serial: home}, speed_rad_s)

    async def _rest(self) -> None:
        records = await self.group.run(dict.fromkeys(self._excluded.movers(), resting(self._plan)))
        for serial, record in records.items():
            self._note_motion("rest", serial, record, "rest")

    async def _explore(self, serial: str) -> None:
        """Run the constant motion through home, then the windowed sine about home (thesis 4.3.1)."""
        plan, home = self._plan, self._plan.home_rad
        constant = self._choice.slow(serial)
        travel = constant.velocity_rad_s * (constant.duration_s + constant.ramp_s)
        await self._go({serial: home - 0.5 * travel})
        slow = await self._observe(serial, constant, "constant")
        await self._go({serial: home})
        if plan.topology_only:
            return
        fast = await self._observe(serial, self._choice.fast(serial, slow), "windowed_sine")
        self._reporter.estimates(serial)
        await self._repeat(serial, [slow, fast])

    async def _repeat(self, serial: str, done: list[MotionRecord]) -> None:
        """Repeat the fast motion, or a more informative one, until the radius has the plan's precision."""
        while (more := self._choice.again(serial, done)) is not None:
            done.append(await self._move(f"explore/{serial}", serial, more, "repeat"))
        if self._plan.precision_mm is not None:
            self._reporter.note(
                f"joint {serial}: {len(done) - 2} repeats, {self._choice.predicted_mm(serial, done):.2f} mm "
                f"of radius by the sensors, {self._plan.precision_mm:.2f} mm asked for"
            )

    async def _explore_each(self, serials: Sequence[str]) -> None:
        for serial in serials:
            text = f"exploring joint {serial}"
            await self._step_unless_excluded(f"explore/{serial}", text, self._explore, serial)

    async def _settle_doubts(self) -> None:
        """Repeat motions until the topology is beyond doubt, at most `MAX_REPEATS` times."""
        for turn in range(MAX_REPEATS):
            motions = await self._reporter.doubts()
            self._total += len(motions)
            for motion in motions:
                self._reporter.note(motion.summary)
                await self._step(
                    f"settle/{turn}/{motion.joint}",
                    f"moving joint {motion.joint} again",
                    partial(self._move_again, motion),
                    motion.joint,
                )
            if not motions:
                return

    async def _move_again(self, motion: NextMotion, serial: str) -> None:
        slow, home = self._plan.constant(), self._plan.home_rad
        others = {s: home + motion.others_rad for s in self._excluded.movers() if s != serial}
        if motion.others_rad:
            await self._go(others)
        await self._go({serial: home - 0.5 * motion.travel_rad(slow)})
        await self._observe(serial, motion.pattern(slow), "constant")
        await self._go({serial: home})
        if motion.others_rad:
            await self._go(dict.fromkeys(others, home))

    async def _explore_all(self) -> None:
        """Move all joints about home at the same time, each at its own frequencies (thesis 7.2)."""
        patterns = self._choice.simultaneous()
        # Of joints that were moved one by one as well, the estimates are there already.
        shown = patterns if self._plan.mode == "simultaneous" else ()
        showing = [asyncio.create_task(self._reporter.moving(tuple(shown)))] if shown else []
        try:
            records = await self.group.run(patterns)
        finally:
            for task in showing:
                task.cancel()
            await asyncio.gather(*showing, return_exceptions=True)
        for serial, record in records.items():
            self._note_motion("explore", serial, record, "whole")

    async def _explore_at_once(self) -> Sequence[str]:
        """Explore all joints at once; return those to be explored by themselves.

        These are all, if a module refuses to move along: of a joint that is held the regression of all IMUs
        on all joints tells nothing.
        """
        try:
            await self._step("explore", "exploring all joints at once", self._explore_all)
        except (Refused, MotionInterrupted) as error:
            if not self._excluded.without(error):
                raise
            self._reporter.note("exploring joint by joint: not all joints can move at once")
            await self._rearm_the_rest()
            return self._excluded.movers()
        return await self._single_joints() if self._single_joints is not None else ()

    async def _observe(self, serial: str, pattern: Pattern, purpose: Purpose) -> MotionRecord:
        record = await self._move(f"explore/{serial}", serial, pattern, purpose)
        for observer in self.group.serials:
            estimate = await self.group.estimate(observer, serial, record.motion_id, ESTIMATE_WAIT_S)
            if estimate is None:
                self._reporter.note(f"{observer} has no estimate of the {purpose} motion of {serial}")
            elif estimate.note:
                self._reporter.note(f"{observer} on joint {serial}: {estimate.note}")
        return record

    async def _show_inertia(self) -> None:
        """Excite all joints together if such motions can be designed, else joint by joint."""
        motions = await self._reporter.excitation() if self._excites_together() else ()
        serials = self._excluded.movers() if not motions else ()
        self._total += (len(motions) or 2 * len(serials)) - self._excitations(len(self.group.serials))
        if self._times is not None:
            self._times.excite(motions, serials)
        for number, motion in enumerate(motions):
            last = number == len(motions) - 1
            purpose: Purpose = "held_out" if last else "dynamic"
            text = "held-out motion of all joints" if last else f"exciting all joints, {number + 1}"
            work = partial(self._run_simultaneous, f"{purpose}/{number}", motion, purpose)
            await self._step(f"{purpose}/{number}", text, work)
            await self._share_information()
        for serial in serials:
            work = partial(self._excite, "dynamic", self._plan.dynamic)
            await self._step(f"excite/{serial}", f"exciting joint {serial}", work, serial)
            await self._share_information()
        for serial in serials:
            work = partial(self._excite, "held_out", self._plan.held_out)
            await self._step(f"held_out/{serial}", f"held-out motion of {serial}", work, serial)

    async def _share_information(self) -> None:
        if self._share is not None:
            await self._share()

    def _excitations(self, joints: int) -> int:
        """Return how many steps the plan takes to excite so many joints."""
        return 1 + self._plan.excitation_motions if self._plan.excitation == "d-optimal" else 2 * joints

    def _excites_together(self) -> bool:
        if self._plan.excitation != "d-optimal":
            return False
        if self._excluded.why:
            # The poses of excluded modules are fixed, and unknown to the design.
            self._reporter.note("exciting joint by joint: not all joints take part")
        return not self._excluded.why

    async def _run_simultaneous(self, step: str, motion: RobotMotion, purpose: Purpose) -> None:
        # The paths between home and the pose are checked for collisions, those between two poses are not.
        await self._go(motion.pose_rad)
        for serial, record in (await self.group.run(dict(motion.patterns))).items():
            self._note_motion(step, serial, record, purpose)
        await self._go(dict.fromkeys(motion.pose_rad, self._plan.home_rad))

    async def _excite(self, purpose: Purpose, motion: Callable[[ModuleType], Pattern], serial: str) -> None:
        step = "held_out" if purpose == "held_out" else "excite"
        await self._move(f"{step}/{serial}", serial, motion(self.group.kind(serial)), purpose)
        await self._go({serial: self._plan.home_rad})

    # ------------------------------------------------------------------ pieces

    async def _go(self, targets_rad: Mapping[str, float], speed_rad_s: float | None = None) -> None:
        speed = speed_rad_s or self._speed_rad_s
        await self.group.run({s: GoTo(target_rad=q, max_speed_rad_s=speed) for s, q in targets_rad.items()})
        await asyncio.sleep(self._plan.settle_s)

    async def _move(self, step: str, serial: str, pattern: Pattern, purpose: Purpose) -> MotionRecord:
        record = (await self.group.run({serial: pattern}))[serial]
        self._note_motion(step, serial, record, purpose)
        return record

    def _note_motion(self, step: str, serial: str, record: MotionRecord, purpose: Purpose) -> None:
        boot = self.group.module(serial).boot
        self._journal(
            JournalEvent(
                t_ns=self._clock(),
                what="motion",
                step=step,
                serial=serial,
                boot=boot,
                purpose=purpose,
                motion=record,
            )
        )

    def _position(self, serial: str) -> float:
        position_rad = self.group.position_rad(serial)
        return self._plan.home_rad if position_rad is None else position_rad

    def _allowed(self, serial: str, position_rad: float) -> float:
        """Return the position within a module's range: a joint may have stood, or fallen, outside of it."""
        limits = self.group.info(serial).limits
        low, high = limits.min_position_rad, limits.max_position_rad
        low, high = -math.inf if low is None else low, math.inf if high is None else high
        return min(max(position_rad, low), high)

    def _report(self, text: str) -> None:
        self._index += 1
        self._reporter.step(self._index, self._total, text, self._times.left_s if self._times else None)

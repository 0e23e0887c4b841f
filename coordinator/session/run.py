"""A whole identification run: session, recording, estimates, viewer and files, on any transport and clock."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from coordinator.baseline.baseline_robot import BaselineRobot, baseline_within, keep_baseline, load_baseline
from coordinator.baseline.difference import difference, joints_to_explore
from coordinator.baseline.update import updated
from coordinator.description.hrdf_writer import write_hrdf
from coordinator.description.urdf_writer import write_urdf
from coordinator.excitation.joint_limits import NoExcitation
from coordinator.excitation.plan import Plan
from coordinator.excitation.robot_excitation import RobotModule, robot_excitation
from coordinator.excitation.segment import RobotMotion
from coordinator.identification.identified import IdentificationError, Identified, Kinematics
from coordinator.identification.identify import identify, identify_kinematics, write_held_out
from coordinator.identification.inertia.agent_information import dynamic_steps
from coordinator.identification.inertia.inertia import Inertia
from coordinator.identification.preview import Preview, Previewer
from coordinator.identification.result import Result, write_result
from coordinator.identification.topology_search import doubtful_motions
from coordinator.live_robot.errors import ModuleLost
from coordinator.live_robot.messenger import Clock, Messenger, NoAnswer, Post, Refused
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.merge.information_file import RunInformation, write_information
from coordinator.parameter_fit.module_parts import likely_parts
from coordinator.parameter_fit.systematic_errors import error_directions
from coordinator.parameter_fit.torque_sensor_scale import SCALE_SIGMA
from coordinator.recording.journal import JournalEvent, standstill
from coordinator.recording.recording import JOURNAL_TOPIC, Entry, Recording
from coordinator.recording.run_folder import (
    HELD_OUT,
    HRDF,
    INFORMATION,
    RESULT,
    SESSION,
    URDF,
    VIEW,
    open_run_folder,
)
from coordinator.recording.session_file import SessionWriter, read_session
from coordinator.session.information_requests import InformationRequests
from coordinator.session.session import Session
from coordinator.synchronisation.motion_windows import INDEPENDENT_FRACTION
from coordinator.topology.next_motion import NextMotion
from coordinator.viewer.feed import Overlay, Screen, ViewerFeed
from coordinator.viewer.targets import ViewerTargets
from coordinator.viewer.viewer import Viewer
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.model.chain import Chain
from module_agent.model.errors import DataError, RobotError, UsageError
from module_agent.transport.transport import Transport
from module_agent.wire.messages import Message

T = TypeVar("T")
logger = logging.getLogger(__name__)


class RunConfig(NamedTuple):
    """What a run is told. `inline` computes on the event loop, as virtual time needs it.

    `refined_previews`: modules up to which the robot is refined, not only assembled, for every preview while
    it is being explored; None for any number, as in a thread beside the run it keeps nobody waiting.
    `baseline`: the folder of an earlier run of this robot. Then all joints are moved at once, and one by one
    only those next to what differs from that run.
    """

    robot: str
    out: Path
    sender: str
    plan: Plan = Plan()
    expect: int | None = None
    resume: bool = False
    spawn_viewer: bool = False
    connect_viewer: str | None = None
    serve_viewer: int | None = None
    inline: bool = False
    refined_previews: int | None = None
    baseline: Path | None = None


class Run:
    """One run in one folder.

    Raises:
        UsageError: a plan that leaves out what a run needs; a folder that is not to be used, or that tells no
            robot.
    """

    def __init__(
        self,
        config: RunConfig,
        transport: Transport,
        clock: Clock,
        post: Post,
        screen: Screen,
        overlay: Overlay | None = None,
    ):
        # Before anything is made of the new folder.
        if config.plan.topology_only:
            raise UsageError(
                "the plan sets topology_only, which leaves out the fast motions; a run identifies the chain "
                "too, and needs them: set it to false"
            )
        before = load_baseline(config.baseline) if config.baseline is not None and not config.resume else None
        crashed = open_run_folder(config.out, config.resume, config.robot)
        if before is not None:
            keep_baseline(before, config.out)
        self._known = before.kinematics if before is not None else baseline_within(config.out)
        if self._known is not None:
            config = config._replace(plan=config.plan.model_copy(update={"mode": "simultaneous"}))
        self._config = config
        self._clock = clock
        self._screen = screen
        self._crashed = crashed
        self._started_s = time.monotonic()
        self.recording = Recording()
        self._writer = SessionWriter(config.out / SESSION)
        targets = ViewerTargets(
            config.out / VIEW, config.spawn_viewer, config.connect_viewer, config.serve_viewer
        )
        viewer = Viewer(config.robot, config.out.name, targets, waits=config.inline)
        self._feed = ViewerFeed(viewer, self.recording, overlay)
        self._looks = Previewer(self.recording, config.refined_previews)
        self._looking: asyncio.Task[None] | None = None
        self._chain: Chain | None = None
        self._identified: Identified | None = None
        if crashed is not None:
            self._take_over(crashed)
        self._messenger = Messenger(transport, config.robot, clock, post, self._record)
        self._group = ModuleGroup(self._messenger, self.recording, clock, config.sender)
        self._torques = InformationRequests(self._messenger, self.recording, clock, config.sender, self.note)

    def _take_over(self, crashed: Path) -> None:
        try:
            for entry in read_session(crashed):
                self._record(entry)
            self._writer.flush()
        except BaseException:
            self._writer.close()
            self._feed.close()
            raise

    # ------------------------------------------------------------------ recording

    def _record(self, entry: Entry) -> Message | None:
        self._writer.write(entry)
        try:
            message = self.recording.add(entry)
        except RobotError:
            return None  # counted by the recording, by reason
        if isinstance(message, Message):
            self._feed.on_message(entry, message)
            return message
        return None

    def _journal(self, event: JournalEvent) -> None:
        entry = Entry("journal", JOURNAL_TOPIC, event.t_ns, event.encode())
        self._writer.write(entry)
        self.recording.add(entry)
        if event.what == "session":
            self._feed.since_start(event.t_ns)
        if event.what == "failed":
            self._feed.step(event.t_ns, event.text)

    # ------------------------------------------------------------------ reporter of the session

    def step(self, index: int, total: int, text: str) -> None:
        """Pass on that a step begins."""
        self._screen.step(index, total, text)
        self._feed.connected({s: self._group.kind(s).name for s in self._group.serials}, self._clock())
        self._feed.step(self._clock(), f"{index} of {total}: {text}")

    def note(self, text: str) -> None:
        """Pass on a line."""
        self._screen.note(text)

    def estimates(self, joint: str) -> None:
        """Show the local estimates of a joint, and the robot as far as it is known now."""
        self._feed.estimates(joint, self._clock())
        # Of a resumed run the joints of before too.
        explored = sorted({moved for moved, _ in self.recording.estimates})
        if self._config.inline:
            self._show_so_far(self._so_far(explored))
        elif self._looking is None or self._looking.done():
            # While the last look is still being worked out there is no other: the next joint brings one.
            self._looking = asyncio.create_task(self._look(explored))

    async def _look(self, explored: list[str]) -> None:
        self._show_so_far(await self._compute(lambda: self._so_far(explored)))

    def _so_far(self, explored: list[str]) -> Preview | None:
        """Return the robot as far as it is known; only to be looked at, so that a run does not fail by it."""
        try:
            return self._looks.look(explored)
        except (DataError, KeyError) as error:
            logger.info("nothing to show of the robot so far: %s", error)
        except Exception:
            # A run must not end for want of a picture.
            logger.exception("the robot so far could not be worked out")
        return None

    def _show_so_far(self, found: Preview | None) -> None:
        if found is not None:
            self._feed.preview(self._clock(), found)

    async def _looked(self) -> None:
        """Wait for a look that is still being worked out: what comes after it is newer."""
        if self._looking is not None:
            (failure,) = await asyncio.gather(self._looking, return_exceptions=True)
            if isinstance(failure, Exception):
                logger.warning("the robot so far could not be shown: %s", failure)

    async def doubts(self) -> tuple[NextMotion, ...]:
        """Look for doubts about the topology as soon as all joints are explored."""
        return await self._compute(lambda: doubtful_motions(self.recording))

    async def explored(self) -> None:
        """Assemble topology and chain as soon as all joints are explored, and show them."""
        await self._looked()
        found = await self._compute(lambda: self._revised(identify_kinematics(self.recording)))
        self._chain = found.fit.chain
        self._feed.chain(self._clock(), found.fit)
        for line in found.words():
            self._screen.note(line)

    async def excitation(self) -> tuple[RobotMotion, ...]:
        """Design motions of all joints at once for the chain that has just been found."""
        assert self._chain is not None, "all joints are explored before any is excited"
        chain, plan = self._chain, self._config.plan
        modules = [RobotModule(self._group.kind(s), self._group.info(s).limits) for s in chain.serials]
        try:
            return await self._compute(lambda: robot_excitation(chain, modules, plan))
        except NoExcitation as error:
            self._screen.note(f"{error}; exciting joint by joint instead")
            return ()

    async def _closer(self) -> Sequence[str]:
        """Return the joints next to what is other about a known robot, by a glance at all of it."""
        found = await self._compute(lambda: identify_kinematics(self.recording))
        if self._known is None:
            return ()
        other = difference(self._known.topology, found.topology)
        for line in other.summary():
            self._screen.note(line)
        return joints_to_explore(found.topology, other)

    def _revised(self, found: Kinematics) -> Kinematics:
        return updated(self._known, found) if self._known is not None else found

    # ------------------------------------------------------------------ the run

    async def run(self) -> Result:
        """Run to the end and write the files; on any error what was recorded is complete on disk."""
        config = self._config
        try:
            self._messenger.start()
            self._journal(
                JournalEvent(
                    t_ns=self._clock(),
                    what="session",
                    robot=config.robot,
                    imu=config.plan.imu,
                    torque=config.plan.torque,
                )
            )
            closer = self._closer if self._known is not None else None
            session = Session(
                self._group,
                self._messenger,
                self.recording,
                config.plan,
                self._clock,
                self._journal,
                self,
                closer,
                lambda: self._torques.collect(self._group.serials),
            )
            await session.run(config.expect)
            kinematics = await self._ask_torques()
            self._journal(
                JournalEvent(
                    t_ns=self._clock(), what="finished", wall_time_s=time.monotonic() - self._started_s
                )
            )
            # Nothing more is recorded from here on: a replay must see exactly what this result is made of.
            self._messenger.close()
            self._writer.close()
            self._screen.note("estimating")
            found = await self._compute(lambda: identify(self.recording, self._revised, kinematics))
            self._write(found)
            self._identified = found
            for line in found.inertia.summary() if found.inertia is not None else ():
                self._screen.note(line)
            if self._crashed is not None:
                self._crashed.unlink()
            return found.result
        finally:
            self._messenger.close()
            self._writer.close()
            await self._looked()
            self._feed.close()
            if self._messenger.dropped:
                self._screen.note(
                    f"{self._messenger.dropped} messages were dropped unread: this machine is too slow"
                )

    async def _ask_torques(self) -> Kinematics | None:
        """Ask the agents what their torques say, of the robot as it is known at last; return that robot.

        Nothing moves any more, and whatever does not come is computed from the recording instead.
        """
        if not dynamic_steps(self.recording):
            return None
        self._journal(JournalEvent(t_ns=self._clock(), what="settled"))
        try:
            found = await self._compute(lambda: self._revised(identify_kinematics(self.recording)))
        except IdentificationError:
            return None  # said when everything is identified, and the recording is whole
        await self._torques.ask(found.fit.chain, found.clocks)
        with contextlib.suppress(NoAnswer, Refused, ModuleLost):
            await self._group.close_gaps()
        return found

    @property
    def robot(self) -> BaselineRobot:
        """The robot as this run identified it, once it has ended."""
        assert self._identified is not None, "the run has not ended"
        return BaselineRobot(self._config.out, self.recording, self._identified.kinematics)

    @property
    def standstill(self) -> str:
        """What is known of the robot after a run that ended before its end, in words."""
        return standstill(self.recording.journal)

    async def _compute(self, work: Callable[[], T]) -> T:
        if self._config.inline:
            return work()
        return await asyncio.to_thread(work)

    def _write(self, found: Identified) -> None:
        out = self._config.out
        write_outputs(out, found)
        self._feed.chain(self._clock(), found.kinematics.fit)
        if found.held_out is not None:
            self._feed.held_out(found.held_out)
        self._feed.step(self._clock(), "done")


def write_outputs(out: Path, found: Identified) -> None:
    """Write everything that follows from a recording into a folder, each file whole or not at all."""
    write_result(out / RESULT, found.result)
    phi = found.real_phi
    types = [module_type(found.result.types[s]) for s in found.result.serials]
    write_urdf(out / URDF, found.kinematics.fit.chain, phi, found.result.robot, types)
    write_hrdf(out / HRDF, found.kinematics.fit.chain, types, phi, found.result.robot)
    if found.held_out is not None:
        write_held_out(out / HELD_OUT, found.held_out)
    if found.inertia is not None:
        write_information(out / INFORMATION, _information(out.name, found, found.inertia, types))


def _information(
    name: str, found: Identified, inertia: Inertia, types: Sequence[ModuleType]
) -> RunInformation:
    seen, fit = inertia.instrumental, found.kinematics.fit
    # Of the scales' effects what is known beforehand is kept, which several runs share.
    effects = tuple(one[:, len(types) :] for one in inertia.effects)
    directions = error_directions(fit.covariance)
    # Offsets of the sensors, whose effects come last, move no chain.
    directions = np.hstack([directions, np.zeros((len(directions), len(types)))])
    return RunInformation(
        name=name,
        session=found.result.trace_hash,
        chain=fit.chain,
        joints=seen.information,
        sigma_nm=seen.fit.torque_sigma_nm,
        independent_fraction=INDEPENDENT_FRACTION,
        phi_parts=likely_parts(fit.chain, types, seen.informed_phi),
        directions=directions,
        effects=effects,
        scale=seen.scale.value,
        scale_sigma=SCALE_SIGMA["uncalibrated" if seen.scale.covariance.any() else "calibrated"],
    )

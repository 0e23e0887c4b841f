"""An identification run: session, recording, estimates, viewer and files, on any transport and clock."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from coordinator.baseline.baseline_robot import (
    BaselineRobot,
    baseline_within,
    keep_baseline,
    load_baseline,
    measured_before_run,
)
from coordinator.baseline.difference import difference, joints_to_explore
from coordinator.description.hrdf_writer import write_hrdf
from coordinator.description.srdf_writer import write_srdf
from coordinator.description.urdf_writer import write_urdf
from coordinator.excitation.joint_limits import NoExcitation
from coordinator.excitation.plan import Plan
from coordinator.excitation.robot_excitation import RobotModule, robot_excitation
from coordinator.excitation.segment import RobotMotion
from coordinator.identification.identified import IdentificationError, Identified, Kinematics
from coordinator.identification.identify import (
    identify,
    identify_kinematics,
    identify_topology,
    write_held_out,
)
from coordinator.identification.inertia.agent_information import dynamic_steps
from coordinator.identification.inertia.inertia import Inertia
from coordinator.identification.preview import Preview, Previewer
from coordinator.identification.result import Result, write_result
from coordinator.identification.topology_search import doubtful_motions
from coordinator.live_robot.errors import ModuleLost
from coordinator.live_robot.messenger import COALESCED_S, Clock, Messenger, NoAnswer, Post, Refused, Sender
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.merge.calibration_file import each_once, read_calibration, write_calibration
from coordinator.merge.information_file import RunInformation, write_information
from coordinator.parameter_fit.module_parts import likely_parts
from coordinator.parameter_fit.systematic_errors import error_directions
from coordinator.parameter_fit.torque_sensor_scale import SCALE_SIGMA
from coordinator.recording.journal import JournalEvent, standstill
from coordinator.recording.recording import JOURNAL_TOPIC, MAX_MODULES, Entry, Recording
from coordinator.recording.run_folder import (
    CALIBRATION,
    HELD_OUT,
    HRDF,
    INFORMATION,
    MEASURED,
    RESULT,
    SESSION,
    SRDF,
    URDF,
    VIEW,
    open_run_folder,
)
from coordinator.recording.session_file import SessionWriter, read_session
from coordinator.recording.versions import current_run
from coordinator.report.plots import MissingPlots
from coordinator.report.run_report import result_markdown, write_report
from coordinator.session.information_requests import InformationRequests
from coordinator.session.session import Session
from coordinator.synchronisation.motion_windows import INDEPENDENT_FRACTION
from coordinator.topology.next_motion import NextMotion
from coordinator.viewer.feed import Overlay, Screen, ViewerFeed
from coordinator.viewer.targets import ViewerTargets
from coordinator.viewer.viewer import Viewer
from module_agent.model.catalogue import ModuleType, module_type
from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError, UsageError
from module_agent.transport.transport import Transport
from module_agent.wire.messages import Message, Pattern

# While all joints move at once a preview is asked for so often. Previews are as seldom as keeps them to a
# share of the time: as much of one processor is left to network and recording, whatever the robot's size.
PREVIEW_EVERY_S = 2.0
PREVIEW_SHARE = 0.25

T = TypeVar("T")
logger = logging.getLogger(__name__)


class MotionGate(Protocol):
    """What a robot may do, whatever the plan says."""

    def admit(self, patterns: Mapping[str, Pattern], at_rad: Mapping[str, float]) -> None:
        """Let motions pass that begin together at positions of all joints.

        Raises:
            MotionForbidden: they would leave what the robot may use.
        """
        ...

    def learn(self, chain: Chain) -> None:
        """Take in the robot as it was explored."""
        ...

    def allows(self, q_rad: Array) -> bool:
        """Return whether the robot may be at positions (m, n), in the order of the chain learnt last."""
        ...


class RunConfig(NamedTuple):
    """Settings of a run.

    inline: compute on the event loop, as virtual time needs it, instead of in a thread.
    refined_previews: modules up to which previews are refined, not only assembled; None for any number.
    baseline: the folder of an earlier run of this robot. Then all joints are moved at once, and one by one
    only those next to a difference from that run.
    measured: folders of runs or merges with some of the modules, whose IMUs are known as well as they tell.
    report: write a page for people into the folder, of a run that ends early too.
    max_bytes: of the recording; a run that reaches it stops the robot and ends.
    gate: every motion passes it before it is commanded; None if the robot may do all that is planned.
    keeps_view: write what the viewer shows into the folder.
    """

    robot: str
    out: Path
    sender: Sender
    plan: Plan = Plan()
    expect: int | None = None
    resume: bool = False
    viewer: ViewerTargets = ViewerTargets()
    inline: bool = False
    refined_previews: int | None = None
    baseline: Path | None = None
    measured: tuple[Path, ...] = ()
    report: bool = False
    max_bytes: int | None = None
    gate: MotionGate | None = None
    keeps_view: bool = True


class _Undisturbed:
    """A screen whose terminal may be gone: what cannot be shown must not end a session that moves a robot."""

    def __init__(self, screen: Screen):
        self._screen = screen

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        """Show that a step begins, and how long all that is left takes, as far as the plan tells."""
        with contextlib.suppress(OSError, ValueError):
            self._screen.step(index, total, text, left_s)

    def note(self, text: str) -> None:
        """Show a line of text."""
        with contextlib.suppress(OSError, ValueError):
            self._screen.note(text)


class Run:
    """One run in one folder.

    Raises:
        UsageError: the plan leaves out motions that a run needs; the folder is in use; the baseline holds no
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
        # Before the new folder is made.
        if config.plan.topology_only:
            raise UsageError(
                "the plan sets topology_only, which leaves out the fast motions; a run identifies the chain "
                "too, and needs them: set it to false"
            )
        before = load_baseline(config.baseline) if config.baseline is not None and not config.resume else None
        earlier = each_once(
            one for run in config.measured for one in read_calibration(current_run(run) / CALIBRATION)
        )
        crashed = open_run_folder(config.out, config.resume, config.robot)
        if earlier:
            write_calibration(config.out / MEASURED, earlier)
        if before is not None:
            keep_baseline(before, config.out)
        self._baseline = before if before is not None else baseline_within(config.out)
        self._measured = measured_before_run(config.out, self._baseline)
        if self._baseline is not None:
            config = config._replace(plan=config.plan.model_copy(update={"mode": "simultaneous"}))
        self._config = config
        self._clock = clock
        self._screen = _Undisturbed(screen)
        self._crashed = crashed
        self._started_s = time.monotonic()
        self.recording = Recording()
        self._writer = SessionWriter(config.out / SESSION, config.max_bytes)
        self._session: asyncio.Task[Any] | None = None
        targets = config.viewer._replace(rrd=config.out / VIEW) if config.keeps_view else config.viewer
        viewer = Viewer(config.robot, config.out.name, targets, waits=config.inline)
        self._feed = ViewerFeed(viewer, self.recording, overlay)
        self._previewer = Previewer(self.recording, config.refined_previews)
        self._preview_task: asyncio.Task[None] | None = None
        self._wanted_preview: Callable[[], Preview | None] | None = None
        self._next_preview_ns = 0
        self._chain: Chain | None = None
        self._explored: Kinematics | None = None
        self._identified: Identified | None = None
        if crashed is not None:
            self._take_over(crashed)
        # Virtual time has no cost of its own that would be one of the machine's, and nothing there has to be
        # woken.
        cpu_clock, coalesced_s = (None, None) if config.inline else (time.thread_time_ns, COALESCED_S)
        self._messenger = Messenger(
            *(transport, config.robot, clock, post, self._record),
            cpu_clock=cpu_clock,
            coalesced_s=coalesced_s,
        )
        gate = config.gate.admit if config.gate is not None else None
        self._group = ModuleGroup(self._messenger, self.recording, clock, config.sender, gate)
        self._requests = InformationRequests(
            self._messenger, self.recording, clock, config.sender.name, self.note
        )

    def _take_over(self, crashed: Path) -> None:
        try:
            for entry in read_session(crashed, self.recording.damage.append):
                self._record(entry)
            for damage in self.recording.damage:
                self.note(damage)
            self._writer.flush()
            if self._writer.failure is not None:
                raise self._writer.failure
        except BaseException:
            self._writer.close()
            self._feed.close()
            raise

    # ------------------------------------------------------------------ recording

    def _record(self, entry: Entry) -> Message | None:
        # What a replay does not read is not part of the result either.
        if not self._write(entry):
            return None
        message = self.recording.accept(entry)
        if message is not None:
            self._feed.on_message(entry, message)
        return message

    def _write(self, entry: Entry) -> bool:
        """Write an entry, False if it is left out; where nothing can be recorded, end the session.

        The session stops the robot first.
        """
        is_taken = self._writer.write(entry)
        if self._writer.failure is not None and self._session is not None:
            session, self._session = self._session, None
            session.cancel(str(self._writer.failure))
        return is_taken

    def _journal(self, event: JournalEvent) -> None:
        entry = Entry("journal", JOURNAL_TOPIC, event.t_ns, event.encode())
        self._write(entry)
        self.recording.add(entry)
        if event.what == "session":
            self._feed.begin(event.t_ns)
        if event.what == "failed":
            self._feed.step(event.t_ns, event.text)

    # ------------------------------------------------------------------ reporter of the session

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        """Show that a step begins, and how long all that is left takes, as far as the plan tells."""
        self._screen.step(index, total, text, left_s)
        self._feed.connected({s: self._group.kind(s).name for s in self._group.serials}, self._clock())
        self._feed.step(self._clock(), f"{index} of {total}: {text}")

    def note(self, text: str) -> None:
        """Show a line of text, in the viewer's log as well."""
        self._screen.note(text)
        self._feed.note(self._clock(), text)

    def estimates(self, joint: str) -> None:
        """Show the modules' estimates of a joint, and a preview of the robot."""
        self._feed.estimates(joint, self._clock())
        # Of a resumed run also the joints explored before.
        explored = sorted({moved for moved, _ in self.recording.estimates})
        self._begin_preview(lambda: self._previewer.preview(explored))

    async def moving(self, serials: Sequence[str]) -> None:
        """Show previews of a robot that moves all its joints at once, until cancelled."""
        while True:
            await asyncio.sleep(PREVIEW_EVERY_S)
            motion = self._group.running(serials[0])
            if motion is not None:
                event = JournalEvent(
                    t_ns=self._clock(), what="motion", serial=serials[0], purpose="whole", motion=motion
                )
                self._begin_preview(partial(self._previewer.preview_of_all, event, serials))

    def _begin_preview(self, work: Callable[[], Preview | None]) -> None:
        """Show a preview: in virtual time at once, else when it is time for one, if no other is asked for."""
        if self._config.inline:
            self._show_preview(self._preview(work))
        else:
            self._wanted_preview = work
            self._begin_wanted_preview()

    def _begin_wanted_preview(self) -> None:
        """Begin what was asked for last, unless a preview is being computed; if it is too early, later."""
        work = self._wanted_preview
        if work is None or not self._may_preview():
            return
        early_s = 1e-9 * (self._next_preview_ns - self._clock())
        if early_s > 0.0:
            asyncio.get_running_loop().call_later(early_s, self._begin_wanted_preview)
            return
        self._wanted_preview = None
        self._preview_task = asyncio.create_task(self._show_preview_later(work))
        self._preview_task.add_done_callback(lambda _: self._begin_wanted_preview())

    def _may_preview(self) -> bool:
        """Return whether no preview is being computed, and none has failed: its error is yet to be raised."""
        task = self._preview_task
        return task is None or (task.done() and not task.cancelled() and task.exception() is None)

    async def _show_preview_later(self, work: Callable[[], Preview | None]) -> None:
        began_ns = self._clock()
        preview = await self._compute(lambda: self._preview(work))
        self._next_preview_ns = began_ns + int((self._clock() - began_ns) / PREVIEW_SHARE)
        self._show_preview(preview)

    def _preview(self, work: Callable[[], Preview | None]) -> Preview | None:
        """Return a preview of the robot, None if the data do not give one: a run goes on without."""
        try:
            return work()
        except DataError as error:
            logger.info("no preview of the robot: %s", error)
        return None

    def _show_preview(self, preview: Preview | None) -> None:
        if preview is not None:
            self._feed.preview(self._clock(), preview)

    async def _await_preview(self) -> None:
        """Wait for a preview that is still being computed, so that it does not replace a newer chain.

        One that waits for its time is dropped. What a preview raised is a defect of ours, and raised here.
        """
        self._wanted_preview = None
        task = self._preview_task
        if task is not None:
            await asyncio.wait([task])
            self._preview_task = None
            if not task.cancelled():
                task.result()

    async def doubts(self) -> tuple[NextMotion, ...]:
        """Return the motions to repeat to settle doubts about the topology."""
        return await self._compute(lambda: doubtful_motions(self.recording))

    async def explored(self) -> None:
        """Identify topology and chain, and show them."""
        await self._await_preview()
        self._journal(JournalEvent(t_ns=self._clock(), what="explored"))
        so_far = self.recording.explored
        assert so_far is not None, "the recording has the event that was just added"
        explored = await self._compute(lambda: identify_kinematics(so_far, self._measured))
        self._explored = explored
        kinematics = await self._compute(lambda: self._with_baseline(explored))
        self._chain = kinematics.fit.chain
        if self._config.gate is not None:
            self._config.gate.learn(self._chain)
        self._feed.chain(self._clock(), kinematics.fit)
        for line in kinematics.summary():
            self.note(line)

    async def excitation(self) -> tuple[RobotMotion, ...]:
        """Design excitation motions of all joints at once for the identified chain; none if it is suspect."""
        assert self._chain is not None, "all joints are explored before any is excited"
        if self._explored is not None and self._explored.suspicions:
            self.note("exciting joint by joint: what was explored is not to be believed as usual")
            return ()
        chain, plan, gate = self._chain, self._config.plan, self._config.gate
        allowed = None if gate is None else gate.allows
        modules = [RobotModule(self._group.kind(s), self._group.info(s).limits) for s in chain.serials]
        try:
            return await self._compute(lambda: robot_excitation(chain, modules, plan, allowed=allowed))
        except NoExcitation as error:
            self.note(f"{error}; exciting joint by joint instead")
            return ()

    async def _single_joints(self) -> Sequence[str]:
        """Return the joints to explore one by one: those next to a difference from the baseline."""
        topology = await self._compute(lambda: identify_topology(self.recording))
        if self._baseline is None:
            return ()
        changes = difference(self._baseline.kinematics.topology, topology)
        for line in changes.summary():
            self.note(line)
        return joints_to_explore(topology, changes)

    async def _kinematics(self) -> Kinematics:
        return await self._compute(
            lambda: self._with_baseline(identify_kinematics(self.recording, self._measured, self._explored))
        )

    def _with_baseline(self, kinematics: Kinematics) -> Kinematics:
        return self._baseline.updated(kinematics) if self._baseline is not None else kinematics

    # ------------------------------------------------------------------ the run

    async def run(self) -> Result:
        """Run to the end and write the files; on any error the recording on disk is complete."""
        try:
            self._messenger.start()
            kinematics = await self._record_session()
            return await self._evaluate(kinematics)
        finally:
            self._messenger.close()
            self._writer.close()
            try:
                await self._await_preview()
            finally:
                self._feed.close()
                self._write_report()
                if self._messenger.dropped:
                    self._screen.note(
                        f"{self._messenger.dropped} messages were dropped unread: this machine is too slow"
                    )
                if self._writer.unrecorded:
                    self._screen.note(
                        f"{self._writer.unrecorded} messages were not recorded: more than {MAX_MODULES} "
                        "serials publish, most of which are made up; see docs/security.md"
                    )

    async def _record_session(self) -> Kinematics | None:
        """Let the session go through and end its recording; return the kinematics that agents were told.

        Raises:
            NotRecorded: not all of it could be recorded.
        """
        config = self._config
        self._journal(
            JournalEvent(
                t_ns=self._clock(),
                what="session",
                robot=config.robot,
                imu=config.plan.imu,
                torque=config.plan.torque,
            )
        )
        session = Session(
            self._group,
            self._messenger,
            self.recording,
            config.plan,
            self._clock,
            self._journal,
            self,
            self._single_joints if self._baseline is not None else None,
            lambda: self._requests.collect(self._group.serials),
        )
        await self._recorded(session.run(config.expect))
        kinematics = await self._request_information()
        self._journal(
            JournalEvent(
                t_ns=self._clock(),
                what="finished",
                wall_time_s=time.monotonic() - self._started_s,
                cpu_us_per_message=self._messenger.cpu_us_per_message,
            )
        )
        # Nothing more is recorded: a replay must read exactly what this result is computed from.
        self._messenger.close()
        self._writer.close()
        if self._writer.failure is not None:
            raise self._writer.failure
        return kinematics

    async def _evaluate(self, kinematics: Kinematics | None) -> Result:
        """Identify the robot from the recording, write the outputs and show the result."""
        self.note("estimating")
        identified = await self._compute(
            lambda: identify(
                self.recording,
                revise=self._with_baseline,
                kinematics=kinematics,
                measured=self._measured,
                explored=self._explored,
            )
        )
        write_outputs(self._config.out, identified)
        self._feed.chain(self._clock(), identified.kinematics.fit)
        if identified.held_out is not None:
            self._feed.held_out(identified.held_out)
        self._feed.result(self._clock(), result_markdown(identified.result))
        why = "; ".join(identified.result.suspicions)
        doubt = f"; the result is not to be believed as usual: {why}" if why else ""
        self._feed.step(self._clock(), f"done{doubt}")
        self._identified = identified
        for line in identified.inertia.summary() if identified.inertia is not None else ():
            self.note(line)
        if self._crashed is not None:
            self._crashed.unlink()
        return identified.result

    async def _recorded(self, session: Coroutine[None, None, None]) -> None:
        """Await a session as long as it can be recorded.

        Raises:
            NotRecorded: it cannot any more; the session has stopped the robot.
        """
        self._session = asyncio.current_task()
        try:
            await session
        except asyncio.CancelledError:
            if self._writer.failure is not None:
                raise self._writer.failure from None
            raise
        finally:
            self._session = None

    def _write_report(self) -> None:
        """Write the report of what there is; a run does not fail for want of plots or of disk space."""
        if not self._config.report or not self.recording.modules:
            return
        result = self._identified.result if self._identified is not None else None
        try:
            write_report(self._config.out, self.recording, result)
        except (MissingPlots, OSError) as error:
            self._screen.note(f"no report: {error}")

    async def _request_information(self) -> Kinematics | None:
        """Request the agents' torque information for the identified kinematics; return these kinematics.

        Nothing moves any more. Information that does not come is computed from the recording instead.
        """
        if not dynamic_steps(self.recording):
            return None
        self._journal(JournalEvent(t_ns=self._clock(), what="settled"))
        try:
            kinematics = await self._kinematics()
        except IdentificationError:
            return None  # reported when everything is identified from the complete recording
        if kinematics.dynamic:
            await self._requests.ask(kinematics.fit.chain, kinematics.clocks)
        with contextlib.suppress(NoAnswer, Refused, ModuleLost):
            await self._group.close_gaps()
        return kinematics

    @property
    def robot(self) -> BaselineRobot:
        """The robot as this run identified it, once it has ended."""
        assert self._identified is not None, "the run has not ended"
        return BaselineRobot(self._config.out, self.recording, self._identified.kinematics)

    @property
    def standstill(self) -> str:
        """What is known of the robot's motion after a run that failed, as a sentence."""
        return standstill(self.recording.journal)

    async def _compute(self, work: Callable[[], T]) -> T:
        if self._config.inline:
            return work()
        return await asyncio.to_thread(work)


def write_outputs(out: Path, identified: Identified) -> None:
    """Write all files computed from a recording into a folder, each whole or not at all."""
    write_result(out / RESULT, identified.result)
    write_calibration(out / CALIBRATION, identified.calibrations)
    phi = identified.real_phi
    types = [module_type(identified.result.types[s]) for s in identified.result.serials]
    chain, name, dynamics = (
        identified.kinematics.fit.chain,
        identified.result.robot,
        identified.result.dynamics,
    )
    undetermined = dynamics.undetermined if dynamics is not None else {}
    write_urdf(out / URDF, chain, phi, name, types, undetermined, identified.result.unknown_links)
    write_srdf(out / SRDF, out / URDF)
    write_hrdf(out / HRDF, chain, types, phi, name, undetermined)
    # An earlier evaluation may have known inertia that this one withholds.
    if identified.held_out is not None:
        write_held_out(out / HELD_OUT, identified.held_out)
    else:
        (out / HELD_OUT).unlink(missing_ok=True)
    if identified.inertia is not None:
        write_information(out / INFORMATION, _information(out.name, identified, identified.inertia, types))
    else:
        (out / INFORMATION).unlink(missing_ok=True)


def _information(
    name: str, identified: Identified, inertia: Inertia, types: Sequence[ModuleType]
) -> RunInformation:
    instrumental, fit = inertia.instrumental, identified.kinematics.fit
    # Of the scales' effects those of the prior remain: several runs share them.
    effects = tuple(one[:, len(types) :] for one in inertia.effects)
    directions = error_directions(fit.covariance)
    # Offsets of the sensors, whose effects come last, do not move the chain.
    directions = np.hstack([directions, np.zeros((len(directions), len(types)))])
    return RunInformation(
        name=name,
        session=identified.result.trace_hash,
        chain=fit.chain,
        joints=instrumental.information,
        sigma_nm=instrumental.fit.torque_sigma_nm,
        independent_fraction=INDEPENDENT_FRACTION,
        phi_parts=likely_parts(fit.chain, types, instrumental.informed_phi),
        directions=directions,
        effects=effects,
        scale=instrumental.scale.value,
        scale_sigma=SCALE_SIGMA["uncalibrated" if instrumental.scale.covariance.any() else "calibrated"],
    )

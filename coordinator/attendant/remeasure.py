"""Measuring a robot again: which run shows what has changed, and whether it did.

What came, went or was exchanged, and what the robot carries, are measured on top of the known robot: one
motion of all joints, the joints next to a difference, and the inertia. Links are measured by all joints, with
the motions that the robot is known from, so that `check` compares like with like; only what is known of the
IMUs is taken over, for a link that is displaced is not where the known robot says.
"""

from pathlib import Path
from typing import NamedTuple

from coordinator.attendant.attend_session import Measured, Site
from coordinator.attendant.attendant import Aim, Measurement, Outcome
from coordinator.attendant.workspace import Workspace, WorkspaceGate
from coordinator.baseline.baseline_robot import BASELINE, BaselineRobot
from coordinator.baseline.check import check, check_plan
from coordinator.baseline.difference import difference
from coordinator.baseline.payload import payload_plan, search_payload
from coordinator.excitation.plan import Plan
from coordinator.identification.result import Result
from coordinator.live_robot.messenger import Sender
from coordinator.recording.versions import Versions
from coordinator.session.run import Run, RunConfig
from coordinator.viewer.feed import Screen
from module_agent.model.errors import RobotError, named_files
from module_agent.wire.messages import MAX_NAME

# Of the motions for the inertia; with them a run lasts as long as a monitor needs to know what is normal.
INERTIA = {"excitation": "d-optimal", "excitation_motions": 4, "excitation_s": 4.0}
# A version on top of a version holds the recordings of both, and is identified from all: so many, then anew.
MAX_NESTED = 3


class Changed(NamedTuple):
    """Whether a measurement shows that the robot is not the known one, and in words what it shows."""

    changed: bool
    words: tuple[str, ...]


class Remeasurement:
    """Measures one robot within a workspace, and keeps its versions."""

    def __init__(
        self,
        site: Site,
        versions: Versions,
        workspace: Workspace,
        screen: Screen,
        plan: Plan = Plan(),  # noqa: B008
    ):
        self._site = site
        self._versions = versions
        self._workspace = workspace
        self._screen = screen
        self._plan = plan

    async def measure(self, wanted: Measurement, known: BaselineRobot) -> Measured:
        """Run a session that shows what has changed; make it the current version if something has.

        A measurement that fails, or cannot be written, is noted in the history, and leaves the version that
        holds.
        """
        out = self._versions.next_run()
        try:
            with named_files():
                return await self._measured(wanted, known, out)
        except RobotError as error:
            return Measured(Outcome("failed", (str(error), *self._failed(wanted, out, error))), known)

    def _failed(self, wanted: Measurement, out: Path, error: RobotError) -> tuple[str, ...]:
        """Note a measurement that failed; return what there is to say of it, where it cannot be noted."""
        try:
            with named_files():
                self._versions.note("failed", int(out.name), self._site.utc(), wanted.why, [str(error)])
        except RobotError as unwritten:
            return (f"not noted in the history: {unwritten}",)
        return ()

    async def _measured(self, wanted: Measurement, known: BaselineRobot, out: Path) -> Measured:
        """Measure into a folder; see `measure`.

        Raises:
            RobotError: it failed.
            OSError: a file cannot be written.
        """
        versions, number = self._versions, int(out.name)
        aim = "links" if _nested(known.folder) >= MAX_NESTED else wanted.aim
        result, later = await self._run(aim, wanted, known, out)
        found = await self._site.compute(lambda: changes(aim, known, later))
        if result.suspicions:
            raise SuspectMeasurement("; ".join(result.suspicions))
        if not found.changed:
            versions.note("confirmed", number, self._site.utc(), wanted.why, found.words)
            words = (f"measured again: version {versions.current_number} holds", *found.words)
            return Measured(Outcome("confirmed", words), known)
        versions.replace(number, self._site.utc(), wanted.why, found.words)
        words = (f"measured again: version {number} is the model from now on", *found.words)
        return Measured(Outcome("replaced", words), later)

    def _sender(self, out: Path) -> Sender:
        """Return a name of its own for a measurement: requests of a connection are numbered from 1 on."""
        name, secret = self._site.sender
        return Sender(f"{name[: MAX_NAME - len(out.name) - 1]}-{out.name}", secret)

    async def _run(
        self, aim: Aim, wanted: Measurement, known: BaselineRobot, out: Path
    ) -> tuple[Result, BaselineRobot]:
        plan = self._workspace.plan(measuring_plan(aim, known, self._plan), wanted.modules)
        gate = WorkspaceGate(self._workspace, known.chain, plan.home_rad, wanted.modules)
        config = RunConfig(
            robot=self._site.robot,
            out=out,
            sender=self._sender(out),
            plan=plan,
            expect=len(wanted.modules),
            inline=self._site.inline,
            refined_previews=0,
            baseline=None if aim == "links" else known.folder,
            measured=(known.folder,) if aim == "links" else (),
            gate=gate,
        )
        site = self._site

        def prepared() -> Run:
            transport = site.connect()
            try:
                return Run(config, transport, site.clock, site.post, self._screen)
            except BaseException:
                transport.close()
                raise

        run = await site.compute(prepared)
        return await run.run(), run.robot


class SuspectMeasurement(RobotError):
    """The robot was measured again, and the result is suspect; the message says why."""


def measuring_plan(aim: Aim, known: BaselineRobot, plan: Plan) -> Plan:
    """Return the plan of a run that measures a known robot again, inertia included."""
    short = check_plan(known, plan) if aim == "links" else payload_plan(known, plan)
    return Plan.model_validate({**short.model_dump(), **INERTIA, "dynamics": True})


def changes(aim: Aim, known: BaselineRobot, later: BaselineRobot) -> Changed:
    """Return what differs between the known robot and the same one measured again.

    Raises:
        CheckError, PayloadError: the two cannot be compared.
    """
    modules = difference(known.kinematics.topology, later.kinematics.topology)
    if not modules.nothing:
        return Changed(True, tuple(modules.summary()))
    links = check(known, later) if aim == "links" else None
    if links is not None and links.changed:
        return Changed(True, tuple(links.summary))
    load = search_payload(known, later)
    words = (*(links.summary if links is not None else ()), *load.summary)
    return Changed(load.found or not load.explained, words)


def _nested(folder: Path) -> int:
    """Return on how many earlier recordings a version rests."""
    count = 0
    while (folder := folder / BASELINE).is_dir():
        count += 1
    return count

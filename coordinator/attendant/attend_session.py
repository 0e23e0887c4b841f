"""An attendant at a robot on a network, real or virtual: it looks, says what has changed, and measures again.

A watch and a measurement take turns, each on a connection of its own: the monitor compares a robot with the
model that holds, and while the robot is measured there is none.
"""

import asyncio
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeVar

from coordinator.attendant.attendant import Attendant, Measurement, Observation, Outcome, Patience, Step
from coordinator.baseline.baseline_robot import BaselineRobot, load_baseline
from coordinator.live_robot.messenger import COALESCED_S, Clock, Messenger, Post, Sender
from coordinator.monitoring.findings import Finding
from coordinator.monitoring.live import LiveMonitor
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from coordinator.monitoring.reference import ALARMS_PER_HOUR, Reference, UnsuitableBaseline, build_reference
from coordinator.recording.recording import Recording
from coordinator.recording.versions import Versions
from module_agent.transport.transport import Transport

# A change of the model is in no hurry: a tenth of what a monitor of collisions looks.
LOOK_S = 0.25

T = TypeVar("T")


class Listener(Protocol):
    """Is told what the attendant says, and what its monitor finds."""

    def say(self, text: str, t_ns: int) -> None:
        """Take a sentence of the attendant."""
        ...

    def warn(self, text: str, t_ns: int) -> None:
        """Take a warning that the robot is about to move: it must reach people who asked for quiet, too."""
        ...

    def report(self, update: MonitorUpdate) -> None:
        """Take what the monitor reports."""
        ...


class Site(NamedTuple):
    """Where the attendant works: the robot's name, its network and clock, and this program's name.

    connect: a new connection to the robot's network. utc: the date and time, ISO 8601. inline: compute on the
    event loop, as virtual time needs it, instead of in a thread.
    """

    robot: str
    connect: Callable[[], Transport]
    clock: Clock
    post: Post
    sender: Sender
    utc: Callable[[], str]
    inline: bool = False

    async def compute(self, work: Callable[[], T]) -> T:
        """Return the result of long work."""
        return work() if self.inline else await asyncio.to_thread(work)


class Measured(NamedTuple):
    """How a measurement ended, and the robot as it is known from then on."""

    outcome: Outcome
    known: BaselineRobot


class Measurer(Protocol):
    """Measures a robot again."""

    async def measure(self, wanted: Measurement, known: BaselineRobot) -> Measured:
        """Measure; a failure is an outcome, and raises nothing."""
        ...


class AttendSession:
    """Attends one robot. Without a `measurer` it does not move it, whatever happens."""

    def __init__(
        self,
        site: Site,
        versions: Versions,
        listener: Listener,
        measurer: Measurer | None = None,
        alarms_per_hour: float = ALARMS_PER_HOUR,
        patience: Patience = Patience(),  # noqa: B008 - it has no state
    ):
        self._site = site
        self._versions = versions
        self._listener = listener
        self._measurer = measurer
        self._alarms_per_hour = alarms_per_hour
        self._patience = patience
        self.changed = False
        self.was_seen = False

    async def run(self, until_ns: int | None = None) -> None:
        """Attend the robot until a time [ns], or until cancelled.

        Raises:
            BaselineError, UnsuitableBaseline, VersionError: the folder holds nothing to compare with.
        """
        known = await self._site.compute(lambda: load_baseline(self._versions.folder))
        reference = await self._reference(known)
        if why := "; ".join(known.kinematics.suspicions):
            if self._measurer is not None:
                raise UnsuitableBaseline(
                    f"{known.folder} is not to be believed as usual, so that no measurement could be: "
                    f"{why}. Identify the robot anew, or attend it without --may-move"
                )
            self._say(f"{known.folder} is not to be believed as usual: {why}")
        serials = reference.chain.serials
        attendant = Attendant(serials, self._measurer is not None, self._patience)
        self._say(f"attends {known.name}, version {self._versions.current_number}: {', '.join(serials)}")
        while (wanted := await self._watch(attendant, reference, until_ns)) is not None:
            assert self._measurer is not None, "an attendant that may not move wants no measurement"
            outcome, later = await self._measurer.measure(wanted, known)
            self._take(attendant.ended(self._site.clock(), wanted, outcome))
            # A model that is kept leaves open what it did before.
            if later is not known:
                known, reference = later, await self._reference(later)

    async def _reference(self, known: BaselineRobot) -> Reference:
        """Return what to compare with, and say what it leaves open."""
        reference = await self._site.compute(lambda: build_reference(known))
        for remark in reference.remarks:
            self._say(remark)
        return reference

    async def _watch(
        self, attendant: Attendant, reference: Reference, until_ns: int | None
    ) -> Measurement | None:
        """Look at the robot until it is to be measured, or until a time; return what is to be measured."""
        site, monitor = self._site, Monitor(reference, self._alarms_per_hour)
        live = LiveMonitor(monitor, site.clock, site.sender.name, self._listener.report, LOOK_S)
        coalesced_s = None if site.inline else COALESCED_S
        messenger = Messenger(
            site.connect(), site.robot, site.clock, site.post, live.record, coalesced_s=coalesced_s
        )
        wanted: Measurement | None = None

        def looked() -> bool:
            nonlocal wanted
            findings = monitor.finding_log.all
            seen = observation(site.clock(), messenger.alive, live.recording, findings, site.sender.name)
            wanted = self._take(attendant.look(seen))
            self.was_seen = attendant.was_seen
            return wanted is not None

        try:
            messenger.start()
            await live.watch(messenger, until_ns, looked)
        finally:
            messenger.close()
        return wanted

    def _take(self, step: Step) -> Measurement | None:
        self.changed |= bool(step.say or step.warn)
        for line in (*step.remarks, *step.say):
            self._say(line)
        for line in step.warn:
            self._listener.warn(line, self._site.clock())
        return step.measure

    def _say(self, text: str) -> None:
        self._listener.say(text, self._site.clock())


def observation(
    t_ns: int, alive: set[str], recording: Recording, findings: Sequence[Finding], own_name: str
) -> Observation:
    """Return what is known of the modules that are on the network; the asking program holds none any more."""
    records = {s: recording.modules[s] for s in sorted(alive) if s in recording.modules}
    present = {serial: records[serial].boot if serial in records else 0 for serial in sorted(alive)}
    holders = {
        serial: record.status.holder
        for serial, record in records.items()
        if record.status is not None and record.status.holder not in (None, own_name)
    }
    return Observation(t_ns, present, findings, {s: str(holder) for s, holder in holders.items()})

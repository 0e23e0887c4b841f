"""A session in virtual time, recorded in memory: the same agents, coordinator and world, and no files.

The recording equals a run's `session.mcap`; it is for experiments that need many sessions and no folder.
"""

from collections.abc import Callable, Sequence

from coordinator.excitation.joint_limits import NoExcitation
from coordinator.excitation.plan import Plan
from coordinator.excitation.robot_excitation import RobotModule, robot_excitation
from coordinator.excitation.segment import RobotMotion
from coordinator.identification.identified import Kinematics
from coordinator.identification.identify import identify_kinematics
from coordinator.identification.topology_search import doubtful_motions
from coordinator.live_robot.messenger import Messenger
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.recording.journal import JournalEvent
from coordinator.recording.recording import JOURNAL_TOPIC, Entry, Recording
from coordinator.session.session import Session
from coordinator.topology.next_motion import NextMotion
from module_agent.model.catalogue import module_type
from sim.virtual_time.robot import VirtualRobot, VirtualSettings, virtual_robot
from sim.virtual_time.run import COORDINATOR, SENDER, SilentScreen


def record_session(
    settings: VirtualSettings,
    plan: Plan,
    at_end: Callable[[VirtualRobot], None] | None = None,
    recording: Recording | None = None,
    on_explored: Callable[[Kinematics], None] | None = None,
) -> Recording:
    """Run one session from discovery to its end and return what the coordinator has recorded of it.

    `at_end` is called with the robot when the session is over, to compare the recording with the truth.
    `recording` is an empty one to record to; None for a new one. `on_explored` receives the kinematics that
    motions of all joints are designed with, for `explored` of `identify`; in other sessions it is not called.

    Raises:
        what `coordinator.session.session` raises: no module found, an unfit link, a module lost, a motion
            interrupted.
    """
    recording = recording or Recording()
    with virtual_robot(settings, imu=plan.imu) as robot:
        name, loop = settings.robot.name, robot.loop
        recorder = _MemoryRecorder(plan, recording, lambda: loop.now_ns, on_explored)
        endpoint = robot.endpoint(COORDINATOR)
        messenger = Messenger(endpoint, name, lambda: loop.now_ns, loop.call_soon, recording.accept)
        group = ModuleGroup(messenger, recording, lambda: loop.now_ns, SENDER)
        session = Session(group, messenger, recording, plan, lambda: loop.now_ns, recorder.journal, recorder)

        async def whole_session() -> None:
            messenger.start()
            try:
                await session.run(len(robot.world.modules))
            finally:
                messenger.close()

        began = JournalEvent(t_ns=loop.now_ns, what="session", robot=name, imu=plan.imu, torque=plan.torque)
        recorder.journal(began)
        robot.complete(whole_session())
        recorder.journal(JournalEvent(t_ns=loop.now_ns, what="finished"))
        if at_end is not None:
            at_end(robot)
    return recording


class _MemoryRecorder(SilentScreen):
    """Records the session in memory; progress and estimates are not displayed."""

    def __init__(
        self,
        plan: Plan,
        recording: Recording,
        clock: Callable[[], int],
        on_explored: Callable[[Kinematics], None] | None,
    ) -> None:
        self.recording = recording
        self._plan = plan
        self._clock = clock
        self._on_explored = on_explored

    def journal(self, event: JournalEvent) -> None:
        self.recording.add(Entry("journal", JOURNAL_TOPIC, event.t_ns, event.encode()))

    def estimates(self, joint: str) -> None:
        """Draw nothing."""

    async def moving(self, serials: Sequence[str]) -> None:
        """Draw nothing."""

    async def doubts(self) -> tuple[NextMotion, ...]:
        """Look for doubts about the topology, as a run does."""
        return doubtful_motions(self.recording)

    async def explored(self) -> None:
        """Record where the exploration ended; what follows from it is computed afterwards."""
        self.journal(JournalEvent(t_ns=self._clock(), what="explored"))

    async def excitation(self) -> tuple[RobotMotion, ...]:
        """Design motions of all joints at once, as a run does; none if the robot could run none."""
        so_far = self.recording.explored
        assert so_far is not None, "all joints are explored before any is excited"
        explored = identify_kinematics(so_far)
        if self._on_explored is not None:
            self._on_explored(explored)
        chain = identify_kinematics(self.recording, explored=explored).fit.chain
        infos = [self.recording.modules[serial].info for serial in chain.serials]
        modules = [RobotModule(module_type(one.module_type), one.limits) for one in infos if one is not None]
        try:
            return robot_excitation(chain, modules, self._plan)
        except NoExcitation:
            return ()

"""A simulated robot that somebody moves while somebody else watches it, and to which something happens.

Mover and watcher are two coordinators on one virtual network: the one holds the leases and runs motions one
after the other, the other hears feedback and asks for status, as anybody may.
"""

import asyncio
from collections.abc import Callable, Sequence
from typing import NamedTuple

from coordinator.excitation.plan import Plan
from coordinator.excitation.robot_excitation import RobotModule, robot_excitation
from coordinator.excitation.segment import RobotMotion
from coordinator.live_robot.errors import MotionInterrupted
from coordinator.live_robot.messenger import Messenger, gather_all
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.monitoring.live import LiveMonitor
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from coordinator.recording.recording import Entry, Recording
from coordinator.runtime.event_loop import run_to_end
from module_agent.model.catalogue import module_type
from module_agent.model.chain import Chain
from module_agent.model.errors import RobotError
from module_agent.wire.messages import GoTo, Message
from sim.virtual_time.loop import VirtualLoop
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from sim.world.world import World

MOVER, WATCHER = "mover", "watcher"
TRAVEL_RAD_S = 1.5
SETTLE_S = 0.3

Report = Callable[[MonitorUpdate, int], None]


class Happening(NamedTuple):
    """Something that is done to the world at a time [s] of the run."""

    at_s: float
    what: Callable[[World], None]


def ordinary_motions(chain: Chain, recording: Recording, plan: Plan, seed: int) -> tuple[RobotMotion, ...]:
    """Return motions of all joints at once, such as the robot may run one after the other.

    Raises:
        ValueError: none are possible.
    """
    told = [recording.modules[serial].info for serial in chain.serials]
    modules = [RobotModule(module_type(one.module_type), one.limits) for one in told if one is not None]
    return robot_excitation(chain, modules, plan, seed)


def watched(
    settings: VirtualSettings,
    motions: Sequence[RobotMotion],
    for_s: float,
    monitor: Monitor,
    report: Report,
    happenings: Sequence[Happening] = (),
) -> None:
    """Move a robot for a while, over and over by the same motions, and let the watcher look at it.

    `report` hears what the watcher says, and when [ns] of virtual time.

    Raises:
        what `ModuleGroup` raises, if the robot is lost.
    """
    loop = VirtualLoop()
    robot = VirtualRobot(settings, loop)
    recording = Recording()
    mover = Messenger(
        robot.endpoint(MOVER), settings.robot.name, lambda: loop.now_ns, loop.call_soon, _kept(recording)
    )
    watch = LiveMonitor(monitor, lambda: loop.now_ns, WATCHER, lambda update: report(update, loop.now_ns))
    ears = Messenger(
        robot.endpoint(WATCHER), settings.robot.name, lambda: loop.now_ns, loop.call_soon, watch.record
    )
    link = ModuleGroup(mover, recording, lambda: loop.now_ns, MOVER)
    for one in happenings:
        loop.schedule_ns(round(one.at_s * 1e9), lambda one=one: one.what(robot.world))  # type: ignore[misc]
    robot.start()

    async def live() -> None:
        mover.start()
        ears.start()
        attending = asyncio.create_task(watch.watch(ears))
        try:
            await _move(link, mover, motions, len(settings.robot.modules), round(for_s * 1e9), loop)
        finally:
            attending.cancel()
            (failure,) = await asyncio.gather(attending, return_exceptions=True)
            if isinstance(failure, Exception):
                raise failure
            mover.close()
            ears.close()
            robot.stop()
            await asyncio.sleep(0)

    try:
        run_to_end(loop, loop.create_task(live()))
    finally:
        robot.close()
        loop.close()


def _kept(recording: Recording) -> Callable[[Entry], Message | None]:
    def keep(entry: Entry) -> Message | None:
        try:
            message = recording.add(entry)
        except RobotError:
            return None  # counted by the recording, by reason
        return message if isinstance(message, Message) else None

    return keep


async def _move(
    link: ModuleGroup,
    radio: Messenger,
    motions: Sequence[RobotMotion],
    count: int,
    until_ns: int,
    loop: VirtualLoop,
) -> None:
    while len(radio.alive) < count:
        await asyncio.sleep(0.05)
    await link.meet(sorted(radio.alive))
    await asyncio.sleep(0.3)
    keeper = asyncio.create_task(link.keep_alive())
    await gather_all(link.acquire(serial) for serial in link.serials)
    turn = 0
    while loop.now_ns < until_ns:
        motion = motions[turn % len(motions)]
        turn += 1
        try:
            goals = {s: GoTo(target_rad=q, max_speed_rad_s=TRAVEL_RAD_S) for s, q in motion.pose_rad.items()}
            await link.run(goals)
            await asyncio.sleep(SETTLE_S)
            await link.run(dict(motion.patterns))
        except MotionInterrupted:
            # A blow may make a module let go; whoever moves the robot takes it again.
            await gather_all(link.acquire(serial) for serial in link.serials)
    await link.release_all()
    keeper.cancel()
    await asyncio.gather(keeper, return_exceptions=True)

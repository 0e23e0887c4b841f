"""A simulated robot that one coordinator moves while another one monitors it, with events in the world.

Both coordinators are on one virtual network: the mover holds the leases and runs motions one after the other,
the monitor receives feedback and asks for status, which needs no lease.
"""

import asyncio
from collections.abc import Callable, Sequence
from typing import NamedTuple

from coordinator.excitation.plan import Plan
from coordinator.excitation.robot_excitation import RobotModule, robot_excitation
from coordinator.excitation.segment import RobotMotion
from coordinator.live_robot.errors import MotionInterrupted
from coordinator.live_robot.messenger import Messenger, Sender
from coordinator.live_robot.module_group import ModuleGroup
from coordinator.monitoring.live import LiveMonitor
from coordinator.monitoring.monitor import Monitor, MonitorUpdate
from coordinator.recording.recording import Recording
from module_agent.model.catalogue import module_type
from module_agent.model.chain import Chain
from module_agent.wire.messages import GoTo
from sim.virtual_time.loop import VirtualLoop
from sim.virtual_time.robot import VirtualSettings, virtual_robot
from sim.world.world import World

MOVER, MONITOR = "mover", "watcher"
TRAVEL_RAD_S = 1.5
SETTLE_S = 0.3

Report = Callable[[MonitorUpdate, int], None]


class WorldEvent(NamedTuple):
    """A change of the world at a time [s] of the run."""

    at_s: float
    what: Callable[[World], None]


def ordinary_motions(chain: Chain, recording: Recording, plan: Plan, seed: int) -> tuple[RobotMotion, ...]:
    """Return motions of all joints at once that the robot can run one after the other.

    Raises:
        ValueError: none are possible.
    """
    information = [recording.modules[serial].info for serial in chain.serials]
    modules = [
        RobotModule(module_type(one.module_type), one.limits) for one in information if one is not None
    ]
    return robot_excitation(chain, modules, plan, seed)


def monitor_robot(
    settings: VirtualSettings,
    motions: Sequence[RobotMotion],
    for_s: float,
    monitor: Monitor,
    report: Report,
    events: Sequence[WorldEvent] = (),
) -> None:
    """Move a robot by the same motions over and over for `for_s`, and monitor it.

    `report` receives what the monitor reports, and the virtual time [ns].

    Raises:
        ModuleLost, RobotStopped: see `ModuleGroup`.
    """
    with virtual_robot(settings) as robot:
        loop = robot.loop
        recording = Recording()
        mover = Messenger(
            robot.endpoint(MOVER), settings.robot.name, lambda: loop.now_ns, loop.call_soon, recording.accept
        )
        watch = LiveMonitor(monitor, lambda: loop.now_ns, MONITOR, lambda update: report(update, loop.now_ns))
        listener = Messenger(
            robot.endpoint(MONITOR), settings.robot.name, lambda: loop.now_ns, loop.call_soon, watch.record
        )
        group = ModuleGroup(mover, recording, lambda: loop.now_ns, Sender(MOVER))
        for one in events:
            loop.schedule_ns(round(one.at_s * 1e9), lambda one=one: one.what(robot.world))  # type: ignore[misc]

        async def live() -> None:
            mover.start()
            listener.start()
            attending = asyncio.create_task(watch.watch(listener))
            try:
                await move_about(group, mover, motions, len(settings.robot.modules), round(for_s * 1e9), loop)
            finally:
                attending.cancel()
                (failure,) = await asyncio.gather(attending, return_exceptions=True)
                if isinstance(failure, Exception):
                    raise failure
                mover.close()
                listener.close()

        robot.complete(live())


async def move_about(
    group: ModuleGroup,
    messenger: Messenger,
    motions: Sequence[RobotMotion],
    count: int,
    until_ns: int,
    loop: VirtualLoop,
) -> None:
    """Run motions one after the other, over and over until a time [ns], on a robot of so many modules.

    Raises:
        ModuleLost, RobotStopped: see `ModuleGroup`.
    """
    while len(messenger.alive) < count:
        await asyncio.sleep(0.05)
    await group.meet(sorted(messenger.alive))
    await asyncio.sleep(0.3)
    await group.acquire_all()
    turn = 0
    while loop.now_ns < until_ns:
        motion = motions[turn % len(motions)]
        turn += 1
        try:
            goals = {s: GoTo(target_rad=q, max_speed_rad_s=TRAVEL_RAD_S) for s, q in motion.pose_rad.items()}
            await group.run(goals)
            await asyncio.sleep(SETTLE_S)
            await group.run(dict(motion.patterns))
        except MotionInterrupted:
            # A collision may make a module drop its lease; the mover acquires it again.
            await group.acquire_all()
    await group.release_all()

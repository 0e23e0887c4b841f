"""What a tick of virtual time costs, over what PyBullet needs for the bodies alone."""

from collections.abc import Callable

import numpy as np
import pybullet
import pytest

from coordinator.excitation.plan import Plan
from module_agent.network_emulation.profile import PROFILES
from sim.physics.multibody import Multibody
from sim.physics.skeleton import build_skeleton
from sim.robot.robot_file import load_robot
from sim.robot.variants import as_built
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from sim.virtual_time.session import record_session
from sim.world.world import TICK_NS, TICK_S, World
from tests.benchmarks.bars import least_cpu_of, report

pytestmark = pytest.mark.benchmark

ROBOT, NOISE, CALLS = "arm7", "poor", 2000


def whole_session(ticks: list[int]) -> Callable[[], None]:
    """Agents, network and recording of a session with every effect, without identification."""
    settings = VirtualSettings(load_robot(ROBOT), PROFILES["lan"], 1, NOISE)
    plan = Plan(mode="simultaneous", dynamics=False)

    def count(robot: VirtualRobot) -> None:
        ticks[:] = [robot.loop.now_ns // TICK_NS]

    def run() -> None:
        record_session(settings, plan, count)

    return run


def test_a_tick_of_seven_modules_with_every_effect() -> None:
    ticks = [0]
    world = World(load_robot(ROBOT), 1, NOISE)
    built = as_built(load_robot(ROBOT), 1, world.profile)
    skeleton = build_skeleton(built, world.profile.base_shake, world.profile.link_flex)
    bodies = Multibody(ROBOT, skeleton, TICK_S)
    client, still = bodies._client, np.zeros(len(skeleton.names))
    bodies.place(still)
    pwm = [0.1] * len(world.modules)

    def bare() -> None:
        for _ in range(CALLS):
            pybullet.stepSimulation(physicsClientId=client)

    def alone() -> None:
        for _ in range(CALLS):
            world.exchange(pwm)

    session = whole_session(ticks)
    session()
    session_s, bare_s, alone_s = least_cpu_of((session, bare, alone))
    tick_us, bare_us, world_us = (
        1e6 * s / n for s, n in ((session_s, ticks[0]), (bare_s, CALLS), (alone_s, CALLS))
    )
    report(
        f"tick of {ROBOT}, {NOISE}: agents, network, recording, over PyBullet's bare step",
        tick_us / bare_us,
        "times",
        at_most=1.0,
        anchor=f"{tick_us:.0f} us, of it the world {world_us:.0f} us; stepSimulation {bare_us:.0f} us",
    )
    world.close()
    bodies.close()

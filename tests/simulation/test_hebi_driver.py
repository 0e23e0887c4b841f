"""The whole identification through the driver of real modules, over what stands in for hebi-py."""

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify
from module_agent.hardware.hebi_modules import HebiModules
from module_agent.network_emulation.profile import PROFILES
from module_agent.wire.messages import WindowedSine
from sim.robot.robot_file import load_robot
from sim.scoring.score import score_identified
from sim.virtual_time.robot import VirtualRobot, VirtualSettings
from sim.virtual_time.session import record_session
from sim.world.truth import Motion, Truth, truth_of
from tests.rig import silent

ROBOT = "a2085_04"
# One draw of the noise says little of either.
SEEDS = (1, 2)
# Errors through the driver over those without it.
MOST = 1.5
RATE_HZ = 250.0
BRISK = WindowedSine(amplitude=0.12, frequency_hz=1.0, centre_s=1.5, sigma_s=1.0)
BASE = "X-00009"
LIFETIME_NS = 250_000_000
# A tick of the driver, in which a command is sent, and two of the module: to notice, and to reach the bridge.
LATE_NS = 4_000_000 + 2_000_000


def errors_mm(seed: int, plan: Plan, rate_hz: float | None) -> tuple[float, float]:
    """Identify the robot, through the driver at a rate or without it; return rms errors of links and tip."""
    ended: list[tuple[Truth, Motion]] = []

    def at_end(robot: VirtualRobot) -> None:
        drivers = {type(host._hardware) for host in robot.hosts.values()}
        assert (drivers == {HebiModules}) == (rate_hz is not None)
        ended.append((truth_of(robot.robot, robot.world), robot.truth.motion()))

    settings = VirtualSettings(load_robot(ROBOT), PROFILES["lan"], seed, "x5", hebi_rate_hz=rate_hz)
    found = identify(record_session(settings, plan, at_end))
    score = score_identified(found, ended[0][0].chain, ended[0][1])
    assert score.topology_correct, score.topology_differences
    links = [link.link_vector_error_mm for link in score.links]
    return float(np.sqrt(np.mean(np.square(links)))), score.tip_position_rms_mm


def test_topology_links_and_tip_are_as_good_as_without_the_driver(quick_plan: Plan) -> None:
    direct, driven = (
        np.sqrt(np.mean([np.square(errors_mm(seed, quick_plan, rate)) for seed in SEEDS], axis=0))
        for rate in (None, RATE_HZ)
    )
    assert np.all(driven < MOST * direct), f"links and tip {driven} mm, without the driver {direct} mm"


@pytest.mark.parametrize("dies", ["agent", "coordinator"])
def test_a_moving_motor_is_off_within_a_lifetime_of_the_death_of(rigs: Callable[..., Any], dies: str) -> None:
    """The firmware ends what a dead coordinator began; what a dead agent began the module ends by itself."""
    rig = rigs("thesis_171_horizontal", "lan", hebi_rate_hz=RATE_HZ)
    _, _, group = rig.group()
    pwm: list[tuple[int, float]] = []
    rig.on_tick.append(lambda: pwm.append((rig.loop.now_ns, rig.world.plant.pwm[0])))

    async def work() -> int:
        await asyncio.sleep(0.1)
        await group.meet([BASE])
        await group.acquire(BASE)
        motion = asyncio.create_task(group.run({BASE: BRISK}))
        await asyncio.sleep(1.1)
        assert rig.state(BASE) == "moving"
        died_ns = rig.loop.now_ns
        if dies == "agent":
            rig.kill(BASE)
        else:
            rig.network.kill("tester")
        motion.cancel()
        with silent(group):
            await asyncio.sleep(1.0)
        return died_ns

    died_ns = rig.run(work())
    after = np.array([(t - died_ns, value) for t, value in pwm if t > died_ns])
    alive, over = after[after[:, 0] < LIFETIME_NS - 100e6], after[after[:, 0] > LIFETIME_NS + LATE_NS]
    assert np.abs(alive[:, 1]).max() > 0.0
    assert np.abs(over[:, 1]).max() == 0.0

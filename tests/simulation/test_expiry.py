"""When the commander falls silent, the motor does what was configured: seen in the plant, not in messages."""

import asyncio
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import pytest

from module_agent.hardware.motor_guard import DAMPING_LIMIT_PWM
from module_agent.wire.codec import decode
from module_agent.wire.keys import Leaf, parse
from module_agent.wire.messages import Ack, WindowedSine
from module_agent.wire.refusal import WireError
from sim.physics.engine import Physics
from tests.rig import silent

BASE = "X-00009"
HORIZONTAL, VERTICAL = "thesis_171_horizontal", "thesis_171_vertical"
LIFETIME_NS = 250_000_000
TICK_NS = 1_000_000
BRISK = WindowedSine(amplitude=0.12, frequency_hz=1.0, centre_s=1.5, sigma_s=1.0)


pytestmark = pytest.mark.parametrize("physics", get_args(Physics))


class Blackbox:
    """What the base module's motor and joint did, tick by tick, and when it last accepted a command."""

    def __init__(self, rigs: Callable[..., Any], robot: str, network: str, **firmware: Any):
        self.accepted_ns = 0
        self.rig = rigs(robot, network, tap=self._tap, **firmware)
        self.expired_ns = 0
        self.rows: list[tuple[int, float, float, float, float]] = []
        self.rig.on_tick.append(self._watch)

    def _tap(self, now_ns: int, endpoint: str, kind: str, key: str, payload: bytes) -> None:
        """Note when the module says yes to a command; answers leave in the tick of their cause."""
        parts = parse(key)
        if kind == "reply" and parts.serial == BASE and parts.leaf in (Leaf.LEASE, Leaf.MOTION):
            try:
                if decode(Ack, payload).accepted:
                    self.accepted_ns = now_ns
            except WireError as error:
                raise AssertionError(f"a module sent what cannot be read: {error}") from error

    def _watch(self) -> None:
        plant = self.rig.world.plant
        if not self.expired_ns and self.rig.state(BASE) == "expired":
            self.expired_ns = plant.t_ns
        self.rows.append((plant.t_ns, plant.pwm[0], plant.duty[0], plant.q_rad[0], plant.qd_rad_s[0]))

    def silence(self, how: str, after_s: float) -> None:
        """Arm, run a brisk motion, fall silent in the midst of it, and let a second and a half pass."""
        _, _, group = self.rig.group()

        async def work() -> None:
            await asyncio.sleep(0.1)
            await group.meet([BASE])
            await group.acquire(BASE)
            motion = asyncio.create_task(group.run({BASE: BRISK}))
            await asyncio.sleep(after_s)
            assert self.rig.state(BASE) == "moving"
            if how == "killed":
                self.rig.network.kill("tester")
            elif how == "partitioned":
                self.rig.cut = True
            motion.cancel()
            with silent(group):
                await asyncio.sleep(1.3)

        self.rig.run(work())

    def after(self, since_ns: int) -> np.ndarray:
        """Rows (time, pwm, duty, q, qd) from a time on."""
        rows = np.array(self.rows)
        return rows[rows[:, 0] >= since_ns]

    @property
    def deadline_ns(self) -> int:
        """The lifetime after the last accepted command, and two ticks: to notice, and to reach the bridge."""
        return self.accepted_ns + LIFETIME_NS + 2 * TICK_NS


@pytest.mark.parametrize("robot", [HORIZONTAL, VERTICAL])
@pytest.mark.parametrize("how", ["killed", "partitioned", "keep-alives stop"])
@pytest.mark.parametrize(("network", "after_s"), [("lan", 1.1), ("wifi", 1.4)])
def test_the_motor_is_off_within_the_lifetime_and_two_ticks_of_the_last_accepted_command(
    rigs: Callable[..., Any], robot: str, how: str, network: str, after_s: float
) -> None:
    box = Blackbox(rigs, robot, network)
    box.silence(how, after_s)
    before = box.after(box.accepted_ns - 200_000_000)
    before = before[before[:, 0] <= box.expired_ns]
    # The motor was driven up to there: it is not off by itself.
    assert np.count_nonzero(before[:, 2]) > 0.9 * len(before)
    dead = box.after(box.deadline_ns)
    assert len(dead) > 1000
    np.testing.assert_array_equal(dead[:, 1:3], 0.0)
    assert box.rig.state(BASE) == "expired"


def test_it_stays_off_when_the_network_comes_back_with_old_commands(rigs: Callable[..., Any]) -> None:
    box = Blackbox(rigs, HORIZONTAL, "lan")
    rig = box.rig
    _, recording, group = rig.group()

    async def work() -> None:
        await asyncio.sleep(0.1)
        await group.meet([BASE])
        await group.acquire(BASE)
        await asyncio.sleep(0.5)
        rig.cut = True
        await asyncio.sleep(0.6)
        rig.cut = False
        # The keep-alives go on, under a lease that still runs, and with fresh echoes: they do not re-arm.
        await asyncio.sleep(0.5)
        assert rig.state(BASE) == "expired"
        assert recording.modules[BASE].status.expiries == 1
        await group.acquire(BASE)
        assert rig.state(BASE) == "armed"

    rig.run(work())


@pytest.mark.parametrize("robot", [HORIZONTAL, VERTICAL])
def test_a_module_that_is_to_hold_holds_its_position_against_gravity(
    rigs: Callable[..., Any], robot: str
) -> None:
    box = Blackbox(rigs, robot, "lan", expiry_action="hold")
    box.silence("killed", 1.1)
    assert box.expired_ns < box.deadline_ns
    rows = box.after(box.expired_ns + TICK_NS)
    held = rows[rows[:, 0] > box.expired_ns + 300_000_000]
    # Where it was when it expired, but for braking from at most 0.75 rad/s within some 50 ms, and still.
    assert np.abs(held[:, 3] - rows[0, 3]).max() < 0.04
    assert np.abs(held[:, 4]).max() < 0.05
    assert box.rig.state(BASE) == "expired"


@pytest.mark.parametrize("robot", [HORIZONTAL, VERTICAL])
def test_a_module_that_is_to_damp_brakes_and_never_drives(rigs: Callable[..., Any], robot: str) -> None:
    box = Blackbox(rigs, robot, "lan", expiry_action="damping")
    box.silence("killed", 1.1)
    assert box.expired_ns < box.deadline_ns
    rows = box.after(box.expired_ns + TICK_NS)
    pwm, rate = rows[:, 1], rows[:, 4]
    assert np.abs(pwm).max() <= DAMPING_LIMIT_PWM
    # It pushes against the motion wherever there is any above the noise of the rate.
    moving = np.abs(rate) > 0.05
    assert (pwm[moving] * rate[moving] <= 0.0).all()
    assert np.abs(pwm[:100]).max() > 0.01
    late = rows[rows[:, 0] > box.expired_ns + 1_000_000_000]
    assert np.abs(late[:, 4]).max() < 0.3 * np.abs(rows[:50, 4]).max() + 0.02


@pytest.mark.parametrize("robot", [HORIZONTAL, VERTICAL, "thesis_484_horizontal"])
def test_a_stop_brings_a_moving_arm_to_rest_and_leaves_it_there(rigs: Callable[..., Any], robot: str) -> None:
    box = Blackbox(rigs, robot, "lan")
    _, _, group = box.rig.group()
    stopped_ns = 0

    async def work() -> None:
        nonlocal stopped_ns
        await asyncio.sleep(0.1)
        await group.meet([BASE])
        await group.acquire(BASE)
        motion = asyncio.create_task(group.run({BASE: BRISK}))
        await asyncio.sleep(1.1)
        assert await group.stop_all("test") == []
        stopped_ns = box.rig.loop.now_ns
        motion.cancel()
        await asyncio.sleep(2.0)

    box.rig.run(work())
    rest = box.after(stopped_ns + 1_000_000_000)
    moving = box.after(stopped_ns - 100_000_000)[:100]
    # A second later the gear's friction holds the motor. The longest arm still rings on its spring, at 6 Hz,
    # by less than half a degree to either side, ever less.
    assert np.ptp(rest[:, 3]) < 0.012
    assert np.sqrt(np.mean(rest[:500, 4] ** 2)) < 0.3 * np.abs(moving[:, 4]).max()
    assert np.sqrt(np.mean(rest[500:, 4] ** 2)) < 0.8 * np.sqrt(np.mean(rest[:500, 4] ** 2)) + 0.005
    np.testing.assert_allclose(rest[:, 1], 0.0, atol=0.01)
    assert box.rig.state(BASE) == "stopped"

"""Many ticks of world and agents in one compiled call leave the same bits as one tick at a time."""

import asyncio
import hashlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from module_agent.model.errors import RobotError
from module_agent.wire.messages import GoTo
from sim.virtual_time.quiet_run import QuietRun
from sim.world import truth
from sim.world.external_force import Push
from sim.world.world import TICK_NS

LIFE_S = 2.5
ROBOTS = ("a2085_03", "thesis_171_horizontal", "tree_y")


def befall(rig: Any, rng: np.random.Generator) -> None:
    """Schedule what may happen to a robot: to agents, world and network, at any time and right at a tick."""
    serials = rig.serials

    def thaw(serial: str, host: Any) -> None:
        if serial not in rig.hosts:
            rig.hosts[serial] = host

    def freeze(serial: str, for_s: float) -> None:
        host = rig.hosts.get(serial)
        if host is not None:
            rig.freeze(serial)
            rig.loop.call_later(for_s, thaw, serial, host)

    def reboot(serial: str, after_s: float) -> None:
        if serial in rig.hosts:
            rig.kill(serial)
            rig.loop.call_later(after_s, rig.boot, serial)

    def disturb(serial: str, size: float) -> None:
        rig.world.push(Push(serial=serial, force_n=(size, 0.0, 1.0), from_s=rig.loop.time(), for_s=0.05))
        rig.world.change_friction(serial, 1.0 + size)

    def garble(serial: str, size: float) -> None:
        rig.network.endpoint(f"intruder {rig.loop.now_ns}").publish(
            f"x5/{rig.robot.name}/{serial}/stop", b"?"
        )

    for at_s in np.sort(rng.uniform(0.3, LIFE_S, 6)):
        what = (freeze, reboot, disturb, garble)[int(rng.integers(4))]
        serial, size = serials[int(rng.integers(len(serials)))], float(rng.uniform(0.02, 0.3))
        if rng.random() < 0.5:
            at_s = round(at_s * 1e3) / 1e3
        rig.at(at_s, lambda what=what, serial=serial, size=size: what(serial, size))


def life(rigs: Callable[..., Any], seed: int, observed: bool = False) -> tuple[str, bytes]:
    """Live a life drawn from the seed; return a hash of all messages and truth, and the motors' last PWM."""
    rng, trace = np.random.default_rng(seed), hashlib.sha256()

    def tap(*message: object) -> None:
        trace.update(repr(message).encode())

    network, noise = (("none", "lan", "wifi")[int(rng.integers(3))], ("x5", "poor")[int(rng.integers(2))])
    rig = rigs(ROBOTS[seed % len(ROBOTS)], network, seed, tap, noise)
    seen: list[bytes] = []
    rig.on_run.append(lambda ticks: seen.append(ticks.tobytes()))
    if observed:
        rig.on_tick.append(lambda: None)
    _, _, group = rig.group()

    async def move(target_rad: float) -> None:
        await asyncio.sleep(0.1)
        await group.meet(rig.serials)
        await group.acquire_all()
        with suppress(RobotError):
            for serial in rig.serials:
                await group.run({serial: GoTo(target_rad=target_rad, max_speed_rad_s=1.0)})

    async def work() -> None:
        moving = asyncio.create_task(move(float(rng.uniform(-0.5, 0.5))))
        await asyncio.sleep(LIFE_S)
        moving.cancel()
        await asyncio.gather(moving, return_exceptions=True)

    befall(rig, rng)
    rig.run(work())
    motion, plant = rig.truth.motion(), rig.world.plant
    for values in (*motion[1:], *plant[1:], rig.world.readings.floats):
        trace.update(np.ascontiguousarray(values).tobytes())
    trace.update(b"".join(seen))
    for serial, host in sorted(rig.hosts.items()):
        history = host.modules[0].firmware.history
        trace.update(serial.encode() + history.block(history.first_row, history.next_row))
    return trace.hexdigest(), np.array(rig.pwm).tobytes()


@pytest.mark.parametrize("seed", range(9))
def test_many_ticks_in_one_call_leave_what_one_at_a_time_leaves(
    rigs: Callable[..., Any], seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, run = list[int](), QuietRun.run

    def counted(*arguments: Any) -> tuple[int, list[int]]:
        ticks, results = run(*arguments)
        calls.append(ticks)
        return ticks, results

    monkeypatch.setattr(QuietRun, "run", counted)
    many = life(rigs, seed)
    # What befalls the robot, and a lossy network, leave few ticks alone.
    assert sum(calls) > 1.5 * len(calls) > 0
    calls.clear()
    assert life(rigs, seed, observed=True) == many
    assert calls == []
    monkeypatch.setattr(truth, "MANY_TICKS", 1)
    assert life(rigs, seed) == many
    assert set(calls) == {1}


def test_an_observer_sees_every_tick_from_when_it_begins_to_look(rigs: Callable[..., Any]) -> None:
    rig, seen = rigs("a2085_03"), list[int]()
    rig.at(0.05, lambda: rig.on_tick.append(lambda: seen.append(rig.world.t_ns - TICK_NS)))
    rig.run(asyncio.sleep(0.1))
    assert seen == list(range(50 * TICK_NS, seen[-1] + 1, TICK_NS))
    assert len(seen) in (50, 51)


def test_an_event_between_ticks_finds_the_world_at_its_time(rigs: Callable[..., Any]) -> None:
    rig, found = rigs("a2085_03"), list[tuple[int, int]]()
    # On a tick, just before and just after one.
    for at_ns in (30_000_000, 41_999_999, 52_000_001):
        rig.loop.schedule_ns(at_ns, lambda: found.append((rig.loop.now_ns, rig.world.t_ns)))
    rig.run(asyncio.sleep(0.1))
    # What was scheduled before a tick comes before it; `t_ns` is the end of the last tick.
    assert found == [(30_000_000, 30_000_000), (41_999_999, 42_000_000), (52_000_001, 53_000_000)]

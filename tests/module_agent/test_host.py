"""A process of modules: what it serves, what it hears, and what it makes of its neighbours' motions."""

import asyncio
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest

from module_agent.host import InlineWorker
from module_agent.transport.inbox import EVENT_BYTES
from module_agent.transport.transport import Liveness, Reply, Sample
from module_agent.wire.codec import decode, encode
from module_agent.wire.feedback_rows import unpack
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import (
    Ack,
    Ask,
    ConstantMotion,
    Estimate,
    EstimateRequest,
    Feedback,
    GoTo,
    HistoryRequest,
    Info,
    MotionRecord,
    Rest,
    Status,
    Stop,
    WindowedSine,
)
from sim.robot.robot_tree import sensing_chain, true_chain
from sim.scoring.chain_score import link_length_m

ARM = "thesis_171_horizontal"
BASE, TIP = "X-00009", "X-00010"


async def _explore(group: Any, joint: str) -> None:
    """The motions of an exploration, without all else that a session does."""
    await asyncio.sleep(0.2)
    await group.meet([BASE, TIP])
    await group.acquire_all()
    await group.run(dict.fromkeys(group.serials, Rest(duration_s=1.0)))
    for pattern in (
        GoTo(target_rad=-0.45, max_speed_rad_s=1.2),
        ConstantMotion(velocity_rad_s=1.0, duration_s=0.75),
        GoTo(target_rad=0.0, max_speed_rad_s=1.2),
        WindowedSine(amplitude=0.08, centre_s=1.2, sigma_s=0.5),
    ):
        record = (await group.run({joint: pattern}))[joint]
        await asyncio.sleep(0.3)
        if not isinstance(pattern, GoTo):
            # As a session does: the next motion waits until everybody has understood this one.
            for observer in group.serials:
                assert await group.estimate(observer, joint, record.motion_id, 0.6) is not None


@pytest.mark.parametrize(("network", "seed"), [("none", 0), ("wifi", 1), ("bad", 2), ("bad", 3)])
def test_a_module_finds_the_circle_of_another_joint_through_a_network_that_loses(
    rigs: Callable[..., Any], network: str, seed: int
) -> None:
    rig = rigs(ARM, network, seed, lifetime_ns=500_000_000)
    estimates_of: dict[str, list[Estimate]] = {BASE: [], TIP: []}
    listener = rig.network.endpoint("listener")

    def on_estimate(event: Any) -> None:
        found = decode(Estimate, event.payload)
        estimates_of[found.serial].append(found)

    listener.subscribe(key(rig.robot.name, TIP, Leaf.ESTIMATE), on_estimate)
    listener.subscribe(key(rig.robot.name, BASE, Leaf.ESTIMATE), on_estimate)
    rig.run(_explore(rig.group()[2], BASE))
    # Each module says once what it makes of each of the two motions.
    assert [len(found) for found in estimates_of.values()] == [2, 2]
    constant, sine = estimates_of[TIP]
    assert (constant.moved, sine.moved) == (True, True)
    assert len(sine.motion_ids) == 2
    assert sine.circle is not None
    chain = true_chain(rig.robot)
    turn = chain.imu_home[1, :3, :3]
    # Friction makes the arm ring on its spring at 25 Hz; the thesis' analysis smooths that out of alpha alone
    # and so finds d up to 15 % long here. It is a first guess; the refinement comes to 0.3 mm.
    assert 0.95 * 0.171 < sine.circle.distance_m < 1.15 * 0.171
    assert np.degrees(np.arccos(min(1.0, sine.circle.axis @ (turn.T @ chain.axis[0])))) < 0.5
    # The housing of the module that moves stands on the base: it was not carried, and says so too.
    assert [found.moved for found in estimates_of[BASE]] == [False, False]
    assert estimates_of[BASE][1].circle is None


def test_a_module_that_knows_its_imu_to_be_calibrated_claims_a_closer_distance(
    rigs: Callable[..., Any],
) -> None:
    sigma_m = []
    for imu in ("uncalibrated", "calibrated"):
        rig = rigs(ARM, lifetime_ns=500_000_000, imu=imu)
        _, recording, group = rig.group()
        rig.run(_explore(group, BASE))
        fit = list(recording.estimates[BASE, TIP].values())[-1].regression
        true_m = link_length_m(sensing_chain(rig.world.robot), child=1)
        assert abs(fit.distance_m - true_m) < 4.0 * fit.sigma_distance_m + 3e-4
        sigma_m.append(fit.sigma_distance_m)
    # One is left with 1 % of the scale of its accelerometer, the other with noise and bias.
    assert sigma_m[1] < 0.5 * sigma_m[0]


def test_a_motion_of_a_single_tick_does_not_end_the_agents(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    _, recording, group = rig.group()

    async def work() -> None:
        await asyncio.sleep(0.1)
        await group.meet([BASE, TIP])
        await group.acquire(BASE)
        blink = ConstantMotion(velocity_rad_s=0.1, duration_s=1e-3, ramp_s=0.0)
        for _ in range(4):
            assert (await group.run({BASE: blink}))[BASE].outcome == "done"
        await asyncio.sleep(0.5)

    rig.run(work())
    notes = [e.note for found in recording.estimates.values() for e in found.values()]
    # Whether a row fell into it or not, nothing can be told from it, and that is said.
    assert notes
    assert all(notes)


def test_motions_that_are_announced_faster_than_they_are_analysed_are_left_out(
    rigs: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rows of those that wait are bounded, and there is room again when they are done."""
    monkeypatch.setattr("module_agent.host.MAX_WAITING_ROWS", 150)
    rig = rigs(ARM)
    _, _, group = rig.group()
    host, waiting = rig.hosts[TIP], list[tuple[Any, Any]]()

    class Busy(InlineWorker):
        """A worker that gets to nothing."""

        def submit(self, job: Any, done: Any) -> None:
            waiting.append((job, done))

    host.worker = Busy()

    async def moved(times: int) -> None:
        for _ in range(times):
            blink = ConstantMotion(velocity_rad_s=0.1, duration_s=0.08, ramp_s=0.0)
            assert (await group.run({BASE: blink}))[BASE].outcome == "done"
        await asyncio.sleep(0.5)

    async def work() -> None:
        await asyncio.sleep(0.1)
        await group.meet([BASE, TIP])
        await group.acquire(BASE)
        await moved(4)
        assert len(waiting) == 1
        assert host.modules[0].firmware.admission.refusals["limit"] == 3
        job, done = waiting.pop()
        done(job())
        await moved(1)
        assert len(waiting) == 1

    rig.run(work())


def _answers(rig: Any, leaf: Leaf, payload: bytes, serial: str = BASE) -> bytes:
    """Ask a module from an endpoint of its own."""
    replies: list[Reply] = []
    asker = rig.network.endpoint(f"asker-{rig.loop.now_ns}")
    rig.loop.call_soon(
        lambda: asker.query(key(rig.robot.name, serial, leaf), payload, 1.0, replies.append, 1)
    )
    rig.run(asyncio.sleep(0.02))
    (reply,) = replies
    assert reply.payload is not None
    return reply.payload


def test_every_question_is_answered_within_a_few_ticks(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    rig.run(asyncio.sleep(0.2))
    ask = encode(Ask(serial=BASE, boot=0, seq=7, sender="tester"))
    assert decode(Info, _answers(rig, Leaf.INFO, ask)).module_type == "X5-9-old"
    assert decode(Status, _answers(rig, Leaf.STATUS, ask)).re == 7
    boot = rig.hosts[BASE].modules[0].firmware.config.boot
    history = HistoryRequest(serial=BASE, boot=boot, seq=8, sender="tester", first_row=3, end_row=9)
    rows = unpack(decode(Feedback, _answers(rig, Leaf.HISTORY, encode(history))))
    assert len(rows) == 6
    assert (np.diff(rows["t_ns"]) == 4_000_000).all() or np.abs(np.diff(rows["t_ns"]) - 4e6).max() < 1e3


def test_an_estimate_that_there_is_not_and_noise_are_refused_and_counted(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    rig.run(asyncio.sleep(0.2))
    request = EstimateRequest(serial=BASE, boot=0, seq=1, sender="tester", joint=TIP)
    refusal = decode(Ack, _answers(rig, Leaf.ESTIMATE, encode(request)))
    assert (refusal.accepted, refusal.reason) == (False, "gone")
    assert "has no estimate of joint X-00010" in refusal.detail
    for leaf in (Leaf.ESTIMATE, Leaf.LEASE, Leaf.HISTORY):
        assert decode(Ack, _answers(rig, leaf, b"\xc1noise")).reason == "malformed"
    assert rig.hosts[BASE].modules[0].firmware.admission.refusals == {"gone": 1, "malformed": 3}


def test_noise_on_a_neighbours_keys_is_counted_and_does_no_harm(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    noise = rig.network.endpoint("noise")
    status = Status(
        serial="X-66666",
        boot=1,
        seq=1,
        t_ns=0,
        state="moving",
        holder=None,
        lease_left_ns=0,
        token=0,
        next_row=0,
        motion=None,
        refusals={},
        expiries=0,
        dropped_events=0,
    )
    for payload in (b"", b"\xc1", b"\x81" * 5000, encode(status)):
        noise.publish(key(rig.robot.name, "X-12345", Leaf.MOTION), payload)
    rig.run(asyncio.sleep(0.1))
    refused = rig.hosts[TIP].modules[0].firmware.admission.refusals
    assert sum(refused.values()) == 4
    assert refused["wrong_serial"] == 1


@pytest.mark.parametrize(
    ("serial", "rows", "reason"),
    [("-bad", (0, 10), "malformed"), ("a b", (0, 10), "malformed"), ("X-66666", (0, 2**62), "range")],
)
def test_one_message_of_an_intruder_does_not_end_an_agent(
    rigs: Callable[..., Any], serial: str, rows: tuple[int, int], reason: str
) -> None:
    rig = rigs(ARM)
    intruder = rig.network.endpoint("intruder")
    record = MotionRecord.model_construct(
        motion_id=1,
        pattern=ConstantMotion(velocity_rad_s=1.0, duration_s=0.5),
        outcome="done",
        start_ns=0,
        start_row=rows[0],
        end_row=rows[1],
        origin_rad=0.0,
    )
    head = {"serial": serial, "boot": 1, "seq": 1, "t_ns": 0, "state": "moving", "holder": None}
    rest = {"lease_left_ns": 0, "token": 0, "next_row": 0, "refusals": {}, "expiries": 0, "dropped_events": 0}
    status = Status.model_construct(**head, **rest, motion=record)
    intruder.publish(f"x5/{rig.robot.name}/{serial}/motion", encode(status))
    rig.run(asyncio.sleep(0.1))
    for host in rig.hosts.values():
        assert host.modules[0].firmware.admission.refusals == {reason: 1}


def test_a_token_stands_for_a_module_that_serves_and_falls_with_it(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    watcher, seen = rig.network.endpoint("watcher"), list[Liveness]()
    watcher.watch_alive(key(rig.robot.name, TIP, Leaf.ALIVE), seen.append)
    rig.run(asyncio.sleep(0.01))
    rig.hosts.pop(TIP).close()
    rig.run(asyncio.sleep(0.01))
    assert [event.alive for event in seen] == [True, False]
    assert rig.pwm[1] == 0.0


def test_modules_that_share_a_process_share_nothing_else(rigs: Callable[..., Any]) -> None:
    """Feedback of each module on its own key, in its own clock, numbered from its own first row."""
    rig = rigs("a2085_04")
    got: dict[str, list[Feedback]] = {serial: [] for serial in rig.serials}
    listener = rig.network.endpoint("listener")

    def on_feedback(event: Any) -> None:
        assert isinstance(event, Sample)
        found = decode(Feedback, event.payload, 1 << 16)
        got[found.serial].append(found)

    for serial in rig.serials:
        listener.subscribe(key(rig.robot.name, serial, Leaf.FEEDBACK), on_feedback)
    rig.run(asyncio.sleep(0.3))
    starts = []
    for found in got.values():
        firsts = [f.first_row for f in found]
        assert firsts == list(range(0, 5 * len(firsts), 5))
        assert len(firsts) >= 14
        starts.append(int(unpack(found[0])["t_ns"][0]))
    assert len(set(starts)) == 4


def _garbage(kind: str) -> bytes:
    head = {"v": 1, "serial": TIP, "boot": 0, "seq": 1, "sender": "flood", "why": ""}
    return {
        "too_long": b"\x90" * 100_000,
        "too_long_for_a_stop": msgpack.packb(head | {"more": bytes(3800)}),
        "malformed": b"\xc1" * 1000,
        "version": msgpack.packb(head | {"v": 2}),
        "types": msgpack.packb(head | {"sender": 5}),
        "wrong_serial": msgpack.packb(head | {"serial": BASE}),
        "wrong_boot": msgpack.packb(head | {"boot": 12345}),
    }[kind]


@pytest.mark.parametrize(
    "kind",
    ["too_long", "too_long_for_a_stop", "malformed", "version", "types", "wrong_serial", "wrong_boot"],
)
def test_a_stop_is_confirmed_within_100_ms_under_a_flood_on_its_own_key(
    rigs: Callable[..., Any], kind: str
) -> None:
    """80 messages a tick are 80,000 a second, published and asked; once more than fit, and a stop behind."""
    rig = rigs(ARM)
    at, garbage = key(rig.robot.name, TIP, Leaf.STOP), _garbage(kind)
    rig.run(asyncio.sleep(0.1))
    flood, holder = rig.network.endpoint("flood"), rig.network.endpoint("holder")
    answers: list[Any] = []
    sent = 0

    def throw(times: int, what: bytes = garbage) -> None:
        nonlocal sent
        for number in range(times):
            flood.publish(at, what)
            flood.query(at, what, 0.05, lambda event: None, number)
        sent += 2 * times

    async def flooded() -> None:
        for tick in range(60):
            throw(40)
            if tick == 30:
                # Between two ticks, more than the 256 KiB that wait on one key, to the last byte.
                throw((256 << 10) // (EVENT_BYTES + min(len(garbage), 4096)))
                throw(20, b"")
                stop = Stop(serial=TIP, boot=0, seq=1, sender="tester")
                holder.query(at, encode(stop), 0.1, lambda event: answers.append((rig.loop.now_ns, event)), 1)
                asked_ns = rig.loop.now_ns
            await asyncio.sleep(0.001)
        ((answered_ns, reply),) = answers
        assert decode(Ack, reply.payload).accepted
        assert answered_ns - asked_ns <= 10_000_000
        # All that waits is read at last.
        await asyncio.sleep(0.1)

    rig.run(flooded())
    module = rig.hosts[TIP].modules[0]
    assert module.firmware.state == "stopped"
    # What a flood pushes out is counted, as is what is refused.
    refusals = module.firmware.admission.refusals
    assert sum(refusals.values()) + module.firmware.dropped_events == sent
    assert refusals[kind.removesuffix("_for_a_stop")] > 100


def test_the_longest_stop_there_may_be_stops_a_module(rigs: Callable[..., Any]) -> None:
    rig = rigs(ARM)
    rig.run(asyncio.sleep(0.1))
    firmware = rig.hosts[TIP].modules[0].firmware
    # The wire bounds the characters of a name, and the bytes of a reason.
    stop = Stop(serial=TIP, boot=firmware.config.boot, seq=2**63 - 1, sender="\U0001f6d1" * 64, why="x" * 512)
    assert decode(Ack, _answers(rig, Leaf.STOP, encode(stop), TIP)).accepted
    assert firmware.state == "stopped"

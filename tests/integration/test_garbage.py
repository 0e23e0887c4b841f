"""Messages that nobody should send, on every key of every module, while somebody holds the robot."""

from collections import Counter
from typing import Any

import msgpack
import numpy as np

from module_agent.wire.codec import MAX_MESSAGE_BYTES
from module_agent.wire.keys import ROOT, Leaf, key
from module_agent.wire.messages import Status
from module_agent.wire.topics import PUBLISHED_TO_MODULE, SERVED, TOPICS
from sim.processes.launcher import Child
from sim.scoring.score import score
from sim.world.truth import read_motion

NAN, INFINITY = float("nan"), float("inf")


REASONS = ("too_long", "malformed", "version", "types")


def without_values(leaf: Leaf) -> dict[str, bytes]:
    """Return what is garbage on any key, by the reason for which it is refused on this one."""
    return {
        "too_long": b"\x90" * (TOPICS[leaf].max_bytes_to_module + 1),
        "malformed": b"\x91" * 1000,
        "version": msgpack.packb({"v": 2, "serial": "X", "boot": 0, "seq": 1}),
        "types": msgpack.packb({"v": 1, "serial": 5, "boot": "x"}),
    }


def not_finite() -> dict[Leaf, dict[str, Any]]:
    """Return what makes a command of the lease's holder wrong in a number, and in nothing else."""
    gain = {"kp": NAN}
    return {
        Leaf.SETPOINT: {"position_rad": NAN, "velocity_rad_s": None, "effort_nm": INFINITY},
        Leaf.MOTION: {
            "motion_id": 7,
            "pattern": {"kind": "goto", "target_rad": INFINITY, "max_speed_rad_s": 1.0},
        },
        Leaf.GAINS: {"gains": {"strategy": 3, "position": gain, "velocity": gain, "effort": gain}},
    }


def grown(commander, serials: tuple[str, ...], before: dict[str, Counter[str]]) -> dict[str, Counter[str]]:
    """Return how often each module has refused something since then, keep-alives that came late left out."""
    since = {s: Counter(commander.status(s).refusals) - before[s] for s in serials}
    return {
        s: Counter({why: n for why, n in counts.items() if why != "stale"}) for s, counts in since.items()
    }


def test_garbage_on_every_key_is_counted_by_reason_and_moves_nothing(
    launcher, client, programs, through_driver
) -> None:
    robot = launcher(hebi=through_driver)
    commander = client(robot.config.robot_name, hub=True)
    robot.start_world()
    agents = robot.start_agents()
    serials = robot.config.serials
    commander.meet(serials, *agents)
    for serial in serials:
        commander.acquire(serial)
    began = {s: commander.status(s) for s in serials}
    throw_all(robot.config.robot_name, commander, serials, agents, began)
    now = {s: commander.status(s) for s in serials}
    for serial in serials:
        assert now[serial].state == "armed"
        assert now[serial].expiries == 0
        assert now[serial].motion is None
        assert now[serial].boot == began[serial].boot
    for serial in serials:
        release = commander.ask(serial, Leaf.LEASE, commander.lease_message(serial, "release"), commander.Ack)
        assert release.accepted

    # Through the driver the robot identifies itself in virtual time (tests/simulation).
    if not through_driver:
        code, said = programs.ended(robot.start_coordinator(quiet=True))
        assert code == 0, said
    robot.stop()
    truth = read_motion(robot.config.out / "truth.npz")
    for index, serial in enumerate(truth.serials):
        clock = truth.clock_ns[:, index]
        during = (clock >= began[serial].t_ns) & (clock <= now[serial].t_ns)
        # Held still: what is left is the hold's own noise.
        assert np.ptp(truth.q_rad[during, index]) < 1e-3
    assert through_driver or score(robot.config.out).topology_correct


def throw_all(
    name: str, commander, serials: tuple[str, ...], agents: list[Child], began: dict[str, Status]
) -> None:
    """Send all kinds of garbage while the robot is held; each is counted by its reason."""

    def hold() -> None:
        for serial in serials:
            commander.keep_alive(serial)

    def throw(at: str, payload: bytes) -> None:
        commander.transport.publish(at, payload)
        commander.raw(at, payload, 0.5)
        hold()

    def settled(expected: dict[str, Counter[str]], before: dict[str, Counter[str]]) -> None:
        def counted() -> bool:
            hold()
            return grown(commander, serials, before) == expected

        try:
            commander.until(counted, "the counts", *agents)
        except AssertionError as error:
            raise AssertionError(f"{grown(commander, serials, before)}, expected {expected}") from error

    none = {s: Counter(began[s].refusals) for s in serials}
    for reason in REASONS:
        for serial in serials:
            for leaf in Leaf:
                throw(key(name, serial, leaf), without_values(leaf)[reason])
    # Each module reads the questions and publications of its own keys, and the announced motions of all.
    each = len(SERVED) + len(PUBLISHED_TO_MODULE) + len(serials)
    settled({s: Counter(dict.fromkeys(REASONS, each)) for s in serials}, none)

    so_far = {s: Counter(commander.status(s).refusals) for s in serials}
    for serial in serials:
        for leaf, fields in not_finite().items():
            throw(key(name, serial, leaf), msgpack.packb({"v": 1, **commander.head(serial), **fields}))
    # As a publication a command of a motion is no announcement of one.
    settled({s: Counter(not_finite=len(not_finite()), types=len(serials)) for s in serials}, so_far)

    # Wildcards reach all of a module's keys at once; larger than any message, or than Zenoh itself takes.
    so_far = {s: Counter(commander.status(s).refusals) for s in serials}
    throw(f"{ROOT}/{name}/**", b"garbage")
    settled({s: Counter(malformed=len(SERVED) + len(PUBLISHED_TO_MODULE)) for s in serials}, so_far)
    for size in (MAX_MESSAGE_BYTES + 1, 2 << 20):
        throw(key(name, serials[0], Leaf.FEEDBACK), bytes(size))
        throw(key(name, serials[1], Leaf.SETPOINT), bytes(size))

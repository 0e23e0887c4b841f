"""An agent that freezes and thaws while its commander streams on."""

import signal
import time

import numpy as np
import pytest

from module_agent.wire.codec import encode
from module_agent.wire.keys import Leaf, key
from module_agent.wire.messages import MotionCommand, Status
from sim.world.truth import read_motion

HELD_RAD, ASKED_RAD = 0.3, 1.8


@pytest.mark.parametrize(
    ("frozen_s", "given_up"),
    [
        pytest.param(0.6, False, id="all of it arrives at once at the thaw"),
        pytest.param(3.0, True, id="the hub has given the agent up by then"),
    ],
)
def test_nothing_that_was_sent_to_a_frozen_agent_is_executed_when_it_thaws(
    launcher, client, frozen_s: float, given_up: bool
) -> None:
    """On the horizontal robot gravity moves nothing, so whatever moves after the thaw was commanded."""
    robot = launcher(lifetime_ms=400)
    serial, other = robot.config.serials
    commander = client(robot.config.robot_name, hub=True)
    robot.start_world()
    frozen, _ = robot.start_agents()
    commander.meet(robot.config.serials, frozen)
    commander.acquire(serial)
    commander.ramp(serial, 0.0, HELD_RAD)

    def held() -> Status | None:
        status: Status = commander.status(serial)
        if status.state == "streaming":
            return status
        commander.acquire(serial)
        commander.ramp(serial, HELD_RAD, HELD_RAD)
        return None

    before = commander.until(held, "the hold", frozen)

    frozen.process.send_signal(signal.SIGSTOP)
    frozen_ns, sent = commander.newest_ns[serial], 0
    # By the clock of the module that is not frozen.
    thaw_ns = commander.newest_ns[other] + round(frozen_s * 1e9)
    at = key(robot.config.robot_name, serial, Leaf.MOTION)
    jump = {"kind": "goto", "target_rad": ASKED_RAD, "max_speed_rad_s": 1.0}
    commander.transport.query(
        at,
        encode(MotionCommand.model_validate({**commander.head(serial), "motion_id": 1, "pattern": jump})),
        1.0,
        lambda reply: None,
        0,
    )
    while commander.newest_ns[other] < thaw_ns:
        commander.stream(serial, ASKED_RAD)
        commander.keep_alive(serial)
        sent += 1
        time.sleep(0.01)
    frozen.process.send_signal(signal.SIGCONT)

    def refused() -> bool:
        # Streams on, now with fresh echoes: what has expired must be armed anew before it moves.
        commander.stream(serial, ASKED_RAD)
        refusals = commander.status(serial).refusals
        arrived = refusals.get("stale", 0) - before.refusals.get("stale", 0) >= sent
        not_armed = refusals.get("not_armed", 0) - before.refusals.get("not_armed", 0)
        return not_armed >= 10 and (arrived or commander.losses[serial] > 0)

    commander.until(refused, "the refusals", frozen)
    # A machine that stalls in the short freeze may have let the hub's lease run out as well.
    assert commander.losses[serial] > 0 or not given_up
    after = commander.status(serial)
    assert after.state == "expired"
    assert after.expiries == before.expiries + 1
    assert after.dropped_events == 0
    commander.until(
        lambda: commander.newest_ns[serial] > after.t_ns + 500_000_000, "half a second more", frozen
    )
    robot.stop()

    truth = read_motion(robot.config.out / "truth.npz")
    index = truth.serials.index(serial)
    q, clock = truth.q_rad[:, index], truth.clock_ns[:, index]
    since = q[clock >= frozen_ns]
    # The commands before the frost did move the joint, and those during it ask for 1.5 rad more. What is left
    # is the give of a gear whose motor is let go: less than the error of the hold, some 0.02 rad.
    assert abs(since[0] - HELD_RAD) < 0.03
    assert np.ptp(since) < 0.03

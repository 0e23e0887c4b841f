"""A coordinator that dies in the middle of a motion: the robot stops by itself, and the run is resumed."""

import numpy as np
import pytest

from coordinator.live_robot.commander import KEEP_ALIVE_S, LEASE_NS
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import load_recording
from module_agent.wire.feedback_rows import STATE_NAMES
from module_agent.wire.messages import Status
from sim.scoring.score import score

EXPIRED = STATE_NAMES.index("expired")
# Four seconds: a motion that lasts grows slowly.
MOVING_ROWS = 1000


def last_expiry(statuses: list[Status]) -> Status | None:
    """Return the first status of the expiry that a module is in, None if it is in none.

    A busy machine may have held up keep-alives before: the session re-arms then and tries again.
    """
    newest = statuses[-1]
    if newest.state != "expired":
        return None
    return next(s for s in statuses if s.state == "expired" and s.expiries == newest.expiries)


# The test by which `make test` has the processes of the driver.
@pytest.mark.parametrize("through_driver", [False, True], ids=["loops", "driver"], indirect=True)
def test_the_motors_are_off_within_the_lifetime_of_the_last_accepted_command(
    launcher, client, lasting_plan, through_driver
) -> None:
    """The hub outlives the coordinator here, so that the instant of the last accepted command is heard."""
    robot = launcher(lifetime_ms=500, hebi=through_driver)
    config = robot.config
    ear = client(config.robot_name, hub=True)
    robot.start_world()
    agents = robot.start_agents()
    coordinator = robot.start_coordinator(["--plan", str(lasting_plan)], quiet=True)
    mover = config.serials[0]
    motion = ear.motion(mover, "windowed_sine", MOVING_ROWS, coordinator)
    coordinator.process.kill()
    coordinator.process.wait()
    for serial in config.serials:
        info = ear.info(serial)
        expired = ear.until(
            lambda serial=serial: last_expiry(ear.statuses[serial]), f"{serial} expired", *agents
        )
        # A keep-alive lets the lease run for this long from the instant at which it is accepted. While
        # answers come late, the motion is commanded again between two of them, which extends no lease.
        accepted_ns = expired.t_ns + expired.lease_left_ns - LEASE_NS + int(KEEP_ALIVE_S * 1e9)
        late_ns = accepted_ns + info.lifetime_ns + 2 * info.tick_ns
        ear.until(
            lambda serial=serial, end=late_ns: ear.newest_ns[serial] > end + 200_000_000, "rows", *agents
        )
        now = ear.status(serial)
        assert now.expiries == expired.expiries
        rows = ear.history(
            serial, motion.start_row if serial == mover else max(0, now.next_row - 2000), now.next_row
        )
        past = rows[rows["t_ns"] > late_ns]
        assert len(past)
        assert (past["state"] == EXPIRED).all()
        assert (past["pwm"] == 0.0).all()
    moving = ear.history(mover, motion.start_row, motion.start_row + MOVING_ROWS)
    assert np.abs(moving["pwm"]).max() > 0.0
    assert np.ptp(moving["position_rad"]) > 0.05
    assert ear.status(mover).motion.outcome == "expired"


def done_steps(recording: Recording) -> list[str]:
    return [event.step for event in recording.journal if event.what == "done"]


def test_a_killed_coordinator_s_run_is_resumed_where_it_was(launcher, client, programs) -> None:
    robot = launcher()
    config = robot.config
    first, second = config.serials
    robot.start_world()
    agents = robot.start_agents()
    coordinator = robot.start_coordinator(quiet=True)
    ear = client(config.robot_name)
    motion = ear.motion(second, "windowed_sine", 150, coordinator)
    # A busy machine may have held up the keep-alives before: the session re-arms then and tries again.
    before = ear.status(second).expiries
    coordinator.process.kill()
    coordinator.process.wait()
    ear.close()

    # The hub died with the coordinator; somebody else's lets the modules say what they did alone.
    witness = client(config.robot_name, hub=True)
    witness.meet(config.serials, *agents)
    witness.until(lambda: witness.status(second).state == "expired", "the expiry", *agents)
    status = witness.status(second)
    assert status.expiries == before + 1
    assert status.motion.motion_id == motion.motion_id
    assert status.motion.outcome == "expired"
    rows = witness.history(second, motion.start_row, status.next_row)
    off = rows[rows["t_ns"] >= rows["t_ns"][rows["state"] == EXPIRED][0]]
    assert (off["state"] == EXPIRED).all()
    assert (off["pwm"] == 0.0).all()
    witness.close()

    crashed = load_recording(config.out / "session.mcap")
    assert f"explore/{first}" in done_steps(crashed)
    assert f"explore/{second}" not in done_steps(crashed)
    resumed = robot.start_coordinator(["--resume"], quiet=True)
    code, said = programs.ended(resumed)
    assert code == 0, said
    robot.stop()

    whole = load_recording(config.out / "session.mcap")
    assert [event.what for event in whole.journal].count("session") == 2
    assert [event.what for event in whole.journal].count("finished") == 1
    begun = [event.step for event in whole.journal if event.what == "begin"]
    assert begun.count(f"explore/{first}") == begun.count("rest") == 1
    assert begun.count(f"explore/{second}") == 2
    assert done_steps(whole).count(f"explore/{second}") == 1
    for serial in config.serials:
        old, log = crashed.modules[serial].rows, whole.modules[serial].rows
        assert log.first_row == old.first_row
        assert log.end_row > old.end_row
        # The modules remember a minute, so not even the rows between the two coordinators are missing.
        assert log.missing(log.first_row, log.end_row) == []
    assert not (config.out / "session.crashed.mcap").exists()
    found = score(config.out)
    assert found.topology_correct
    assert abs(found.links[0].link_length_error_mm) <= 0.05 * found.links[0].link_length_true_mm

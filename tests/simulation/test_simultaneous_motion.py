"""A robot that moves all its joints at once knows itself in a quarter of the time."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from coordinator.excitation.plan import Plan
from coordinator.recording.run_folder import load_recording
from sim.scoring.score import score

Rigs = Callable[..., Any]
WHOLE = Plan(mode="simultaneous", dynamics=False, imu="calibrated")
ARM, BASE, TIP = "thesis_171_vertical", "X-00009", "X-00010"


def test_six_joints_with_a_reversed_elbow_are_identified_in_twenty_seconds(
    rigs: Rigs, tmp_path: Path
) -> None:
    result = rigs("arm6", "lan", 1).session(tmp_path / "run", WHOLE)
    found = score(tmp_path / "run")
    assert found.topology_differences == []
    assert result.robot_time_s < 20.0
    assert found.tip_position_rms_mm is not None
    # 1.5 mm are measured; the same joints one by one, in 70 s, leave 2.2 mm: links give in both.
    assert found.tip_position_rms_mm < 4.0
    for link in found.links:
        assert link.axis_error_deg is not None
        assert link.axis_error_deg < 0.2


@pytest.mark.parametrize("network", ["lan", "wifi"])
def test_the_branches_of_a_tree_are_told_apart_when_both_move(
    rigs: Rigs, tmp_path: Path, network: str
) -> None:
    rigs("tree_y", network, 3).session(tmp_path / "run", WHOLE.model_copy(update={"imu": "uncalibrated"}))
    found = score(tmp_path / "run")
    assert found.topology_differences == []
    for link in found.links:
        assert link.link_length_error_mm is not None
        # Links of 0.1 to 0.4 m; the kit's own tolerances are millimetres.
        assert abs(link.link_length_error_mm) < 5.0


@pytest.mark.parametrize("reboots", [False, True])
def test_a_coordinator_that_is_killed_in_mid_motion_goes_on_where_it_was(
    rigs: Rigs, tmp_path: Path, reboots: bool
) -> None:
    rig, out = rigs(ARM, "lan", 1), tmp_path / "run"

    class Killed(BaseException):
        """SIGKILL: nothing runs after it."""

    def kill() -> None:
        rig.network.kill("coordinator")
        raise Killed

    # Every joint's motion takes 11 s; the rest is over by then.
    rig.at(9.0, kill)
    with pytest.raises(Killed):
        rig.session(out, WHOLE)
    crashed = (out / "session.mcap").read_bytes()
    rig.end_tasks()
    if reboots:
        rig.kill(TIP)
        rig.boot(TIP)
    rig.loop.call_later(2.0, rig.loop.stop)
    rig.loop.run_forever()
    (out / "session.mcap").write_bytes(crashed)
    rig.session(out, WHOLE, resume=True, sender="successor")
    done = [e.step for e in load_recording(out / "session.mcap").journal if e.what == "done"]
    # A module that has booted may have another zero: it is listened to at rest again.
    assert done == ["home", "rest", "home", *(["rest"] if reboots else []), "explore", "back"]
    found = score(out)
    assert found.topology_differences == []
    assert sorted(load_recording(out / "session.mcap").modules) == [BASE, TIP]

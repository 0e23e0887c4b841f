"""A robot that moves all its joints at once knows itself in a quarter of the time."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from coordinator.identification.preview import Preview
from coordinator.kinematics.chain_estimate import link_lengths
from coordinator.recording.run_folder import load_recording
from module_agent.model.chain import Chain
from sim.robot.robot_file import load_robot
from sim.robot.robot_tree import true_chain
from sim.scoring.score import score
from tests.breadth import breadth

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


def test_the_robot_is_shown_while_all_its_joints_still_move(rigs: Rigs, tmp_path: Path) -> None:
    rig = rigs("a2085_03", "wifi", 2)
    run, seen = rig.begin(tmp_path / "run", WHOLE), []

    def show(session_ns: int, preview: Preview) -> None:
        seen.append((session_ns, preview))

    run._feed.preview = show
    rig.run(run.run())
    journal = run.recording.journal
    begun, done = (
        [e.t_ns for e in journal if e.what == what and e.step == "explore"] for what in ("begin", "done")
    )
    # 11 s of motion, looked at every 2 s; what it is too early for is not shown.
    assert 3 <= len(seen) <= 5
    assert all(begun[0] < t_ns < done[0] for t_ns, _ in seen)
    true = true_chain(load_robot("a2085_03"))
    lengths, _ = link_lengths(true, np.zeros((6 * len(true.serials),) * 2))
    expected = dict(zip(true.serials, lengths, strict=True))
    for _, preview in seen:
        assert parents(preview.fit.chain) == parents(true)
        assert preview.adjacent == (False, True, True)
        for serial, length, sigma in zip(
            preview.fit.chain.serials, preview.fit.link_length_m, preview.fit.link_length_sigma_m, strict=True
        ):
            # What the model leaves out, the play of gears above all, is some millimetres.
            assert np.isnan(length) or abs(length - expected[serial]) < 4.0 * sigma + 0.005
    first, last = (float(np.nanmax(preview.fit.link_length_sigma_m)) for _, preview in (seen[0], seen[-1]))
    assert last < first


def parents(chain: Chain) -> dict[str, str | None]:
    return {s: chain.serials[p] if p >= 0 else None for s, p in zip(chain.serials, chain.parent, strict=True)}


@pytest.mark.parametrize("network", ["wifi", *breadth("lan")])
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

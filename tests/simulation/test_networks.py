"""Whole runs over networks that stall, differ by direction, follow a recorded trace, or are gone at times."""

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from coordinator.excitation.plan import Plan
from coordinator.live_robot.errors import ModuleLost
from coordinator.recording.run_folder import load_recording
from module_agent.network_emulation.profile import PROFILES, NetworkProfile, Stall
from module_agent.network_emulation.profile_file import network
from module_agent.transport.transport import LEASE_S
from sim.main import app
from sim.scoring.score import score

ARM = "thesis_171_horizontal"
Rigs = Callable[..., Any]


def _right(out: Path) -> None:
    found = score(out)
    assert found.topology_differences == []
    for link in found.links:
        assert link.link_length_error_mm is not None
        assert abs(link.link_length_error_mm) < 2.0  # see test_robots


@pytest.mark.parametrize("seed", range(2))
def test_modules_whose_clocks_the_round_trips_map_wrongly_are_put_together_rightly(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path, seed: int
) -> None:
    """The estimates map the clocks by the motion itself, so that an asymmetry costs them nothing."""
    rigs(ARM, PROFILES["asymmetric"], seed).session(tmp_path / "run", quick_plan)
    _right(tmp_path / "run")


def test_stalls_of_tens_of_milliseconds_interrupt_nothing(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    # One in eleven milliseconds is part of a stall. One longer than the lifetime of 250 ms less the period of
    # keep-alives comes once in exp(190 / 20), or 13 000, and the three endpoints have about 200 in the run.
    stalling = NetworkProfile(name="t", delay_ms=0.5, stall=Stall(apart_s=0.2, mean_ms=20.0))
    rig = rigs(ARM, stalling, 1)
    rig.session(tmp_path / "run", quick_plan)
    _right(tmp_path / "run")
    assert not any("trying again" in line for line in rig.notes)


def test_a_partition_of_the_schedule_interrupts_a_motion_that_is_then_done_again(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    parted = PROFILES["lan"].model_copy(update={"partitions": ((4.0, 4.6), (6.5, 7.0))})
    rig = rigs(ARM, parted, 1)
    rig.session(tmp_path / "run", quick_plan)
    _right(tmp_path / "run")
    assert any("trying again" in line for line in rig.notes)
    expiries = [m.status.expiries for m in load_recording(tmp_path / "run" / "session.mcap").modules.values()]
    assert min(expiries) >= 1


def test_a_partition_longer_than_the_lease_ends_the_run_by_name_and_everything_is_stopped(
    rigs: Rigs, quick_plan: Plan, tmp_path: Path
) -> None:
    parted = PROFILES["lan"].model_copy(update={"partitions": ((4.0, 30.0),)})
    rig = rigs(ARM, parted, 1)
    with pytest.raises(ModuleLost, match=r"module X-000(09|10) is lost: "):
        rig.session(tmp_path / "run", quick_plan)
    # Missed for a second at the latest, or by the tokens after the lease; then three attempts to stop.
    assert rig.loop.time() < 4.0 + LEASE_S + 2.5
    rig.run(asyncio.sleep(1.0))
    assert {rig.state(s) for s in rig.serials} <= {"idle", "stopped", "expired"}


def test_a_network_file_with_a_recorded_trace_is_replayed_in_a_run_to_the_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    rows = [f"{0.02 * i:.3f},{2.0 + rng.exponential(3.0):.3f},{int(rng.random() < 0.02)}" for i in range(500)]
    (tmp_path / "up.csv").write_text("\n".join(["time_s,delay_ms,lost", *rows]))
    file = tmp_path / "shop.toml"
    file.write_text('delay_ms = 0.5\n\n[to_coordinator]\ntrace = "up.csv"\n')
    plan = tmp_path / "plan.toml"
    plan.write_text("discover_s = 0.3\nlink_s = 0.3\nrest_s = 1.0\nsine_centre_s = 1.2\nsine_sigma_s = 0.5\n")
    hashes = []
    for name in ("one", "two"):
        given = ["run", ARM, "--virtual", "--no-dynamics", "--plan", str(plan), "--quiet"]
        done = CliRunner().invoke(app, [*given, "--network", str(file), "--out", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
        hashes.append(json.loads((tmp_path / name / "result.json").read_text())["trace_hash"])
    assert hashes[0] == hashes[1]
    _right(tmp_path / "one")
    trips_ms = [
        1e-6 * (trip.received_ns - trip.sent_ns)
        for module in load_recording(tmp_path / "one" / "session.mcap").modules.values()
        for trip in module.round_trips
    ]
    trace = network(str(file)).path("coordinator").trace
    assert trace is not None
    delays_ms = [row.delay_ms for row in trace.rows if not row.lost]
    # Down 0.5 ms, up a row of the trace, or as long as the longest behind another message; and between them
    # the module answers within two of its ticks of 1 ms.
    assert 0.5 + min(delays_ms) <= min(trips_ms)
    assert max(trips_ms) <= 0.5 + max(delays_ms) + 2.0
    assert np.median(trips_ms) == pytest.approx(0.5 + np.median(delays_ms), abs=1.5)

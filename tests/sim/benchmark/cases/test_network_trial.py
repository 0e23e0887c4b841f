"""A robot over a network: scored by the truth, and the same modules whatever the network."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from module_agent.signals.clock_map import ClockMap
from sim.benchmark.cases.arm import arm_trial, clock_error_s
from sim.benchmark.cases.network import OFFSET_S, with_clock_errors
from sim.imperfections.noise_profile import noise_profile
from sim.sensors.module_clock import ModuleClock

ARM = "thesis_171_horizontal"
NOISE = with_clock_errors(noise_profile("x5"))


@pytest.fixture(scope="module")
def short() -> Plan:
    return Plan(
        dynamics=False,
        discover_s=0.3,
        link_s=0.3,
        settle_s=0.3,
        rest_s=1.0,
        travel_speed_rad_s=1.5,
        imu="calibrated",
    )


def test_over_a_radio_network_links_and_clocks_are_as_good_as_claimed(short: Plan) -> None:
    trial = arm_trial(ARM, NOISE, 5, network="wifi", plan=short)
    assert trial.why == ""
    assert trial.right
    (link,) = trial.links
    assert link.error_m is not None
    assert link.sigma_m is not None
    # Four sigmas; of the base that shakes a part is not in the model.
    assert abs(link.error_m) < max(4.0 * link.sigma_m, 2e-3)
    assert trial.clock_error_s is not None
    assert trial.clock_sigma_s is not None
    # One tie between two clocks: half a millisecond is half of a quick round trip.
    assert trial.clock_error_s < min(4.0 * trial.clock_sigma_s, 2e-3)
    assert pickle.loads(pickle.dumps(trial)) == trial


def test_a_trial_on_a_network_that_carries_nothing_says_why_it_ended(short: Plan, tmp_path: Path) -> None:
    slow = tmp_path / "slow.toml"
    slow.write_text("delay_ms = 150.0\n")
    trial = arm_trial(ARM, NOISE, 0, network=str(slow), plan=short)
    assert trial.why.startswith("unfit: of the round trips")
    assert trial.links == ()
    assert trial.tip is None


def test_clocks_apart_differ_by_offset_and_drift_and_nothing_else_changes() -> None:
    before, after = noise_profile("x5").model_dump(), NOISE.model_dump()
    changed = {field for field in before if before[field] != after[field]}
    assert changed == {"clock_offset_min_s", "clock_offset_max_s", "clock_drift_ppm"}
    assert after["clock_offset_max_s"] == OFFSET_S


def test_the_error_of_clocks_is_how_far_they_are_mapped_from_one_another() -> None:
    true = {"a": ModuleClock(5_000_000_000, 0), "b": ModuleClock(7_000_000_000, 0)}
    found = {"a": ClockMap(0, -5e9 + 1e6, 0.0, 0.0), "b": ClockMap(0, -7e9 + 3e6, 0.0, 0.0)}
    # 2 ms apart: each is 1 ms from the middle of both.
    assert clock_error_s(found, true, 30.0) == pytest.approx(1e-3)
    # Both late alike is no error between them.
    late = {s: clock.corrected(-4e6, 0.0) for s, clock in found.items()}
    assert clock_error_s(late, true, 30.0) == pytest.approx(1e-3)
    # A drift of 10 ppm over 30 s adds 0.3 ms at the end, half of it to each: rms of 1 to 1.15 ms.
    fast = found | {"b": found["b"]._replace(origin_ns=7_000_000_000, drift=1e-5)}
    seen = 1e-3 + np.linspace(0.0, 0.15e-3, 1000)
    assert clock_error_s(fast, true, 30.0) == pytest.approx(float(np.sqrt(np.mean(seen**2))), rel=1e-3)

"""Every shipped robot is recognised over good and poor networks, the thesis' arms are measured closely.

Robots share one run per network between their tests; the group keeps those in one process.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from coordinator.plan import Plan
from coordinator.result import Result
from coordinator.terminal import Terminal
from sim.robot_file import load_robot, shipped_robots
from sim.score import Score, score
from sim.virtual_run import VirtualConfig, run_virtual

THESIS = tuple(name for name in shipped_robots() if name.startswith("thesis"))
# Sixteen joints take long: 54 s of robot time with these, 87 s without.
SHORTER = {
    "settle_s": 0.2,
    "constant_duration_s": 0.4,
    "sine_centre_s": 0.8,
    "sine_sigma_s": 0.35,
    "travel_speed_rad_s": 2.5,
}


class Scored(NamedTuple):
    result: Result
    score: Score


Runs = Callable[[str, str, Plan], Scored]


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    done: dict[tuple[str, str, Plan], Scored] = {}

    def run(name: str, network: str, plan: Plan) -> Scored:
        if (name, network, plan) not in done:
            out: Path = tmp_path_factory.mktemp("run") / "run"
            config = VirtualConfig(load_robot(name), out, seed=0, network=network, plan=plan)
            result = run_virtual(config, Terminal(quiet=True))
            done[name, network, plan] = Scored(result, score(out))
        return done[name, network, plan]

    return run


def _grouped(names: tuple[str, ...], *networks: str) -> list[object]:
    return [
        pytest.param(name, network, marks=pytest.mark.xdist_group(f"{name}-{network}"))
        for name in names
        for network in networks
    ]


@pytest.mark.parametrize(("name", "network"), _grouped(shipped_robots(), "lan", "wifi"))
def test_who_is_mounted_on_whom_and_how_is_found(
    runs: Runs, quick_plan: Plan, name: str, network: str
) -> None:
    found = runs(name, network, quick_plan.model_copy(update=SHORTER) if name == "snake16" else quick_plan)
    assert found.score.topology_differences == []
    assert found.result.serials[0] == load_robot(name).serials[0]
    # Rate ratios of 0 and 1 are certain; 0.5 would be a toss-up, from which the least certain is this far.
    assert found.result.topology_confidence > 0.05


@pytest.mark.parametrize(("name", "network"), _grouped(THESIS, "lan"))
def test_link_and_axis_of_the_thesis_arms_are_found(
    runs: Runs, quick_plan: Plan, name: str, network: str
) -> None:
    (link,) = runs(name, network, quick_plan).score.links
    assert link.link_length_error_mm is not None
    assert link.axis_error_deg is not None
    # The accelerometer's scale is known to 0.3 % and the catalogue's place of the IMU to some tenths of a
    # millimetre: 1.5 mm of 484. The thesis' own errors are 0.6 to 20 mm, 5 % at the most.
    assert abs(link.link_length_error_mm) < 2.0
    assert abs(link.link_length_error_mm) < 0.05 * link.link_length_true_mm
    assert link.axis_error_deg < 0.2


@pytest.mark.parametrize(("name", "network"), _grouped(THESIS, "lan"))
def test_the_claimed_uncertainty_of_a_link_covers_its_error(
    runs: Runs, quick_plan: Plan, name: str, network: str
) -> None:
    (link,) = runs(name, network, quick_plan).score.links
    assert link.link_length_error_mm is not None
    assert link.link_length_sigma_mm is not None
    assert abs(link.link_length_error_mm) < 3.0 * link.link_length_sigma_mm
    # It is no excuse either: a claim of centimetres would cover anything.
    assert link.link_length_sigma_mm < 0.02 * link.link_length_true_mm + 1.0


@pytest.mark.parametrize(("name", "network"), _grouped(THESIS, "lan"))
def test_what_a_fixed_base_hides_is_named(runs: Runs, quick_plan: Plan, name: str, network: str) -> None:
    found = runs(name, network, quick_plan).result
    kinds = ["offset_along_axis"]
    if name.endswith("horizontal"):  # the arm sweeps a horizontal plane: its axis is vertical
        kinds.append("rotation_about_axis")
    assert [item.kind for item in found.unresolved] == kinds
    assert len(found.null_basis[0]) == len(kinds)


def test_the_kit_arm_is_identified_with_its_inertia(runs: Runs, quick_plan: Plan) -> None:
    found = runs("a2085_04", "lan", quick_plan.model_copy(update={"dynamics": True})).score
    assert found.topology_correct
    assert found.tip_position_rms_mm is not None
    assert found.torque_relative_error is not None
    # The bar is 20 mm at the tip of the 0.75 m arm; 0.5 mm are measured.
    assert found.tip_position_rms_mm < 5.0
    # The bar of published identifications is 6 to 12 %; 0.7 % are measured.
    assert found.torque_relative_error < 0.03
    assert found.torque_relative_error_measured is not None
    assert found.torque_relative_error_measured < 0.03

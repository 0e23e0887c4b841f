"""Every shipped robot is recognised over good and poor networks, the thesis' arms are measured closely.

Modules are as delivered, with uncalibrated IMUs, on bases and links that give, unless a test says otherwise.
Whole identifications are run once and shared by tests; their group keeps those in one process. Where only the
topology is asked for, a session without fast motions and without refinement says as much.
"""

from collections.abc import Callable
from typing import NamedTuple

import pytest

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify_kinematics
from coordinator.identification.result import Result
from coordinator.identification.topology_search import search_topology
from module_agent.network_emulation.profile_file import network as network_profile
from sim import simulate
from sim.imperfections.noise_profile import NoiseProfile, noise_profile, switched
from sim.robot.robot_file import load_robot, shipped_robots
from sim.robot.robot_tree import true_chain
from sim.scoring.chain_score import link_errors, topology_differences
from sim.scoring.score import Score
from sim.virtual_time.robot import VirtualSettings
from sim.virtual_time.session import record_session
from tests.breadth import breadth

THESIS = tuple(name for name in shipped_robots() if name.startswith("thesis"))
OTHERS = tuple(name for name in shipped_robots() if name not in THESIS)
# All of these are recognised over wifi, the poorer network; a chain and a tree over both. The thesis' arms
# differ in length and alignment alone and are recognised over a LAN in whole runs: here two of them do.
POORLY_CONNECTED = ("thesis_171_horizontal", "thesis_484_vertical", *OTHERS)
WELL_CONNECTED = ("a2085_03", "tree_y")
# Chains like others with more joints, which take a minute: `make test-all` has them.
LONG = ("a2085_06", "snake16")
# Sixteen joints take long.
SHORTER = {"settle_s": 0.2, "constant_duration_s": 0.4, "travel_speed_rad_s": 2.5}


class Scored(NamedTuple):
    result: Result
    score: Score


# A calibrated IMU on a solid robot: what is left are noise, clocks and how motors move.
SOLID = switched(noise_profile("x5"), off=("base-shake", "link-flex"))

Runs = Callable[..., Scored]


@pytest.fixture(scope="session")
def runs() -> Runs:
    done: dict[tuple[str, str, Plan, str], Scored] = {}

    def run(name: str, network: str, plan: Plan, noise: NoiseProfile | None = None) -> Scored:
        case = (name, network, plan, repr(noise))
        if case not in done:
            simulation = simulate(name, noise=noise, network=network, plan=plan)
            done[case] = Scored(simulation.identified.result, simulation.score())
        return done[case]

    return run


def _grouped(names: tuple[str, ...], *networks: str) -> list[object]:
    return [
        pytest.param(name, network, marks=pytest.mark.xdist_group(f"{name}-{network}"))
        for name in names
        for network in networks
    ]


@pytest.mark.parametrize(("name", "network"), _grouped(THESIS, "lan"))
def test_topology_and_mounting_of_the_thesis_arms_are_identified(
    runs: Runs, quick_plan: Plan, name: str, network: str
) -> None:
    found = runs(name, network, quick_plan)
    assert found.score.topology_differences == []
    assert found.result.serials[0] == load_robot(name).serials[0]
    assert found.result.topology_confidence > 0.95


@pytest.mark.parametrize(
    ("name", "network"),
    [(name, "wifi") for name in POORLY_CONNECTED if name not in LONG]
    + [(name, "lan") for name in WELL_CONNECTED]
    + breadth(*((name, "wifi") for name in LONG)),
)
def test_topology_and_mounting_are_identified(quick_plan: Plan, name: str, network: str) -> None:
    robot = load_robot(name)
    plan = quick_plan.model_copy(update={"topology_only": True} | (SHORTER if name == "snake16" else {}))
    recording = record_session(VirtualSettings(robot, network_profile(network)), plan)
    topology = search_topology(recording, robot.serials).topology
    assert topology_differences(topology, true_chain(robot)) == []
    assert topology.serials[0] == robot.serials[0]
    # The odds of the least certain answer; where held joints give by a quarter it is the lowest.
    assert topology.confidence > 0.95


@pytest.mark.parametrize(("name", "network"), _grouped(THESIS, "lan"))
def test_link_and_axis_of_the_thesis_arms_are_found(
    runs: Runs, quick_plan: Plan, name: str, network: str
) -> None:
    (link,) = runs(name, network, quick_plan, SOLID).score.links
    assert link.link_length_error_mm is not None
    assert link.axis_error_deg is not None
    # The spring's own ringing and the filters leave 0.1 to 0.3 %: 1.5 mm of 484. The thesis' own errors are
    # 0.6 to 20 mm, 5 % at the most.
    assert abs(link.link_length_error_mm) < 2.0
    assert link.axis_error_deg < 0.2


@pytest.mark.parametrize(("name", "network"), _grouped(THESIS, "lan"))
def test_the_claimed_uncertainty_of_a_link_covers_its_error(
    runs: Runs, quick_plan: Plan, name: str, network: str
) -> None:
    (link,) = runs(name, network, quick_plan).score.links
    assert link.link_length_error_mm is not None
    assert link.link_length_sigma_mm is not None
    assert abs(link.link_length_error_mm) < 3.0 * link.link_length_sigma_mm
    # It is no excuse either: a claim of centimetres would cover anything. A post that shakes is not in the
    # model, and leaves a tenth.
    share = 0.10 if name.endswith("vertical") else 0.02
    assert link.link_length_sigma_mm < share * link.link_length_true_mm + 1.0


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
    # The bar is 20 mm at the tip of the 0.75 m arm; 4 to 9 mm are measured: the last module's IMU is askew.
    assert found.tip_position_rms_mm < 20.0
    # The bar of published identifications is 6 to 12 %; 1.2 to 1.9 % are measured.
    assert found.torque_relative_error < 0.03
    assert found.torque_relative_error_measured is not None
    assert found.torque_relative_error_measured < 0.03


def test_the_kit_arm_with_calibrated_imus_on_rigid_links_is_identified_to_its_imus_places(
    runs: Runs, quick_plan: Plan
) -> None:
    found = runs("a2085_04", "lan", quick_plan.model_copy(update={"dynamics": True}), SOLID).score
    assert found.tip_position_rms_mm is not None
    assert found.torque_relative_error is not None
    # No motion tells where in its housing the last IMU is: 1.74 mm are the limit. These motions are short,
    # and chance allows one tip in a thousand 2.33 times the limit; this draw of 3.4 mm is one in a hundred.
    assert found.tip_position_rms_mm < 4.05
    for link in found.links:
        assert link.link_length_error_mm is not None
        assert link.link_length_sigma_mm is not None
        assert abs(link.link_length_error_mm) < 3.0 * link.link_length_sigma_mm
        assert link.link_length_sigma_mm < 2.0
    assert found.torque_relative_error < 0.03


@pytest.mark.parametrize("noise", breadth("ideal", "poor"))
def test_sixteen_modules_in_a_row_are_measured_without_any_error_and_with_every_one(noise: str) -> None:
    """Through the play of many joints the last modules see the first axes tens of degrees off."""
    settings = VirtualSettings(load_robot("snake16"), network_profile("lan"), 1, noise)
    found = identify_kinematics(record_session(settings, Plan(dynamics=False)))
    truth, serials = true_chain(load_robot("snake16")), found.fit.chain.serials
    # Of the last ones more gives than the model has.
    assert serials == truth.serials[: len(serials)]
    assert len(serials) == 16 if noise == "ideal" else len(serials) >= 14
    assert bool(found.suspicions) is (noise == "poor")
    for child in range(1, len(serials)):
        error = link_errors(found.fit.chain, truth, child)
        assert error is not None
        assert abs(error.length_m) < 5.0 * found.fit.link_length_sigma_m[child], serials[child]

"""Every module tells what its own torques say: whole sessions in virtual time, on good and poor networks."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.excitation.plan import Plan
from coordinator.identification.identify import identify
from coordinator.identification.inertia.agent_information import AGREES_BELOW
from coordinator.identification.result import DynamicsPart
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import SESSION, load_recording
from coordinator.session.information_requests import InformationRequests
from module_agent.torque_information.service import InformationService
from module_agent.wire.information_messages import CollectRequest
from module_agent.wire.refusal import Refusal, WireError
from sim.robot.robot_file import load_robot
from sim.virtual_time.robot import VirtualRobot
from sim.virtual_time.run import VirtualConfig, run_virtual

# Tests of this group share recorded runs: they stay in one process.
pytestmark = pytest.mark.xdist_group("shared_torques")

ARM = "thesis_171_horizontal"
SERIALS = ("X-00009", "X-00010")
SHORT = Plan(
    discover_s=0.3,
    link_s=0.3,
    rest_s=0.5,
    settle_s=0.3,
    travel_speed_rad_s=2.0,
    sine_centre_s=0.8,
    sine_sigma_s=0.3,
    dynamic_repeats=1,
)


class Silent:
    """A screen that keeps its lines."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def step(self, index: int, total: int, text: str, left_s: float | None = None) -> None:
        pass

    def note(self, text: str) -> None:
        self.notes.append(text)


def run(
    out: Path, network: str = "lan", between: Callable[[VirtualRobot], None] | None = None
) -> DynamicsPart:
    config = VirtualConfig(load_robot(ARM), out, seed=3, network=network, plan=SHORT)
    found = run_virtual(config, Silent(), between).dynamics
    assert found is not None
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out: Path = tmp_path_factory.mktemp("shared") / "run"
    run(out)
    return out


@pytest.fixture(scope="module")
def recording(folder: Path) -> Recording:
    return load_recording(folder / SESSION)


def dynamics(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "result.json").read_text())["dynamics"]
    return found


def test_what_the_agents_gather_is_what_the_coordinator_gathers_and_is_used(folder: Path) -> None:
    found = dynamics(folder)
    assert found["gathered_by"] == "agents"
    assert tuple(found["by_agents"]) == SERIALS
    assert found["gathered_difference"] <= AGREES_BELOW


def test_a_replay_takes_the_agents_answers_from_the_recording(folder: Path, recording: Recording) -> None:
    again = identify(recording).result.dynamics
    assert again is not None
    assert again.gathered_by == "agents"
    assert again.model_dump() == DynamicsPart.model_validate(dynamics(folder)).model_dump()


def test_the_rows_of_the_coordinator_give_the_same_parameters(recording: Recording) -> None:
    by_agents = identify(recording).result.dynamics
    asked, recording.questions = recording.questions, {}
    by_coordinator = identify(recording).result.dynamics
    recording.questions = asked
    assert by_agents is not None
    assert by_coordinator is not None
    assert by_coordinator.gathered_by == "coordinator"
    # The bar.
    np.testing.assert_allclose(by_agents.phi, by_coordinator.phi, rtol=1e-10, atol=1e-13)


def test_an_answer_that_is_not_whole_does_not_count(recording: Recording) -> None:
    held = recording.modules["X-00009"].information
    recording.modules["X-00009"].information = {}
    found = identify(recording).result
    recording.modules["X-00009"].information = held
    assert found.dynamics is not None
    assert found.dynamics.gathered_by == "both"
    assert found.dynamics.by_agents == ["X-00010"]
    assert any("X-00009: 0 of ? bytes" in note for note in found.notes)


def test_an_answer_that_was_made_with_another_chain_does_not_count(recording: Recording) -> None:
    (digest,) = recording.questions
    asked = recording.questions[digest]
    x, y, z = asked.chain.gravity_m_s2
    other = asked.chain.model_copy(update={"gravity_m_s2": (x, y, z + 1e-6)})
    recording.questions[digest] = asked.model_copy(update={"chain": other})
    found = identify(recording).result
    recording.questions[digest] = asked
    assert found.dynamics is not None
    assert found.dynamics.gathered_by == "coordinator"
    assert any("another chain" in note for note in found.notes)


def test_on_a_network_that_loses_the_agents_get_their_rows_all_the_same(tmp_path: Path) -> None:
    config = VirtualConfig(load_robot(ARM), tmp_path / "run", seed=1, network="bad", plan=SHORT)
    found = run_virtual(config, Silent()).dynamics
    assert found is not None
    assert found.gathered_by == "agents"
    assert found.gathered_difference is not None
    assert found.gathered_difference <= AGREES_BELOW


def test_of_an_agent_that_is_gone_when_it_is_asked_the_coordinator_has_the_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots: list[VirtualRobot] = []
    ask = InformationRequests.ask

    async def killed(self: InformationRequests, *arguments: Any) -> None:
        robots[0].kill("X-00010")
        await ask(self, *arguments)

    monkeypatch.setattr(InformationRequests, "ask", killed)
    found = run(tmp_path / "run", between=robots.append)
    assert (found.gathered_by, found.by_agents) == ("both", ["X-00009"])
    assert found.held_out is not None


def test_a_motion_that_is_asked_for_twice_counts_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer to a question may be lost, and the question come again."""
    collect = InformationService.collect
    heard: list[int] = []

    def twice(self: InformationService, request: CollectRequest, *arguments: Any) -> None:
        heard.append(request.motion_id)
        collect(self, request, *arguments)
        collect(self, request, *arguments)

    monkeypatch.setattr(InformationService, "collect", twice)
    found = run(tmp_path / "run")
    assert len(heard) == 4  # two motions, each kept by both modules
    assert found.gathered_by == "agents"


def test_what_a_module_does_not_keep_is_said_and_computed_from_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: InformationService, *arguments: Any) -> None:
        raise WireError(Refusal.RANGE, "no room")

    monkeypatch.setattr(InformationService, "collect", full)
    screen = Silent()
    config = VirtualConfig(load_robot(ARM), tmp_path / "run", seed=3, plan=SHORT)
    found = run_virtual(config, screen).dynamics
    assert found is not None
    assert (found.gathered_by, found.by_agents) == ("coordinator", [])
    assert any("does not retain motion" in note and "no room" in note for note in screen.notes)
    assert any("was not collected here" in note for note in screen.notes)

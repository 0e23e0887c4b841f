"""Looks at a robot that is still being explored, from the recording of a run: they come nearer and nearer."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.batch_estimation.estimator import Refinement, refine_chain
from coordinator.batch_estimation.sensor_data import SensorData
from coordinator.identification import preview as module
from coordinator.identification.preview import Preview, Previewer, preview
from coordinator.recording.recording import Recording
from coordinator.recording.run_folder import load_recording
from module_agent.model.chain import Chain

BASE, TIP = "X-00009", "X-00010"
TRUE_M = 0.35
# One process makes the recording that all tests here work on.
pytestmark = pytest.mark.xdist_group("preview")


@pytest.fixture(scope="module")
def sessions() -> list[Path]:
    return []


@pytest.fixture
def recording(
    sessions: list[Path], rigs: Callable[..., Any], quick_plan: Any, tmp_path_factory: pytest.TempPathFactory
) -> Recording:
    """A run on an arm of two modules; made once, read anew."""
    if not sessions:
        out = tmp_path_factory.mktemp("preview") / "run"
        rigs("thesis_350_vertical", "lan", 3).session(out, quick_plan)
        sessions.append(out / "session.mcap")
    return load_recording(sessions[0])


def until(recording: Recording, explored: Sequence[str]) -> Recording:
    """What was recorded when only these joints had been explored."""
    recording.journal = [
        e for e in recording.journal if e.purpose not in ("constant", "windowed_sine") or e.serial in explored
    ]
    recording.estimates = {
        pair: estimates for pair, estimates in recording.estimates.items() if pair[0] in explored
    }
    return recording


def sigma(refined: Preview | None) -> float:
    assert refined is not None
    return float(refined.fit.link_length_sigma_m[1])


def test_one_joint_tells_the_link_beyond_it_within_what_it_claims(recording: Recording) -> None:
    refined = Previewer(until(recording, [BASE])).preview([BASE])
    assert refined is not None
    assert refined.fit.chain.serials == (BASE, TIP)
    assert refined.adjacent == (False, True)
    # Three sigma: a thing of 3 in 1000.
    assert abs(refined.fit.link_length_m[1] - TRUE_M) < 3.0 * sigma(refined)
    assert sigma(refined) < 0.02


def test_samples_move_the_robot_within_what_the_circles_leave_open(recording: Recording) -> None:
    explored = [BASE, TIP]
    circles, samples = preview(recording, explored), Previewer(recording).preview(explored)
    assert circles is not None
    assert samples is not None
    apart = samples.fit.link_length_m[1] - circles.fit.link_length_m[1]
    assert 0.0 < abs(apart) < 3.0 * np.hypot(sigma(circles), sigma(samples))
    assert {u.kind for u in samples.fit.unresolved} == {"offset_along_axis"}


def test_a_robot_of_more_modules_than_are_to_be_refined_is_as_assembled(recording: Recording) -> None:
    refined, assembled = Previewer(recording, max_refined=1).preview([BASE]), preview(recording, [BASE])
    assert refined is not None
    assert assembled is not None
    np.testing.assert_array_equal(refined.fit.chain.imu_home, assembled.fit.chain.imu_home)


def test_where_samples_are_missing_the_robot_is_as_assembled(recording: Recording) -> None:
    assembled = preview(recording, [BASE])
    recording.modules[TIP].round_trips.clear()
    refined = Previewer(recording).preview([BASE])
    assert refined is not None
    assert assembled is not None
    np.testing.assert_array_equal(refined.fit.chain.imu_home, assembled.fit.chain.imu_home)


def test_a_repeated_preview_is_identical(recording: Recording) -> None:
    previewer = Previewer(recording)
    one, two = (previewer.preview([BASE, TIP]) for _ in range(2))
    assert one is not None
    assert two is not None
    np.testing.assert_array_equal(one.fit.chain.imu_home, two.fit.chain.imu_home)


def test_before_any_motion_there_is_no_preview(recording: Recording) -> None:
    assert Previewer(until(recording, [])).preview([]) is None


def test_the_samples_of_a_preview_are_bounded(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[int] = []

    def counted(chain: Chain, data: SensorData, *others: Any) -> Refinement:
        fitted.append(data.q_rad.size)
        return refine_chain(chain, data, *others)

    monkeypatch.setattr(module, "refine_chain", counted)
    whole = Previewer(recording).preview([BASE, TIP])
    monkeypatch.setattr(module, "MAX_IMU_SAMPLES", 80)
    bounded = Previewer(recording).preview([BASE, TIP])
    # Of every motion the first sample counts, and the last part may be short.
    assert len(fitted) == 4
    assert max(fitted[2:]) <= 80 + 2 * len(recording.motions("constant", "windowed_sine"))
    assert max(fitted[2:]) < min(fitted[:2])
    assert whole is not None
    assert bounded is not None
    apart = bounded.fit.link_length_m[1] - whole.fit.link_length_m[1]
    assert 0.0 < abs(apart) < 3.0 * sigma(bounded)


def test_samples_are_retained_of_the_latest_motions_only(recording: Recording) -> None:
    """However often a joint repeats its motions, and modules join."""
    previewer = Previewer(recording)
    event = recording.latest_motions("windowed_sine")[0]
    assert event.motion is not None
    for motion_id in range(1000, 1004):
        again = event.motion.model_copy(update={"motion_id": motion_id})
        recording.journal.append(event.model_copy(update={"motion": again}))
        assert previewer.preview([BASE, TIP]) is not None
        assert len(previewer._parts) == 4
    recording.modules["X-joined"] = recording.modules[TIP]
    assert previewer.preview([BASE, TIP]) is not None
    assert len(previewer._parts) == 4
